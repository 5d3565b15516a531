"""Floors with markers: what the experiments on the papers' hardware have in common."""

from __future__ import annotations

from typing import Any

from maasi_sim.experiments.cases import Choice
from maasi_sim.experiments.searches import NEVER_DONE, merged


def floor_filter(preset: str, **settings: Any) -> dict[str, Any]:
    """Return a paper's filter with lengths for a floor."""
    # As the 0.1 m in the cube: a twelfth of the deviation of the range.
    return {'preset': preset, 'jitter_deviation': 0.0013, **settings}


FLOOR_CHOICES = (
    Choice(
        'R = diag[0.016, 0.052]',
        'deviations in m and rad',
        'As variances they would be 0.13 m and 13 degrees in a field of view of 0.4 m.',
    ),
    Choice(
        'a found target counts',
        'within 0.075 m of a true one, or half the smallest distance of two targets',
        'Half of the 0.15 m that two markers keep; the paper has an RMSE of 0.08 m.',
    ),
    Choice(
        'control cost C',
        'weight 0.01, torques only',
        'With weight 1 the force that keeps the drone in the air outweighs T and E.',
    ),
    Choice(
        'period of measurements',
        '0.2 m at full speed: 0.5 s, of the ground robot 1 s',
        'Not given. It is the way between two measurements of AS, as in the simulations of 000.',
    ),
    Choice(
        'filter',
        "the paper's preset, with its lengths for the floor",
        'Births where measurements point, T_m = 0.5 and a jitter: as printed nothing is found; '
        'docs/filter_presets.md has each with its reason.',
    ),
    Choice(
        'a run ends',
        'when all are found, or at the cap',
        'As the figures do. A run that does not get there counts with the cap (restricted mean).',
    ),
)
HARDWARE_NOTE = (
    'Simulated hardware: rendered camera images, segmentation, drifting odometry and the '
    "drivers' motion, in one process. The paper flew a real drone once."
)
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
