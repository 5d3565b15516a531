"""Floors with markers: what the experiments on the papers' hardware have in common."""

from __future__ import annotations

from typing import Any

from maasi_sim.experiments.searches import NEVER_DONE, merged


def floor_filter(preset: str, **settings: Any) -> dict[str, Any]:
    """Return a paper's filter with lengths for a floor."""
    # As the 0.1 m in the cube: a twelfth of the deviation of the range.
    return {'preset': preset, 'jitter_deviation': 0.0013, **settings}


# The control cost without the force that holds a drone up.
MAMBO_MOTION = {'control_inputs': 'torques'}
# 0.2 m between measurements at 0.4 m/s, and as much for the ground robot at 0.2 m/s.
MAMBO_SENSOR = {'period': 0.5}
TURTLEBOT_SENSOR = {'period': 1.0}
_TARGETS = {'count': 12, 'distribution': 'uniform', 'separation': 0.15, 'margin': 0.1}


def floor(
    bounds: list[list[float]],
    robots: dict[str, Any],
    planner: dict[str, Any],
    search_filter: dict[str, Any],
    time: float = 600.0,
    **more: Any,
) -> dict[str, Any]:
    """Return a scenario on a floor with 12 markers."""
    return {
        'version': 1,
        'environment': {'bounds': bounds},
        'step': 0.05,
        'targets': _TARGETS,
        'robots': robots,
        'filter': search_filter,
        'planner': merged(NEVER_DONE, planner),
        'limits': {'time': time},
        'scoring': {'radius': 0.075},
        **more,
    }
