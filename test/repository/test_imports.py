"""Which module may import which: packages one way, ROS in few places, no cycles."""

import ast
import re
from fnmatch import fnmatch
from functools import cache, partial
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Each imports only those before it.
PACKAGES = ('msgs', 'filter', 'planner', 'drivers', 'sim')
# Folders and files that may import ROS.
ROS_FOLDERS = ('ros', 'node')
ROS_FILES = (
    '*_node.py',
    '*_driver.py',
    'conversions.py',
    # Of the drivers.
    '*_link.py',
    'camera_input.py',
    'goal_server.py',
    'measurement_responder.py',
    'robot_topics.py',
    'robot_frames.py',
    'sensor_input.py',
    'team_command.py',
    'watchdog.py',
    # Of the simulation.
    'sim_topics.py',
)
# Not ament_index_python, which looks up where files are installed.
ROS_PACKAGES = ('*_msgs', '*_interfaces', 'rcl*', 'rosidl*', 'std_srvs', 'tf2_*')


@cache
def modules():
    found = {}
    for package in PACKAGES[1:]:
        for path in sorted(ROOT.glob(f'maasi_{package}/maasi_{package}*/**/*.py')):
            parts = path.relative_to(ROOT).with_suffix('').parts[1:]
            found['.'.join(parts[:-1] if parts[-1] == '__init__' else parts)] = path
    return found


@cache
def imports(name):
    """Return what a module imports, also in functions and for types only, by its place."""
    path = modules()[name]
    package = name if path.name == '__init__.py' else name.rpartition('.')[0]
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [item.name for item in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split('.')[: len(package.split('.')) - node.level + 1]
            base = '.'.join([*(above if node.level else []), *filter(None, [node.module])])
            wholes = [f'{base}.{item.name}' for item in node.names]
            names = [whole if whole in modules() else base for whole in wholes]
        found += [(other, f'{path.relative_to(ROOT)}:{node.lineno}: {other}') for other in names]
    return found


def rank(name):
    """Return which of our packages a module belongs to; -1: to none."""
    package = name.partition('.')[0].removeprefix('maasi_').removesuffix('_entry')
    return PACKAGES.index(package) if name.startswith('maasi_') else -1


def test_packages_import_one_way():
    every = [(name, *item) for name in modules() for item in imports(name)]
    wrong = [place for name, other, place in every if rank(other) > rank(name)]
    assert not wrong, '\n'.join(wrong)


def test_each_package_names_its_own_console_scripts():
    for package in PACKAGES[1:]:
        setup = (ROOT / f'maasi_{package}' / 'setup.py').read_text()
        scripts = {
            name: item.args[0]
            for name, item in vars(import_module(f'maasi_{package}_entry')).items()
            if isinstance(item, partial)
        }
        assert all(target.startswith(f'maasi_{package}.') for target in scripts.values())
        declared = re.findall(rf"'(\w+) = maasi_{package}_entry:(\w+)'", setup)
        assert sorted(declared) == sorted((name, name) for name in scripts)


def test_only_few_places_import_ros():
    wrong, needed = [], set()
    for name, path in modules().items():
        ros = [
            place
            for other, place in imports(name)
            if any(fnmatch(other.partition('.')[0], pattern) for pattern in ROS_PACKAGES)
        ]
        if ros and not set(path.relative_to(ROOT).parts) & set(ROS_FOLDERS):
            allowed = {pattern for pattern in ROS_FILES if fnmatch(path.name, pattern)}
            needed |= allowed
            wrong += [] if allowed else ros
    assert not wrong, '\n'.join(wrong)
    assert needed == set(ROS_FILES), 'take those out that import no ROS, or whose folder may'


def test_modules_do_not_import_each_other_in_circles():
    # CycleError names the modules.
    TopologicalSorter(
        {name: {other for other, _ in imports(name) if other in modules()} for name in modules()}
    ).prepare()
