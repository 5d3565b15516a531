"""The commands in scripts/, as a user calls them."""

import ast
import os
import re
import runpy
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / 'scripts'
SHELL = SCRIPTS / 'shell'


def call(*command, folder=ROOT, **variables):
    return subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_python_runs_a_file_from_any_folder(tmp_path):
    (tmp_path / 'mine.py').write_text(
        'import sys\n'
        'import rclpy\n'
        'from maasi_sim.scenario import load_scenario\n'
        "print(load_scenario('mambo').seed, rclpy.__name__, sys.argv[1:])\n"
    )
    compiled = set(ROOT.glob('maasi_*/**/*.pyc'))
    result = call(SCRIPTS / 'python', 'mine.py', 'a b', folder=tmp_path)
    assert (result.returncode, result.stdout) == (0, "1 rclpy ['a b']\n"), result.stderr
    # No compiled module is left in the repository.
    assert set(ROOT.glob('maasi_*/**/*.pyc')) <= compiled


def test_shell_runs_commands_and_executables_and_gives_their_exit_code(tmp_path):
    script = (
        'echo $ROS_DISTRO; filter_node --help; echo help $?; '
        # Their help may be cut.
        'filter_node --help 2> cut | true; echo cut ${PIPESTATUS[0]} $(< cut); '
        'filter_node --ros-args --params-file none.yaml; echo wrong $?; exit 7'
    )
    result = call(SHELL, 'bash', '-c', script, folder=tmp_path)
    lines = result.stdout.splitlines()
    assert (result.returncode, lines[0], lines[-3:]) == (
        7,
        os.environ['ROS_DISTRO'],
        ['help 0', 'cut 0', 'wrong 2'],
    )
    assert 'measurement_batch' in result.stdout
    line = result.stderr.splitlines()[-1]
    assert line.startswith('error: ') and 'none.yaml' in line
    assert 'Traceback' not in result.stderr


def test_an_environment_that_cannot_be_set_up_ends_a_script_but_no_interactive_shell():
    commands = f'source {SCRIPTS / "environment.bash"}; echo "status $?"'
    result = call('bash', '--norc', '-ic', commands, PYTHON='no_such_python')
    assert 'status 2' in result.stdout
    assert 'no Python 3.10 to 3.14 was found at PYTHON=no_such_python' in result.stderr
    result = call(SCRIPTS / 'run_scenario', '--list', PYTHON='no_such_python')
    assert (result.returncode, result.stdout) == (2, '')
    assert 'PYTHON=no_such_python' in result.stderr
    result = call(SCRIPTS / 'demo', MAASI_WORKSPACE='/proc/workspace')
    assert (result.returncode, result.stdout) == (2, '')
    assert result.stderr.splitlines() == [
        'error: cannot write to /proc/workspace',
        '  name a folder for it: MAASI_WORKSPACE=FOLDER',
    ]


# MAASI_ROS_DISTRO, the sourced ROS 2 and whether Python finds its rclpy; answer and message.
CHOICES = [
    ('', '', False, 'jazzy wheels', ''),
    ('', 'jazzy', True, 'jazzy sourced', ''),
    ('', 'jazzy', False, 'jazzy wheels', ''),
    ('', 'kilted', True, 'kilted sourced', ''),
    ('', 'kilted', False, 'kilted wheels', ''),
    ('kilted', '', False, 'kilted wheels', ''),
    ('kilted', 'jazzy', True, 'kilted wheels', ''),
    ('jazzy', 'kilted', True, 'jazzy wheels', ''),
    ('kilted', 'kilted', True, 'kilted sourced', ''),
    (
        '',
        'rolling',
        True,
        'rolling sourced',
        'warning: using the sourced ROS 2 rolling; tested are',
    ),
    ('', 'humble', True, 'jazzy wheels', 'warning: the sourced ROS 2 humble is older than jazzy'),
    ('', 'humble', False, 'jazzy wheels', ''),
    ('humble', 'humble', True, 'humble sourced', 'warning: using the sourced ROS 2 humble; tested'),
    ('humble', 'jazzy', True, '', 'error: MAASI_ROS_DISTRO=humble: python finds no such ROS 2'),
    ('rolling', 'rolling', False, '', 'error: MAASI_ROS_DISTRO=rolling: python finds no such ROS'),
]


@pytest.mark.parametrize(('wanted', 'sourced', 'found', 'answer', 'message'), CHOICES)
def test_the_distribution_of_ros_is_the_wanted_else_the_sourced_one(
    wanted, sourced, found, answer, message
):
    text = (SCRIPTS / 'environment.bash').read_text()
    functions = re.findall(r'^maasi_(?:fail|choose_ros)\(\) \{\n.*?^\}\n', text, re.M | re.S)
    script = f'python() {{ {"true" if found else "false"}; }}\n{"".join(functions)}'
    variables = {'MAASI_ROS_DISTRO': wanted, 'ROS_DISTRO': sourced}
    result = call('bash', '-euc', f'{script}maasi_choose_ros python', MAASI_WHEELS='', **variables)
    assert (result.stdout.strip(), result.returncode) == (answer, 0 if answer else 2)
    assert result.stderr.startswith(message) and bool(result.stderr) == bool(message)
    # Where wheels are in use, they stay so in a script that another one calls.
    if sourced in ('jazzy', 'kilted') and not wanted:
        result = call(
            'bash', '-euc', f'{script}maasi_choose_ros python', MAASI_WHEELS='1', **variables
        )
        assert result.stdout == f'{sourced} wheels\n'


COMMANDS = sorted(path.name for path in SCRIPTS.iterdir() if path.is_file() and not path.suffix)


@pytest.mark.parametrize('name', COMMANDS)
def test_help_is_printed_before_anything_is_set_up(name):
    result = call(SCRIPTS / name, '--help', PYTHON='no_such_python')
    assert (result.returncode, result.stderr) == (0, '')
    assert result.stdout.startswith(f'usage: {name} ')


def test_stored_help_is_that_of_the_parsers():
    code = f"import runpy; print(runpy.run_path('{SCRIPTS}/write_help.py')['helps']())"
    helps = ast.literal_eval(call(sys.executable, '-c', code).stdout)
    assert {'run_scenario', 'team_command', 'bench'} <= helps.keys()
    for name, text in helps.items():
        stored = (SCRIPTS / 'help' / f'{name}.txt').read_text()
        assert stored.split() == text.split(), 'run ./scripts/python scripts/write_help.py'


def test_the_build_of_the_site_says_how_far_it_is_and_fails_as_sphinx_does():
    # Without Sphinx, and without touching a site that was built.
    stubs = 'for name in rm mkdir cp python sphinx-apidoc; do eval "$name() { :; }"; done\n'
    stubs += (
        'sphinx-build() { sleep 3; echo "reading sources... [ 12%] a .. b"; return $STATUS; }\n'
    )
    scripts = {status: f'STATUS={status}; {stubs} source scripts/docs' for status in (0, 2)}
    with ThreadPoolExecutor() as pool:
        results = pool.map(lambda script: call('bash', '-c', script), scripts.values())
    for status, result in zip(scripts, results):
        assert result.stderr.splitlines()[-1] == 'docs: reading pages, 12 %'
        assert result.returncode == status
        assert result.stdout.endswith('docs/index.html\n') == (status == 0)
    result = call(SCRIPTS / 'docs', '--wrote', PYTHON='no_such_python')
    assert (result.returncode, result.stderr) == (2, 'error: read --wrote, allowed is --write\n')


def test_property_tests_draw_the_same_examples_each_time(tmp_path):
    # In two files, as in two runs.
    files = [tmp_path / 'test_first.py', tmp_path / 'test_second.py']
    for file in files:
        file.write_text(
            'from hypothesis import given, strategies\n'
            '@given(strategies.integers())\n'
            "def test_draws(number): print(__name__, 'drew', number)\n"
        )
    # The tests alone.
    script = 'ruff() { :; }; codespell() { :; }; mypy() { :; }; source scripts/test "$@"'
    result = call('bash', '-c', script, 'test', *files, '-n', '0', '-s', '-p', 'no:cacheprovider')
    assert result.returncode == 0, result.stdout
    first, second = (re.findall(rf'{file.stem} drew (.*)', result.stdout) for file in files)
    assert len(first) > 50 and first == second


def test_kernels_are_compiled_before_messages_are_built():
    # Both are made at the same time.
    code = "import sys; sys.modules['maasi_msgs'] = sys.modules['rclpy'] = None; sys.argv[1:] = {}"
    parts = runpy.run_path(str(SCRIPTS / 'compile_kernels.py'))
    for names in parts['PARTS']:
        result = call(sys.executable, '-c', f'{code.format(list(names))}\n{parts["PART"]}')
        assert result.returncode == 0, result.stderr
