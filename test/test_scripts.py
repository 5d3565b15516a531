"""The commands in scripts/, as a user calls them."""

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
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
    result = call(SHELL, 'bash', '-c', 'echo $ROS_DISTRO; exit 7', folder=tmp_path)
    assert (result.returncode, result.stdout) == (7, 'jazzy\n')
    result = call(SHELL, 'filter_node', '--help', folder=tmp_path)
    assert result.returncode == 0 and 'measurement_batch' in result.stdout, result.stderr
    # Their help may be cut.
    help_of_node = f'{SHELL} filter_node --help | true; echo ${{PIPESTATUS[0]}}'
    result = call('bash', '-c', help_of_node, folder=tmp_path)
    assert (result.stdout, result.stderr) == ('0\n', '')
    node = [SHELL, 'filter_node', '--ros-args', '--params-file', 'none.yaml']
    result = call(*node, folder=tmp_path)
    line = result.stderr.splitlines()[-1]
    assert result.returncode == 2 and line.startswith('error: ') and 'none.yaml' in line
    assert 'Traceback' not in result.stderr


def test_an_environment_that_cannot_be_set_up_ends_a_script_but_no_interactive_shell():
    commands = f'source {SCRIPTS / "environment.bash"}; echo "status $?"'
    result = call('bash', '--norc', '-ic', commands, PYTHON='no_such_python')
    assert 'status 2' in result.stdout
    assert 'no Python 3.10 to 3.13 was found at PYTHON=no_such_python' in result.stderr
    result = call(SCRIPTS / 'run_scenario', '--help', PYTHON='no_such_python')
    assert (result.returncode, result.stdout) == (2, '')
    assert 'PYTHON=no_such_python' in result.stderr
    result = call(SCRIPTS / 'demo', MAASI_WORKSPACE='/proc/workspace')
    assert (result.returncode, result.stdout) == (2, '')
    assert result.stderr.splitlines() == [
        'error: cannot write to /proc/workspace',
        '  name a folder for it: MAASI_WORKSPACE=FOLDER',
    ]


@pytest.mark.parametrize('name', ['colcon_test', 'demo', 'docs', 'shell', 'test'])
def test_help_says_what_a_command_is_before_anything_is_set_up(name):
    result = call(SCRIPTS / name, '--help', PYTHON='no_such_python')
    assert result.returncode == 0
    assert result.stdout.startswith(f'usage: {name}')


def test_the_build_of_the_site_says_how_far_it_is_and_fails_as_sphinx_does():
    # Without Sphinx, and without touching a site that was built.
    stubs = 'for name in rm mkdir cp python sphinx-apidoc; do eval "$name() { :; }"; done\n'
    stubs += (
        'sphinx-build() { sleep 3; echo "reading sources... [ 12%] a .. b"; return $STATUS; }\n'
    )
    for status in (0, 2):
        script = f'STATUS={status}; {stubs} source scripts/docs'
        result = call('bash', '-c', script)
        assert result.stderr.splitlines()[-1] == 'docs: reading pages, 12 %'
        assert result.returncode == status
        assert result.stdout.endswith('docs/index.html\n') == (status == 0)
    result = call(SCRIPTS / 'docs', '--wrote', PYTHON='no_such_python')
    assert (result.returncode, result.stderr) == (2, 'error: read --wrote, allowed is --write\n')


def test_property_tests_draw_the_same_examples_each_time(tmp_path):
    file = tmp_path / 'test_draws.py'
    file.write_text(
        'from hypothesis import given, strategies\n'
        '@given(strategies.integers())\n'
        "def test_draws(number): print('drew', number)\n"
    )
    # The tests alone.
    script = 'ruff() { :; }; codespell() { :; }; mypy() { :; }; source scripts/test "$@"'
    command = ['bash', '-c', script, 'test', file, '-n', '0', '-s', '-p', 'no:cacheprovider']
    draws = []
    for _ in range(2):
        result = call(*command)
        assert result.returncode == 0, result.stdout
        draws.append([line for line in result.stdout.splitlines() if 'drew' in line])
    assert len(draws[0]) > 50 and draws[0] == draws[1]
