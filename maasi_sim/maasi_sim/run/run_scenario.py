"""Run a scenario: its nodes as processes, watched, recorded, and reported on."""

from __future__ import annotations

import contextlib
import os
import sys

from maasi_sim.run.ending import NOT_WRITTEN, WRONG_INPUT
from maasi_sim.run.interruption import Interruption
from maasi_sim.run.run_options import parse

# One thread for each linear algebra library: there is a process for each node already.
_NODE_ENVIRONMENT = {
    'PYTHONUNBUFFERED': '1',
    'OMP_NUM_THREADS': '1',
    'OPENBLAS_NUM_THREADS': '1',
    'MKL_NUM_THREADS': '1',
}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    interruption = Interruption()
    for key, value in _NODE_ENVIRONMENT.items():
        os.environ.setdefault(key, value)
    # ROS has its logs there.
    os.environ.setdefault('HOME', os.path.abspath(os.path.expanduser('~')))
    options = parse(arguments)
    # NumPy reads the environment when it is imported.
    from maasi_sim.run.bag import BagError, BagWriteError
    from maasi_sim.run.processes import ProcessError
    from maasi_sim.run.run_folder import ResultsError
    from maasi_sim.run.scenario_run import ScenarioRun
    from maasi_sim.scenario.layering import ScenarioError

    try:
        if options.replay is not None:
            # rclpy starts threads, which a scenario run must not have yet.
            from maasi_sim.run.replay import replay

            stop_asked = interruption.__bool__
            return replay(options.replay, options.out, options.domain_id, stop_asked)
        return ScenarioRun(options, interruption).execute()
    except (ScenarioError, ProcessError, BagError, ResultsError) as error:
        with contextlib.suppress(OSError):
            for line in str(error).splitlines():
                print(f'error: {line}', file=sys.stderr)
        return NOT_WRITTEN if isinstance(error, (ResultsError, BagWriteError)) else WRONG_INPUT


if __name__ == '__main__':
    sys.exit(main())
