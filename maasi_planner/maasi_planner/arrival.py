"""How near its waypoint a robot takes its next decision, so that it need not stop there."""

from __future__ import annotations

import math

from maasi_filter.models.detection import BOX
from maasi_filter.models.sensor import Sensor
from maasi_planner.motion import MotionModel
from maasi_planner.planners import Planner


def arrival_radius(motion: MotionModel, sensor: Sensor, planner: Planner) -> float:
    """Return the distance from its waypoint at which a robot takes its next decision [m].

    The setting `arrival_radius` where it is given. Else 0, as in 000, for the objective of the
    papers and for planners that measure at waypoints only; and for the others the distance at
    which the robot begins to brake, at most what its sensor sees to each side: what it would have
    seen from the waypoint is then still seen from its path.
    """
    given = motion.settings.arrival_radius
    if given is not None:
        return given
    if planner.settings.objective == 'paper' or not planner.measures_underway:
        return 0.0
    return min(motion.braking_distance(), _view(sensor))


def _view(sensor: Sensor) -> float:
    """Return how far a sensor sees level to each side [m]: half its box, or F."""
    kind, parameters = sensor.detection.kernel()
    if kind == BOX:
        low, high = parameters[1:3], parameters[4:6]
        return 0.5 * float((high - low).min())
    scale = float(parameters[1:3].max())
    return 1.0 / scale if scale > 0.0 else math.inf
