"""Many robots, their real drivers, filter and planner in lockstep."""

import pytest
from scenario_runs import of_topic, run_scenario

# More processes than Fast DDS finds on one host by default (32).
ROBOTS = 30


@pytest.mark.system
def test_many_drones_search_in_lockstep(tmp_path):
    places = [(20.0 + 30.0 * (n % 6), 20.0 + 30.0 * (n // 6)) for n in range(ROBOTS)]
    scenario = {
        'version': 1,
        'description': 'Many drones',
        'environment': {'bounds': [[0.0, 200.0], [0.0, 200.0], [0.0, 60.0]]},
        'step': 0.1,
        'targets': {'count': 20, 'distribution': 'uniform'},
        'robots': {
            f'drone{n:02d}': {
                'type': 'ranging_drone',
                'start': [x, y, 20.0],
                'candidates': {'grid': [5, 5, 2], 'spacing': [40.0, 40.0, 20.0]},
            }
            for n, (x, y) in enumerate(places)
        },
        'filter': {'method': 'pmb'},
        'planner': {'name': 'maasi'},
        # All targets are found in the first step, which would end the run before it has a decision.
        'stop': 'planner_done',
        'on_exit': 'end',
        'limits': {'time': 0.5},
    }
    run = run_scenario(scenario, tmp_path / 'run', '--lockstep', '--seed', 1)
    assert run.code in (0, 1), run.output
    decisions = of_topic(run, '/decisions')
    assert {robot['robot'] for item in decisions for robot in item['robots']} == {
        f'drone{n:02d}' for n in range(ROBOTS)
    }
