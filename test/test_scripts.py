"""The commands in scripts/, as a user calls them."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ENVIRONMENT = ROOT / 'scripts' / 'environment.bash'


def call(
    *command: str | Path, folder: Path = ROOT, **variables: str
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_python_runs_a_file_from_any_folder(tmp_path: Path) -> None:
    file = tmp_path / 'mine.py'
    file.write_text(
        'import sys\n'
        'import rclpy\n'
        'from maasi_sim.scenario import load_scenario\n'
        "print(load_scenario('mambo').seed, rclpy.__name__, sys.argv[1:])\n"
    )
    result = call(ROOT / 'scripts' / 'python', 'mine.py', 'a b', folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout == "1 rclpy ['a b']\n"


def test_shell_runs_a_command_and_gives_its_exit_code(tmp_path: Path) -> None:
    result = call(
        ROOT / 'scripts' / 'shell', 'bash', '-c', 'echo $ROS_DISTRO; exit 7', folder=tmp_path
    )
    assert (result.returncode, result.stdout) == (7, 'jazzy\n')


def test_shell_finds_executables_by_their_names(tmp_path: Path) -> None:
    result = call(ROOT / 'scripts' / 'shell', 'filter_node', '--help', folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert 'measurement_batch' in result.stdout


def test_a_node_whose_parameter_file_is_missing_ends_with_wrong_input(tmp_path: Path) -> None:
    node = [ROOT / 'scripts' / 'shell', 'filter_node', '--ros-args', '--params-file', 'none.yaml']
    result = call(*node, folder=tmp_path)
    assert result.returncode == 2
    line = result.stderr.splitlines()[-1]
    assert line.startswith('error: ') and 'none.yaml' in line
    assert 'Traceback' not in result.stderr


def test_the_help_of_a_node_may_be_cut(tmp_path: Path) -> None:
    help_of_node = f'{ROOT}/scripts/shell filter_node --help | true; echo ${{PIPESTATUS[0]}}'
    result = call('bash', '-c', help_of_node, folder=tmp_path)
    assert (result.stdout, result.stderr) == ('0\n', '')


def test_an_interactive_shell_survives_an_environment_that_cannot_be_set_up() -> None:
    commands = f'source {ENVIRONMENT}; echo "status $?"'
    result = call('bash', '--norc', '-ic', commands, PYTHON='no_such_python')
    assert 'status 2' in result.stdout
    assert 'no Python 3.10 to 3.13 was found at PYTHON=no_such_python' in result.stderr


def test_a_script_ends_where_the_environment_cannot_be_set_up() -> None:
    result = call(ROOT / 'scripts' / 'run_scenario', '--help', PYTHON='no_such_python')
    assert (result.returncode, result.stdout) == (2, '')
    assert 'PYTHON=no_such_python' in result.stderr


def test_a_workspace_that_cannot_be_written_is_named_in_one_line() -> None:
    result = call(ROOT / 'scripts' / 'demo', MAASI_WORKSPACE='/proc/workspace')
    assert (result.returncode, result.stdout) == (2, '')
    assert result.stderr.splitlines() == [
        'error: cannot write to /proc/workspace',
        '  name a folder for it: MAASI_WORKSPACE=FOLDER',
    ]


def test_no_compiled_module_is_left_in_the_repository() -> None:
    before = set(ROOT.glob('maasi_*/**/*.pyc'))
    result = call(ROOT / 'scripts' / 'python', '-c', 'import maasi_sim.search')
    assert result.returncode == 0, result.stderr
    assert set(ROOT.glob('maasi_*/**/*.pyc')) <= before


@pytest.mark.parametrize('name', ['colcon_test', 'demo', 'docs', 'shell', 'test'])
def test_help_says_what_a_command_is_before_anything_is_set_up(name: str) -> None:
    result = call(ROOT / 'scripts' / name, '--help', PYTHON='no_such_python')
    assert result.returncode == 0
    assert result.stdout.startswith(f'usage: {name}')


def test_property_tests_draw_the_same_examples_each_time(tmp_path: Path) -> None:
    file = tmp_path / 'test_draws.py'
    file.write_text(
        'from hypothesis import given, strategies\n'
        '@given(strategies.integers())\n'
        "def test_draws(number): print('drew', number)\n"
    )
    # The tests alone.
    script = 'ruff() { :; }; codespell() { :; }; mypy() { :; }; source scripts/test "$@"'
    command = ['bash', '-c', script, 'test', file, '-n', '0', '-s', '-p', 'no:cacheprovider']
    results = [call(*command) for _ in range(2)]
    assert [result.returncode for result in results] == [0, 0], results[0].stdout
    first, second = (
        [line for line in result.stdout.splitlines() if 'drew' in line] for result in results
    )
    assert len(first) > 50 and first == second
