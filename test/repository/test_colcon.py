"""`colcon test` finds and runs the tests of the packages."""

import re
import subprocess
import sys
from pathlib import Path

from ament_index_python.packages import get_package_prefix

ROOT = Path(__file__).resolve().parents[2]


def test_each_package_has_tests_that_colcon_runs_by_pytest():
    for manifest in ROOT.glob('*/package.xml'):
        package = manifest.parent
        assert list(package.glob('test/test_*.py')), package
        build = package / ('setup.py' if (package / 'setup.py').exists() else 'CMakeLists.txt')
        assert re.search(r"'test': \[.*'pytest\b|ament_add_pytest_test", build.read_text()), build


def test_colcon_runs_the_tests_of_a_package(tmp_path):
    install = Path(get_package_prefix('maasi_config')).parent
    places = [f'--build-base={install.parent / "build"}', f'--install-base={install}']
    results = f'--test-result-base={tmp_path / "results"}'
    for words in (['test', '--base-paths=config', *places, results], ['test-result', results]):
        command = [sys.executable, '-m', 'colcon', f'--log-base={tmp_path / "log"}', *words]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    counts = re.search(r'Summary: (\d+) tests, 0 errors, 0 failures', done.stdout)
    assert counts and int(counts[1]) >= len(list((ROOT / 'config' / 'scenarios').glob('*.yaml')))
