"""The volume of one robot: an area with lowest and highest coordinates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area

MARGIN = 0.5  # drift outside at which the driver acts [m]


@dataclass(eq=False)
class OperatingVolume:
    """Volume of one robot: an area, and limits (3, 2) of its goals, the geofence [m, map]."""

    area: Area
    radius: float
    limits: FloatArray = field(default_factory=lambda: np.tile([-math.inf, math.inf], (3, 1)))

    def goal_problem(self, position: Sequence[float]) -> str:
        """Return why a position (3,) is not allowed as a goal; empty if it is."""
        bounds = self.area.bounds + np.array([-self.radius, self.radius])
        if problem := _beyond(bounds, position):
            return problem
        if not self.area.inside([position], bounded=False)[0]:
            allowed = 'what lies inside the area and outside of its keep-outs'
            return f': read {list(position)}, allowed is {allowed}'
        problem = _beyond(self.limits, position)
        return problem and f'{problem}, the geofence'

    def nearest_inside(self, position: FloatArray) -> FloatArray:
        """Return the nearest position inside the limits."""
        return np.clip(position, self.limits[:, 0], self.limits[:, 1])

    def distance_outside(self, position: FloatArray) -> float:
        """Return the distance of a position (3,) from the limits along an axis [m]; 0 inside."""
        return float(np.abs(position - self.nearest_inside(position)).max())

    def beyond_border(self, position: FloatArray) -> tuple[float, float]:
        """Return the distance of a position (3,) from the area, and that allowed for goals [m]."""
        overhang = self.radius if self.area.settings.area is None else 0.0
        return self.area.outside_by(position), overhang

    def drift_problem(self, position: FloatArray) -> str:
        """Return how a robot is too far outside of the limits; below them it may land."""
        for axis, value, (low, high) in zip('xyz', position.tolist(), self.limits.tolist()):
            lowest = -math.inf if axis == 'z' else low - MARGIN
            if not lowest <= value <= high + MARGIN:
                return f'{axis} at {value:.2f} m, outside the geofence, {low:g} to {high:g} m'
        return ''


def _beyond(limits: FloatArray, position: Sequence[float]) -> str:
    for axis, value, (low, high) in zip('xyz', position, limits.tolist()):
        if not low <= value <= high:
            return f'.{axis}: read {value}, allowed is {low:g} to {high:g} [m]'
    return ''
