"""Fixtures of the system tests."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from scenario_runs import run_scenario


@pytest.fixture(scope='session')
def repeated(tmp_path_factory):
    """Return the same scenario and seed twice: the second time with another number of threads."""
    folder = tmp_path_factory.mktemp('repeated')
    options = ('--seed', 3, '--lockstep', '--time-limit', 20)
    first = run_scenario('mambo_turtlebot', folder / 'first', *options)
    busy = subprocess.Popen([sys.executable, '-c', 'while True: pass'])
    try:
        threads = {'NUMBA_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}
        second = run_scenario('mambo_turtlebot', folder / 'second', *options, environment=threads)
    finally:
        busy.send_signal(signal.SIGKILL)
        busy.wait()
    return first, second
