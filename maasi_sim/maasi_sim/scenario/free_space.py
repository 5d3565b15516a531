"""Free space of a robot: connected parts of its area, and reachability of chargers."""

import math
from functools import cached_property, lru_cache

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely.geometry.base import BaseGeometry
from shapely.ops import nearest_points

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_planner.keep_out import KeepOut
from maasi_sim.scenario.schema import RobotSettings

_ROUNDING = 1e-6  # [m]
# Smallest share of the clearance that a robot keeps, as its motion model does.
_LEAST = 0.1
# Smaller parts, relative to its own, and those beyond this number are ignored.
_SMALL, _MOST_PARTS = 1e-3, 50


class FreeSpace:
    """The level parts of an area that the centre of a robot can be in.

    It keeps radius and clearance to the border, keep-out zones and obstacles, but no distance
    to plain bounds. Robots pass above or below spheres, which are ignored.
    """

    def __init__(self, robot: RobotSettings, area: Area) -> None:
        self.robot, self.area = robot, area

    @cached_property
    def parts(self) -> list[BaseGeometry]:
        """Connected parts of its possible targets, the largest first."""
        parts = _parts(self.area, self._reach, self._reach)
        return sorted((part for part in parts if part.area > 0.0), key=lambda part: -part.area)

    @cached_property
    def reachable(self) -> list[BaseGeometry]:
        """Parts that are reachable from its start."""
        own, others = self._parts_of(self.robot.start)
        if not others:
            return own
        # Narrow passages may join them.
        height = self.robot.start[2]
        large = [part for part in others if part.area > _SMALL * own[0].area][:_MOST_PARTS]
        points = [[*part.representative_point().coords[0], height] for part in large]
        reached = [part for part, point in zip(large, points) if self.gets_to(point)]
        return sorted([*own, *reached], key=lambda part: -part.area)

    def gap(self, position: ArrayLike) -> float:
        """Return the distance of a position (3,) to border, keep-out zones and obstacles [m]."""
        x, y, z = np.asarray(position, dtype=float).tolist()
        point, reach = shapely.Point(x, y), self._reach
        space = self.area.free_space(reach)
        gaps = [math.inf]
        if space is not None:
            gaps.append(space.boundary.distance(point) if space.covers(point) else 0.0)
        for cx, cy, cz, radius, sphere in self.area.circles.tolist():
            gaps.append(math.hypot(cx - x, cy - y, (cz - z) * sphere) - radius)
        return max(min(gaps), 0.0)

    def gets_to(self, position: ArrayLike) -> bool:
        """Return whether a position (3,) is reachable from the robot's start."""
        here, goal = (shapely.Point(np.asarray(at)[:2]) for at in (self.robot.start, position))
        least = self.robot.radius + _LEAST * self.robot.motion.clearance
        widest = _parts(self.area, least, self._reach)
        # A robot that starts too close to a wall moves away from it first.
        one, other = _part_at(widest, here, self._reach), _part_at(widest, goal)
        if one is None or other is not one:
            return False
        first = shapely.get_coordinates(nearest_points(one, here)[0])[0]
        inner = _part_at(self.parts, here)
        if inner is not None and inner is _part_at(self.parts, goal):
            return True
        # Joined by a passage narrower than its clearance: decided by its path planner.
        start = [*first, self.robot.start[2]]
        return math.isfinite(self._keep_out.path_length(start, position))

    @cached_property
    def _keep_out(self) -> KeepOut:
        return KeepOut(self.area, self.robot.radius, self.robot.motion.clearance)

    @property
    def _reach(self) -> float:
        return self.robot.radius + self.robot.motion.clearance

    def _parts_of(self, position: ArrayLike) -> tuple[list[BaseGeometry], list[BaseGeometry]]:
        """Return the part that contains a position or is closest to it, and the others."""
        point = shapely.Point(np.asarray(position)[:2])
        if not self.parts:
            return [], []
        nearest = int(np.argmin(shapely.distance(self.parts, point)))
        return [self.parts[nearest]], [*self.parts[:nearest], *self.parts[nearest + 1 :]]


# Robots of the same size share it.
@lru_cache(maxsize=16)
def _parts(area: Area, apart: float, reach: float) -> list[BaseGeometry]:
    """Return the parts in which a centre keeps its distance to everything."""
    space, region = area.free_space(reach), area.border
    if space is not None:
        region = space.buffer(-apart, join_style='mitre').intersection(region)
    circles: FloatArray = area.circles[area.circles[:, 4] < 0.5]
    discs = shapely.buffer(shapely.points(circles[:, :2]), circles[:, 3] + apart, quad_segs=32)
    return list(shapely.get_parts(region.difference(shapely.union_all(discs))))


def _part_at(
    parts: list[BaseGeometry], point: shapely.Point, within: float = _ROUNDING
) -> BaseGeometry | None:
    """Return the part that a position is in, or the nearest one within a distance [m]."""
    gaps = shapely.distance(parts, point) if parts else np.array([math.inf])
    nearest = int(np.argmin(gaps))
    return parts[nearest] if gaps[nearest] <= within else None
