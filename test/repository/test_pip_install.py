"""The packages installed by pip, where ROS and what only extras need cannot be imported."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from test_code_blocks import BLOCKS

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ('config', 'maasi_filter', 'maasi_planner', 'maasi_drivers', 'maasi_sim')
BLOCKED = (
    *('ament_index_python', 'builtin_interfaces', 'geometry_msgs', 'maasi_msgs', 'rclpy'),
    *('std_msgs', 'distributed', 'matplotlib', 'PIL', 'pymavlink', 'pyparrot'),
    *('pyogrio', 'rasterio', 'setproctitle'),
)
BLOCK = 'raise ModuleNotFoundError("No module named " + repr(__name__), name=__name__)\n'


@pytest.fixture(scope='module')
def prefix(tmp_path_factory):
    """Return where pip has installed the packages, without what they require."""
    sources = tmp_path_factory.mktemp('sources')
    for name in PACKAGES:
        shutil.copytree(
            ROOT / name, sources / name, ignore=shutil.ignore_patterns('build', '*.egg-info')
        )
    prefix = tmp_path_factory.mktemp('prefix')
    pip = [sys.executable, '-m', 'pip', 'install', '-q', '--disable-pip-version-check']
    pip += ['--no-deps', '--no-build-isolation', '--no-index', '--no-compile', '--prefix', prefix]
    # Modules of these packages in the path would be taken for installed ones.
    environment = {key: value for key, value in os.environ.items() if key != 'PYTHONPATH'}
    subprocess.run([*pip, *(sources / name for name in PACKAGES)], check=True, env=environment)
    return prefix


def modules_of(prefix):
    return next(prefix.glob('**/maasi_filter/filter_node.py')).parents[1]


def run(folder, path, *arguments):
    """Run Python in a folder, with a path of these folders and without ROS and extras."""
    blocked = folder / 'blocked'
    blocked.mkdir()
    for name in BLOCKED:
        (blocked / f'{name}.py').write_text(BLOCK)
    environment = os.environ | {'PYTHONPATH': os.pathsep.join(map(str, [blocked, *path]))}
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def without_ros():
    """Return the program in README's section about using the libraries without ROS."""
    programs = [item for item in BLOCKS if item.language == 'python']
    return next(item.text for item in programs if item.place.startswith('README'))


def test_pip_installs_every_file(prefix):
    modules = modules_of(prefix)
    for package in PACKAGES[1:]:
        for path in (ROOT / package / package).rglob('*'):
            if path.is_file() and '__pycache__' not in path.parts:
                assert (modules / path.relative_to(ROOT / package)).is_file()
    for folder in ('robots', 'scenarios', 'rviz', 'foxglove'):
        names = {path.name for path in (ROOT / 'config' / folder).iterdir()}
        assert {path.name for path in prefix.glob(f'**/maasi_config/{folder}/*')} == names


def test_an_installed_scenario_is_loaded_from_any_folder(prefix, tmp_path):
    # All but the search itself, whose kernels would be compiled for minutes at this new place.
    program = without_ros().split('\n\n')[0]
    program += '\nprint(search.__module__, load_scenario.__code__.co_filename)'
    program += "\nprint(len(load_scenario('mambo_turtlebot').robots))"
    done = run(tmp_path, [modules_of(prefix)], '-c', program)
    assert done.returncode == 0, done.stderr
    assert str(prefix) in done.stdout and done.stdout.splitlines()[-1] == '2'


def test_a_command_that_needs_ros_says_so(prefix, tmp_path):
    done = run(tmp_path, [modules_of(prefix)], next(prefix.glob('**/bin/filter_node')))
    assert done.returncode == 2
    said = r'error: filter_node: no module [a-z_]+: it needs ROS 2 \(Jazzy or Kilted\)'
    assert re.match(said, done.stderr)
    assert 'Traceback' not in done.stderr


def test_the_program_in_the_readme_runs_as_printed(tmp_path):
    path = os.environ.get('PYTHONPATH', '').split(os.pathsep)
    ours = [item for item in path if any(name in item for name in PACKAGES)]
    done = run(tmp_path, ours, '-c', without_ros())
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('all_found ')
