"""What the packages declare is what they import, and what rosdep and pip can install."""

import ast
import re
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
FACTS = yaml.safe_load((ROOT / 'test' / 'data' / 'noble.yaml').read_text())
PACKAGES = sorted(path.parent for path in ROOT.glob('*/setup.py'))
MANIFESTS = sorted(ROOT.glob('*/package.xml'))
OURS = {path.parent.name.replace('config', 'maasi_config') for path in MANIFESTS}
# Needed without an import: files that are read, and a module that is imported by its name.
READ = {'maasi_sim': {'maasi_config'}}
BY_NAME = {'maasi_drivers': {'pyparrot', 'zeroconf'}}

packages = pytest.mark.parametrize('package', PACKAGES, ids=lambda path: path.name)


def imported(package: Path, tests: bool) -> set[str]:
    """Return the modules from outside that a package, or its tests, import: first names."""
    found = set() if tests else set(BY_NAME.get(package.name, ()))
    for path in package.rglob('*.py'):
        inside = path.relative_to(package)
        if inside.parts[0] in ('setup.py', 'build') or (inside.parts[0] == 'test') != tests:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {item.name.partition('.')[0] for item in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
                found.add(node.module.partition('.')[0])
    found = {name.removesuffix('_entry') for name in found}
    own = {path.parent.name for path in package.glob('*/__init__.py')}
    return found - own - set(sys.stdlib_module_names)


def declared(package: Path, *tags: str) -> set[str]:
    """Return what a manifest names in elements with these tags; with all ending in `depend`."""
    elements = ElementTree.parse(package / 'package.xml').getroot()
    return {
        (element.text or '').strip()
        for element in elements
        if (element.tag in tags if tags else element.tag.endswith('depend'))
    }


def requirements(package: Path, tests: bool) -> dict[str, Requirement]:
    """Return what setup.py requires, or requires for tests, by its name on PyPI."""
    values: dict[str, Any] = {}
    for node in ast.walk(ast.parse((package / 'setup.py').read_text())):
        if isinstance(node, ast.keyword) and node.arg in ('install_requires', 'extras_require'):
            values[node.arg] = ast.literal_eval(node.value)
    groups = {'': values.get('install_requires', []), **values.get('extras_require', {})}
    lines = [line for name, group in groups.items() if (name == 'test') == tests for line in group]
    return {item.name: item for item in map(Requirement, lines)}


@packages
@pytest.mark.parametrize('tests', [False, True], ids=['runtime', 'tests'])
def test_what_is_imported_is_declared_and_nothing_else(package: Path, tests: bool) -> None:
    modules = imported(package, False) | READ.get(package.name, set())
    if tests:
        modules = imported(package, True) - modules
    required, known, ros = requirements(package, tests), FACTS['modules'], set(FACTS['jazzy'])
    names = {known[name]['pip'] if name in known else name for name in modules - ros}
    assert set(required) == names - {'maasi_msgs'}
    keys = modules & (OURS | ros)
    # Without those that noble lacks or has too old.
    for fact in (known[name] for name in modules - keys):
        if 'noble' in fact and fact['noble'] in required[fact['pip']].specifier:
            keys.add(fact['key'])
    assert declared(package, *(['test_depend'] if tests else ['depend', 'exec_depend'])) == keys
    for name, item in required.items():
        # Those that are tested.
        assert name in OURS or version(name) in item.specifier, f'{name} {version(name)}: {item}'


@pytest.mark.parametrize('manifest', MANIFESTS, ids=lambda path: path.parent.name)
def test_rosdep_can_install_each_key(manifest: Path) -> None:
    there = {fact['key'] for fact in FACTS['modules'].values() if 'noble' in fact}
    assert declared(manifest.parent) <= OURS | set(FACTS['jazzy']) | there


def test_what_is_installed_is_declared() -> None:
    lines = (ROOT / 'requirements.txt').read_text().splitlines()
    installed = {Requirement(line).name for line in lines if line and not line.startswith('#')}
    needed = {name for package in PACKAGES for name in requirements(package, False)}
    # These come with pydantic and matplotlib; what is large and for GIS files only is for tests.
    assert installed == needed - OURS - {'typing_extensions', 'Pillow', 'pyogrio', 'rasterio'}


def test_the_file_for_pixi_has_what_the_packages_need() -> None:
    text = (ROOT / 'docs' / 'pixi.toml').read_text()
    # As `tomllib`, which Python 3.10 lacks: tables of quoted values.
    tables = {
        table.split(']')[0]: dict(re.findall(r'^([\w-]+) = "(.*)"$', table, re.MULTILINE))
        for table in re.split(r'^\[', text, flags=re.MULTILINE)[1:]
    }
    needed = {name: item for path in PACKAGES for name, item in requirements(path, False).items()}
    python = {name: str(item.specifier) for name, item in needed.items() if name not in OURS}
    conda = tables['dependencies']
    given = {**tables['pypi-dependencies'], 'numpy': conda['numpy']}
    # Without what is for GIS files only.
    assert {name: set(text.split(',')) for name, text in given.items()} == {
        name: set(text.split(','))
        for name, text in python.items()
        if name not in ('pyogrio', 'rasterio')
    }
    # `ros-base` brings the other packages of ROS.
    names = {name.removeprefix('ros-jazzy-').replace('-', '_') for name in conda}
    assert {'ros_base', 'nav2_msgs', 'vision_msgs', 'rosidl_default_generators'} <= names
