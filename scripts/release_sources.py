"""Write what goes to PyPI, the packages and `maasi`, which requires them: `... FOLDER [URL]`.

The packages of a release require each other in its version. URL is the address of the repository.
"""

import ast
import pathlib
import re
import shutil
import sys
from typing import Any
from xml.etree import ElementTree

ROOT = pathlib.Path(__file__).parents[1]
_SIBLING = re.compile(r"^( {8}'maasi_\w+)(?=',$)", re.MULTILINE)
_LEFT_OUT = shutil.ignore_patterns('__pycache__', '*.egg-info', 'build', 'dist', 'COLCON_IGNORE')
_README = """{description}.

Part of MAASI: a team of robots finds an unknown number of targets. `pip install maasi` installs
all parts that need no ROS 2. Nodes also need the messages, `maasi_msgs`, which are built in a ROS 2
workspace.
"""


def settings(package: pathlib.Path) -> dict[str, Any]:
    """Return the arguments of a package's `setup()` that are literals."""
    tree = ast.parse((package / 'setup.py').read_text())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    call = next(node for node in calls if getattr(node.func, 'id', '') == 'setup')
    found = {}
    for item in call.keywords:
        if not any(isinstance(node, ast.Call) for node in ast.walk(item.value)):
            found[str(item.arg)] = ast.literal_eval(item.value)
    return found


def versions() -> dict[str, str]:
    """Return the version in each file that states it."""
    found = {f'{path.parent.name}/setup.py': settings(path.parent)['version'] for path in _setups()}
    for path in sorted(ROOT.glob('*/package.xml')):
        found[f'{path.parent.name}/package.xml'] = str(ElementTree.parse(path).findtext('version'))
    match = re.search(r'^version: (\S+)$', (ROOT / 'CITATION.cff').read_text(), re.MULTILINE)
    return found | {'CITATION.cff': match[1] if match else 'none'}


def _setups() -> list[pathlib.Path]:
    return sorted(ROOT.glob('*/setup.py'))


def meta(packages: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the arguments of `setup()` of the distribution that requires all others."""
    first = next(iter(packages.values()))
    version = first['version']
    extras: dict[str, list[str]] = {}
    for name, values in packages.items():
        for extra in set(values.get('extras_require', ())) - {'test'}:
            extras.setdefault(extra, []).append(f'{name}[{extra}]=={version}')
    return {
        'name': 'maasi',
        'version': version,
        'packages': [],
        'python_requires': first['python_requires'],
        'install_requires': [f'{name}=={version}' for name in packages],
        'extras_require': dict(sorted(extras.items())),
        'maintainer': first['maintainer'],
        'maintainer_email': first['maintainer_email'],
        'description': 'A team of robots finds an unknown number of targets',
        'license': first['license'],
    }


def main() -> None:
    folder, url = pathlib.Path(sys.argv[1]), ''.join(sys.argv[2:])
    stated = versions()
    version = stated['maasi_sim/setup.py']
    for file, other in stated.items():
        if other != version:
            sys.exit(f'error: {file}: read version {other}, allowed is that of the rest, {version}')
    packages = {settings(path.parent)['name']: settings(path.parent) for path in _setups()}
    for path in _setups():
        name = settings(path.parent)['name']
        shutil.copytree(path.parent, folder / name, ignore=_LEFT_OUT)
        text = _SIBLING.sub(rf'\1=={version}', path.read_text())
        (folder / name / 'setup.py').write_text(text)
    packages['maasi'] = meta(packages)
    (folder / 'maasi').mkdir()
    arguments = ''.join(f'    {key}={value!r},\n' for key, value in packages['maasi'].items())
    text = f'from setuptools import setup\n\nsetup(\n{arguments})\n'
    (folder / 'maasi' / 'setup.py').write_text(text)
    for name, values in packages.items():
        # What setup.cfg has in the repository is for ROS 2.
        lines = ['[metadata]', 'long_description = file: README.md']
        lines += [
            'long_description_content_type = text/markdown',
            *([f'url = {url}'] if url else []),
        ]
        (folder / name / 'setup.cfg').write_text('\n'.join([*lines, '']))
        (folder / name / 'README.md').write_text(_README.format(**values))
        shutil.copy(ROOT / 'LICENSE', folder / name)


if __name__ == '__main__':
    main()
