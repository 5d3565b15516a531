"""Requirements with the newest, and the oldest, of each dependency."""

import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[2]


def written(end, folder):
    subprocess.run([sys.executable, ROOT / 'scripts/dependency_ends.py', end, folder], check=True)
    return {
        file.name: [
            Requirement(line)
            for line in file.read_text().splitlines()
            if line and not line.startswith('#')
        ]
        for file in folder.glob('*.txt')
    }


@pytest.mark.parametrize('end', ['newest', 'oldest'])
def test_an_end_has_each_dependency_and_no_other_file_pins_it(tmp_path, end):
    files = written(end, tmp_path)
    allowed = {item.name: item.specifier for item in files.pop('requirements.txt')}
    pinned = ROOT / 'requirements.txt'
    for line in pinned.read_text().splitlines():
        if line and not line.startswith('#'):
            assert Requirement(line).name in allowed
    assert {'numpy', 'opencv-python-headless', 'rasterio', 'hypothesis'} <= allowed.keys()
    for name, specifier in allowed.items():
        operators = {part.operator for part in specifier}
        assert operators == {'=='} if end == 'oldest' else '>=' in operators, name
    assert {path.name for path in ROOT.glob('requirements-*.txt')} == files.keys()
    assert not allowed.keys() & {item.name for items in files.values() for item in items}
    for distro in ('jazzy', 'kilted'):
        names = {item.name for item in files[f'requirements-{distro}.txt']}
        assert f'ros-{distro}-rclpy' in names
