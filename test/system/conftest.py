"""Fixtures of the system tests."""

import subprocess
import sys

import pytest
from scenario_runs import PATIENCE, command, run_scenario


@pytest.fixture(scope='session')
def repeated(tmp_path_factory):
    """Return the same scenario and seed twice: the second time not alone on the machine.

    Beside it is another run, a core is busy, and libraries have another number of threads.
    """
    folder = tmp_path_factory.mktemp('repeated')
    options = ('--seed', 3, '--lockstep', '--time-limit', 20)
    first = run_scenario('mambo_turtlebot', folder / 'first', *options)
    other = ('--seed', 4, '--lockstep', '--time-limit', 5)
    beside = [
        subprocess.Popen([sys.executable, '-c', 'while True: pass']),
        subprocess.Popen(
            command('mambo_turtlebot', folder / 'other', *other),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ),
    ]
    try:
        threads = {'NUMBA_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}
        second = run_scenario('mambo_turtlebot', folder / 'second', *options, environment=threads)
    finally:
        beside[0].kill()
        for process in beside:
            process.wait(PATIENCE)
    return first, second
