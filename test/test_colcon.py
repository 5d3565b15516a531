"""`colcon test` finds and runs the tests of the packages."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = sorted(path.parent for path in ROOT.glob('*/package.xml'))


def colcon(log: Path, *arguments: str) -> str:
    """Run colcon and return what it prints."""
    command = [sys.executable, '-m', 'colcon', f'--log-base={log}', *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize('package', PACKAGES, ids=lambda path: path.name)
def test_each_package_has_tests(package: Path) -> None:
    assert list(package.glob('test/test_*.py'))
    # How colcon knows that pytest runs them.
    build = package / ('setup.py' if (package / 'setup.py').exists() else 'CMakeLists.txt')
    assert re.search(r"'test': \[.*'pytest\b|ament_add_pytest_test", build.read_text())


def test_colcon_runs_the_tests_of_a_package(tmp_path: Path) -> None:
    install = Path(get_package_prefix('maasi_config')).parent
    places = [f'--build-base={install.parent / "build"}', f'--install-base={install}']
    log, results = tmp_path / 'log', tmp_path / 'results'
    colcon(log, 'test', '--base-paths=config', *places, f'--test-result-base={results}')
    summary = colcon(log, 'test-result', f'--test-result-base={results}')
    counts = re.search(r'Summary: (\d+) tests, 0 errors, 0 failures', summary)
    assert counts and int(counts[1]) >= len(os.listdir(ROOT / 'config' / 'scenarios'))
