"""A scenario whose search takes a fraction of a second."""

from typing import Any

from maasi_sim.scenario.loading import scenario_from_values

SMALL_FIELD: dict[str, Any] = {
    'version': 1,
    'environment': {'bounds': [[0.0, 60.0], [0.0, 60.0]], 'expected_targets': 2.0},
    'step': 0.1,
    'targets': {'count': 2, 'separation': 10.0, 'margin': 5.0},
    'robots': {
        'drone': {
            'type': 'ranging_drone',
            'start': [1.0, 1.0, 1.0],
            'candidates': {'grid': [4, 4], 'spacing': 15.0, 'corner': [7.0, 7.0]},
        }
    },
    'filter': {'method': 'pmb'},
    'planner': {'name': 'nearest_widest'},
    'limits': {'time': 15.0},
}


def small_field(environment):
    """Return the scenario with another environment."""
    return scenario_from_values({**SMALL_FIELD, 'environment': environment}, 'field')
