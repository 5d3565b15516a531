"""`run_scenario` with nodes that play by a script; the first argument is JSON of parameters."""

import json
import sys
import time
from pathlib import Path

from maasi_sim.run import node_plan, run_scenario, scenario_run
from maasi_sim.targets import mission

FAKES = Path(__file__).with_name('fake_nodes.py')


class FakePlan(node_plan.NodePlan):
    """Starts a fake in place of the executable."""

    def command(self, executable, parameter_file, log_level=None):
        rest = super().command(executable, parameter_file)[1:]
        return [sys.executable, str(FAKES), self.executable, *rest]


def plan_fakes(scenario, run):
    """Return the plans of a clock, drivers, a filter and a planner."""
    script = json.loads(sys.argv[1])
    names = scenario.names()
    common = {'robots': names, 'lockstep': run.lockstep, 'step': scenario.step}
    targets = [float(value) for row in scenario.world(run.seed).targets for value in row]

    def plan(role, name, namespace='', **more):
        parameters = {**common, **script.get(f'{namespace}/{name}'.strip('/'), {})}
        parameters.update(more.pop('parameters', {}))
        return FakePlan('maasi_fakes', role, name, namespace, parameters, **more)

    found = script.get('found', len(targets) // 2)
    return [
        plan('sim', 'sim_node', is_clock=True, says_done=False),
        *(plan('driver', 'driver', name, drives=True) for name in names),
        plan('filter', 'filter_node', parameters={'targets': targets[: 2 * found] or [0.0]}),
        plan('planner', 'planner_node'),
    ]


def wait(*_):
    """Take the place of what would take minutes."""
    print('busy', flush=True)
    while True:
        time.sleep(0.05)


def main():
    if json.loads(sys.argv[1]).get('long'):
        scenario_run.store_report = scenario_run.read_events = wait
    mission.plan_nodes = plan_fakes
    node_plan.find_executable = lambda package, executable: Path(executable)
    return run_scenario.main(sys.argv[2:])


if __name__ == '__main__':
    sys.exit(main())
