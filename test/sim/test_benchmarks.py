"""The command of the benchmarks: what it refuses before it measures, and a quick measurement."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).parents[1] / 'benchmarks' / 'bench.py'


def bench(*arguments):
    return subprocess.run(
        [sys.executable, str(BENCH), *arguments], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize('file', ['missing/figures.json', '.'])
def test_a_file_that_cannot_be_written_is_refused_before_the_work(tmp_path, file):
    done = bench('drivers', '--json', str(tmp_path / file))
    assert done.returncode == 2
    assert '--json: read' in done.stderr and done.stdout == ''


def test_quick_figures(tmp_path):
    file = tmp_path / 'figures.json'
    done = bench('drivers', '--quick', '--json', str(file))
    assert done.returncode == 0, done.stderr
    rows = json.loads(file.read_text())
    assert len(rows) == len(done.stdout.splitlines()) == 4
    assert all(row['value'] > 0.0 for row in rows)
