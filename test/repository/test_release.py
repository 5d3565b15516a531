"""What goes to PyPI: the packages and `maasi`, in one version."""

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = 'scripts/release_sources.py'
URL = 'https://example.org/maasi'


@pytest.fixture
def repository(tmp_path):
    """Return a copy of what the script reads."""
    copy = tmp_path / 'repository'
    ignored = shutil.ignore_patterns('__pycache__', '*.egg-info', 'build', 'test')
    for path in ROOT.glob('*/package.xml'):
        shutil.copytree(path.parent, copy / path.parent.name, ignore=ignored)
    for file in ('LICENSE', 'CITATION.cff', SCRIPT):
        (copy / file).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / file, copy / file)
    return copy


def write(repository):
    folder = repository.parent / 'sources'
    command = [sys.executable, repository / SCRIPT, folder, URL]
    return subprocess.run(command, capture_output=True, text=True, check=False), folder


def arguments(file):
    call = ast.parse(file.read_text()).body[-1].value
    return {item.arg: item.value for item in call.keywords}


def test_packages_require_each_other_in_their_version_and_maasi_all_of_them(repository):
    done, folder = write(repository)
    assert done.returncode == 0, done.stderr
    written = {path.name: arguments(path / 'setup.py') for path in folder.iterdir()}
    ours = {'maasi_config', 'maasi_filter', 'maasi_planner', 'maasi_drivers', 'maasi_sim'}
    assert written.keys() == ours | {'maasi'}
    (version,) = {ast.literal_eval(values['version']) for values in written.values()}
    for name, values in written.items():
        lines = ast.literal_eval(values['install_requires']) if name != 'maasi_config' else []
        needed = {item.name: item for item in map(Requirement, lines)}
        for other in needed.keys() & ours:
            assert str(needed[other].specifier) == f'=={version}'
        if name == 'maasi':
            assert needed.keys() == ours
        assert (folder / name / 'LICENSE').exists() and (folder / name / 'README.md').exists()
    extras = ast.literal_eval(written['maasi']['extras_require'])
    for name in ours:
        extra = ast.literal_eval(written[name].get('extras_require', ast.Dict([], [])))
        for item in extra.keys() - {'test'}:
            assert f'{name}[{item}]=={version}' in extras[item]
    assert 'test' not in extras


def test_maasi_is_built_with_its_requirements_and_address(repository):
    _, folder = write(repository)
    pip = [sys.executable, '-m', 'pip', 'wheel', '-q', '--no-deps', '--no-build-isolation']
    pip += ['--no-index', '--disable-pip-version-check', '-w', repository.parent]
    subprocess.run([*pip, folder / 'maasi'], check=True)
    (wheel,) = repository.parent.glob('maasi-*.whl')
    shutil.unpack_archive(wheel, repository.parent / 'wheel', 'zip')
    (file,) = (repository.parent / 'wheel').glob('maasi-*/METADATA')
    text = file.read_text()
    assert re.search(r'^Requires-Dist: maasi[_-]sim==[\d.]+$', text, re.M)
    assert re.search(
        r'^Requires-Dist: maasi[_-]sim\[reports\]==[\d.]+; extra == .reports.$', text, re.M
    )
    assert re.search(rf'^(Home-page|Project-URL): .*{URL}$', text, re.M)
    assert text.rstrip().endswith('which are built in a ROS 2\nworkspace.')


@pytest.mark.parametrize('file', ['maasi_planner/package.xml', 'config/setup.py', 'CITATION.cff'])
def test_another_version_is_refused(repository, file):
    path = repository / file
    text = path.read_text()
    version = re.search(r"^ *(?:<version>|version(?:=|: )'?)([\d.]+)", text, re.M)[1]
    path.write_text(text.replace(version, '9.9.9', 1))
    done, folder = write(repository)
    assert done.returncode == 1 and not folder.exists()
    expected = f'error: {file}: read version 9.9.9, allowed is that of the rest, {version}\n'
    assert done.stderr == expected
