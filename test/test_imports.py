"""Which module may import which: packages one way, ROS in few places, no cycles."""

from __future__ import annotations

import ast
from fnmatch import fnmatch
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Each imports only those before it. maasi_entry starts nodes of all packages, by name.
PACKAGES = ('msgs', 'entry', 'filter', 'planner', 'drivers', 'sim')
# Folders and files that may import ROS.
ROS_FOLDERS = ('ros', 'node')
ROS_FILES = (
    '*_node.py',
    '*_driver.py',
    'conversions.py',
    # Of the planner.
    'search_command.py',
    # Of the drivers.
    '*_link.py',
    'camera_input.py',
    'goal_server.py',
    'measurement_responder.py',
    'robot_topics.py',
    'robot_command.py',
    'robot_frames.py',
    'scan_input.py',
    'sensor_input.py',
    'watchdog.py',
    # Of the simulation.
    'sim_topics.py',
)
# Not ament_index_python, which looks up where files are installed.
ROS_PACKAGES = ('*_msgs', '*_interfaces', 'rcl*', 'rosidl*', 'std_srvs', 'tf2_*')


@cache
def modules() -> dict[str, Path]:
    """Return the file of each of our modules by its name."""
    found = {}
    for package in PACKAGES[1:]:
        for path in sorted(ROOT.glob(f'maasi_*/maasi_{package}/**/*.py')):
            parts = path.relative_to(ROOT).with_suffix('').parts[1:]
            found['.'.join(parts[:-1] if parts[-1] == '__init__' else parts)] = path
    return found


def package_of(name: str) -> str:
    return name.partition('.')[0].removeprefix('maasi_')


@cache
def imports(name: str) -> list[tuple[str, int]]:
    """Return what a module imports, also in functions and for types only: name and line."""
    path = modules()[name]
    package = name if path.name == '__init__.py' else name.rpartition('.')[0]
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [(item.name, node.lineno) for item in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split('.')[: len(package.split('.')) - node.level + 1]
            base = '.'.join([*(above if node.level else []), *filter(None, [node.module])])
            for item in node.names:
                whole = f'{base}.{item.name}'
                found.append((whole if whole in modules() else base, node.lineno))
    return found


def test_packages_import_one_way():
    wrong = []
    for name in modules():
        later = PACKAGES[PACKAGES.index(package_of(name)) + 1 :]
        for other, line in imports(name):
            if other.startswith('maasi_') and package_of(other) in later:
                wrong.append(f'{modules()[name].relative_to(ROOT)}:{line}: imports {other}')
    assert not wrong, '\n'.join(wrong)


def test_only_few_places_import_ros():
    wrong = []
    needed = set()
    for name, path in modules().items():
        ros = [
            f'{path.relative_to(ROOT)}:{line}: imports {other}'
            for other, line in imports(name)
            if any(fnmatch(other.partition('.')[0], pattern) for pattern in ROS_PACKAGES)
        ]
        if not ros or set(path.relative_to(ROOT).parts) & set(ROS_FOLDERS):
            continue
        allowed = {pattern for pattern in ROS_FILES if fnmatch(path.name, pattern)}
        needed |= allowed
        wrong += [] if allowed else ros
    assert not wrong, '\n'.join(wrong)
    gone = set(ROS_FILES) - needed
    assert not gone, f'import no ROS, or are in a folder that may: take out of ROS_FILES: {gone}'


def test_modules_do_not_import_each_other_in_circles():
    graph = {
        name: {other for other, _ in imports(name) if other in modules()} for name in modules()
    }
    # CycleError names the modules.
    TopologicalSorter(graph).prepare()
