"""The volume of one robot: an area with lowest and highest coordinates."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.wording import point

MARGIN = 0.5  # drift outside at which the driver acts [m]


@dataclass(eq=False)
class OperatingVolume:
    """Volume of one robot: an area, and limits (3, 2) of its goals, the geofence [m, map].

    Over terrain the limits of z are heights above ground.
    """

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
            return f': read {point(position)}, allowed is {allowed}'
        if self.area.terrain is None:
            problem = _beyond(self.limits, position)
            return problem and f'{problem}, the geofence'
        low, high = self.limits[2].tolist()
        height = float(position[2]) - self._ground(position)
        if not low <= height <= high:
            allowed = f'allowed is {low:g} to {high:g} m, the geofence'
            return f'.z: read {position[2]:.6g}, {height:.2f} m above the ground; {allowed}'
        problem = _beyond(self.limits[:2], position)
        return problem and f'{problem}, the geofence'

    def _ground(self, position: Sequence[float] | FloatArray) -> float:
        return 0.0 if self.area.terrain is None else self.area.terrain.height(position)

    def nearest_inside(self, position: FloatArray) -> FloatArray:
        """Return the nearest position inside the limits."""
        inside = np.clip(position, self.limits[:, 0], self.limits[:, 1])
        if self.area.terrain is not None:
            # Above the ground of its horizontal position.
            ground = self._ground(inside)
            inside[2] = ground + min(
                max(position[2] - ground, self.limits[2, 0]), self.limits[2, 1]
            )
        return inside

    def distance_outside(self, position: FloatArray) -> float:
        """Return the distance of a position (3,) from the limits along an axis [m]; 0 inside."""
        return float(np.abs(position - self.nearest_inside(position)).max())

    def beyond_border(self, position: FloatArray) -> tuple[float, float]:
        """Return the distance of a position (3,) from the area, and that allowed for goals [m]."""
        overhang = self.radius if self.area.settings.area is None else 0.0
        return self.area.outside_by(position), overhang

    def drift_problem(self, position: FloatArray) -> str:
        """Return how a robot is too far outside of the limits; below them it may land."""
        level = [*position[:2].tolist(), float(position[2]) - self._ground(position)]
        for axis, value, (low, high) in zip('xyz', level, self.limits.tolist()):
            lowest = -math.inf if axis == 'z' else low - MARGIN
            if not lowest <= value <= high + MARGIN:
                return f'{axis} at {value:.2f} m, outside the geofence, {low:g} to {high:g} m'
        return ''


def _beyond(limits: FloatArray, position: Sequence[float]) -> str:
    for axis, value, (low, high) in zip('xyz', position, limits.tolist()):
        if not low <= value <= high:
            return f'.{axis}: read {value:.6g}, allowed is {low:g} to {high:g} [m]'
    return ''
