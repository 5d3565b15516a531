"""Fixtures of the system tests."""

import subprocess
import sys

import pytest
from scenario_runs import run_scenario, start


@pytest.fixture(scope='session')
def repeated(tmp_path_factory):
    """Return the same scenario and seed twice: the second time not alone on the machine.

    Beside it is another run, a core is busy, and libraries have another number of threads.
    """
    folder = tmp_path_factory.mktemp('repeated')
    options = ('--seed', 3, '--lockstep', '--time-limit', 20)
    first = run_scenario('mambo_turtlebot', folder / 'first', *options)
    threads = {'NUMBA_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}
    busy = subprocess.Popen([sys.executable, '-c', 'while True: pass'])
    other = ('--seed', 4, '--lockstep', '--time-limit', 5)
    try:
        with start('mambo_turtlebot', folder / 'other', *other) as beside:
            second = run_scenario(
                'mambo_turtlebot', folder / 'second', *options, environment=threads
            )
            beside.finish()
    finally:
        busy.kill()
        busy.wait()
    return first, second
