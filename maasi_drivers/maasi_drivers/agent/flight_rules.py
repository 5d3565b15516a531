"""What a flying robot may do: take off when permitted, and fly inside a geofence. Without ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from maasi_filter.arrays import FloatArray

# Reason in `state` while a vehicle waits for it.
UNTIL_ARM = 'until the service arm is called'


class ArmPermission:
    """Whether a vehicle may take off: one take-off for each call of the service.

    Units: timeout [s].
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._end = -math.inf

    def give(self, now: float) -> None:
        """Give it, from `now` on the steady clock [s]."""
        self._end = now + self.timeout

    def end(self) -> bool:
        """End it, as after a take-off or a refusal; return whether there was one."""
        given, self._end = self._end > -math.inf, -math.inf
        return given

    def holds(self, now: float) -> bool:
        """Return whether there is one."""
        return now < self._end

    def expired(self, now: float) -> bool:
        """Return whether a permission has just expired."""
        return now >= self._end and self.end()


# Between the start's height and the geofence, where none is given [m].
_HEIGHT = 1.0
# How far outside it may drift before it lands [m].
MARGIN = 0.5


def make_fence(
    given: list[list[float]] | None, bounds: FloatArray, radius: float, ground: float, start: float
) -> FloatArray:
    """Return the lowest and highest x, y, z (3, 2) of goals [m, map].

    Shapes and units: bounds (2 or 3, 2) [m]; radius [m]; ground, start [m].
    """
    return _fence(given, bounds, radius, (ground, start + _HEIGHT))


def make_vehicle_fence(
    given: list[list[float]] | None, bounds: FloatArray, radius: float, ground: float, start: float
) -> FloatArray:
    """Return the lowest and highest x, y, z (3, 2) of the goals of a vehicle that may also dive.

    As `make_fence`; by default from 1 m below the lower to 1 m above the higher one of ground and
    start, but not below the ground for what starts above it.
    """
    heights = (min(ground, start) - _HEIGHT, max(ground, start) + _HEIGHT)
    fence = _fence(given, bounds, radius, heights)
    if given is None and start > ground:
        fence[2, 0] = max(fence[2, 0], ground)
    return fence


def _fence(
    given: list[list[float]] | None,
    bounds: FloatArray,
    radius: float,
    heights: tuple[float, float],
) -> FloatArray:
    if given is not None:
        return np.array(given)
    fence = np.array([[0.0, 0.0], [0.0, 0.0], heights])
    fence[: len(bounds)] = bounds + np.array([-radius, radius])
    return fence


def fence_problem(fence: FloatArray, point: Sequence[float]) -> str | None:
    """Return why a waypoint (x, y, z) is not allowed, or nothing."""
    for axis, value in enumerate(point):
        low, high = fence[axis].tolist()
        if not low <= value <= high:
            return (
                f'waypoint.pose.position.{"xyz"[axis]}: read {value}, allowed is {low:g} to '
                f'{high:g} [m], the geofence'
            )
    return None


def outside_fence(fence: FloatArray, position: FloatArray) -> str:
    """Return where a robot is too far outside, or nothing; below the fence it may land."""
    for axis, (low, high) in enumerate(fence.tolist()):
        lowest = -math.inf if axis == 2 else low - MARGIN
        if not lowest <= position[axis] <= high + MARGIN:
            return (
                f'{"xyz"[axis]} at {position[axis]:.2f} m, outside the geofence, '
                f'{low:g} to {high:g} m'
            )
    return ''
