"""Keep-out regions of one robot, and paths around them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from functools import cached_property, lru_cache

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient
from shapely.ops import nearest_points

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area, edges_of, level_shape
from maasi_planner.guidance import head_for, length_to
from maasi_planner.nearby import nearby_of
from maasi_planner.obstacles import (
    Surroundings,
    Vector,
    all_felt,
    beyond_walls,
    clear_vertices,
    is_clear,
    is_free_at,
)
from maasi_planner.visibility import VisibilityGraph

CORNERS = 12  # of the vertices around a cylinder
# Detail of outlines below this share of the clearance is removed, to the safe side.
_DETAIL = 0.2
_TABLES = 2**22  # numbers in all cached tables
_ANYWHERE = Area([[-1e9, 1e9]] * 2)


class KeepOut:
    """Keep-out regions inflated by the radius of one robot, and paths around them.

    Parameters
    ----------
    area : Area or None
        Area of the robot; None: unlimited.
    radius : float
        Radius of the robot, metres.
    clearance : float
        Distance that paths and waypoints keep in addition, metres.
    reach : float
        Distance at which an obstacle can influence the robot, metres.

    Attributes
    ----------
    circles : (n, 7) array
        As in `Surroundings`, inflated by the radius and a tenth of the clearance, so that rounding
        does not put a robot into an obstacle.
    around : Surroundings
        The same with the data for paths.

    Raises
    ------
    ValueError
        If the radius is invalid.
    """

    def __init__(
        self, area: Area | None, radius: float, clearance: float, reach: float = math.inf
    ) -> None:
        if not (math.isfinite(radius) and radius >= 0.0):
            raise ValueError(f'radius: got {radius}, allowed are finite numbers from 0')
        self.area = _ANYWHERE if area is None else area
        self.radius, self._reach = radius, reach
        self.clearance = float(clearance)
        apart = radius + clearance
        region = self.area.free_space(apart)
        detail = _DETAIL * self.clearance
        inflation = radius + 0.1 * self.clearance
        # At the sides of bounds robots may be on the bounds.
        held = self.area.free_space(inflation)
        walls = None if held is None else _simplified(held, detail)
        self._round = len(self.area.circles)
        self.circles = self._inflated(self.area.circles, walls)
        # Region of waypoints; None: only round obstacles limit it.
        self._allowed = None if region is None else region.buffer(-apart, join_style='mitre')
        if self._allowed is not None:
            shapely.prepare(self._allowed)
        outline = self._allowed
        if walls is not held and region is not None:
            simple = _simplified(region, detail)
            outline = simple.buffer(-apart, join_style='mitre')
        nearby = nearby_of(self.circles, reach, 0.5 * self.clearance)
        spheres = bool((self.circles[:, 4] > 0.5).any())
        none = np.zeros((0, 2))
        self.around = Surroundings(
            self.circles, none, self.clearance, nearby, self._solid_circles(), inflation, spheres
        )
        corners = clear_vertices(self._corners(outline), self.around)
        self.around = self.around._replace(vertices=corners)
        # Tables of the latest waypoints, candidates and chargers.
        most = min(max(_TABLES // max(len(corners), 1), 32), 2048)
        self.table = lru_cache(maxsize=most)(self.to_goal)

    def __len__(self) -> int:
        return len(self.circles)

    def _inflated(self, round_ones: FloatArray, region: BaseGeometry | None) -> FloatArray:
        """Return round obstacles (n, 5) and the walls of a free space as circles, (m, 7)."""
        walls = edges_of([] if region is None else [region])
        circles = np.zeros((len(round_ones) + len(walls), 7))
        circles[: len(round_ones), :5] = round_ones
        circles[len(round_ones) :, [0, 1, 5, 6]] = walls
        circles[:, 3] += self.radius + 0.1 * self.clearance
        return circles

    def _solid_circles(self) -> FloatArray:
        if not self.area.settings.keep_outs:
            return self.circles
        region = self.area.free_space(self.radius + 0.1 * self.clearance, closed=False)
        return self._inflated(self.area.solid, region)

    def _corners(self, outline: BaseGeometry | None) -> FloatArray:
        """Return corners around cylinders and convex walls for the visibility graph, (m, 2)."""
        corners = [np.zeros((0, 2))]
        angles = 2.0 * math.pi * np.arange(CORNERS) / CORNERS
        ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        for circle in self.circles[: self._round]:
            if circle[4] < 0.5:
                reach = (circle[3] + 0.9 * self.clearance) / math.cos(math.pi / CORNERS)
                corners.append(circle[:2] + reach * ring)
        if outline is not None:
            for part in shapely.get_parts(outline.simplify(0.3 * self.clearance)):
                for edge in shapely.get_rings(orient(part)):
                    points = shapely.get_coordinates(edge)[:-1]
                    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
                    one, two = points - before, after - points
                    # Free space is to the left.
                    corners.append(points[one[:, 0] * two[:, 1] < one[:, 1] * two[:, 0]])
        return np.concatenate(corners)

    def pushing(self) -> FloatArray:
        """Return the circles of the obstacle term (001, eq. (14)), without the sides of bounds."""
        low, high = self.area.bounds[:2].T
        middles = self.circles[:, :2] + 0.5 * self.circles[:, 5:]
        inside = ((middles >= low) & (middles <= high)).all(axis=1)
        return self.circles[inside | (self.circles[:, 5:] == 0.0).all(axis=1)]

    @cached_property
    def _graph(self) -> VisibilityGraph:
        return VisibilityGraph(self.around, 0.4 * self.clearance)

    def to_goal(self, goal: Vector) -> FloatArray:
        """Return the lengths of paths from the vertices to a goal for `head_for`, or inf."""
        if not len(self.around.vertices):
            return np.zeros(0)
        return self._graph.to_goal(goal)

    def is_free(self, position: ArrayLike) -> bool:
        """Return whether a robot at `position` (3,) [m] is inside and touches no obstacle."""
        x, y, z = (float(value) for value in np.asarray(position, dtype=float))
        return bool(is_free_at((x, y, z), self.around))

    def path_length(self, position: ArrayLike, goal: ArrayLike) -> float:
        """Return the length of the path between two positions (3,) [m], or inf."""
        x, y, z = (float(value) for value in np.asarray(position, dtype=float))
        to_x, to_y, to_z = (float(value) for value in np.asarray(goal, dtype=float))
        to = (to_x, to_y, to_z)
        return float(length_to((x, y, z), to, self.table(to), self.around))

    def route(self, position: ArrayLike, goal: ArrayLike) -> list[Vector]:
        """Return the corners of the path between two positions (3,) [m]; the last is the goal."""
        x, y, z = np.asarray(position, dtype=float).tolist()
        to_x, to_y, to_z = np.asarray(goal, dtype=float).tolist()
        here, to = (x, y, z), (to_x, to_y, to_z)
        corners: list[Vector] = []
        while here != to and len(corners) <= len(self.around.vertices):
            here = head_for(here, to, self.table(to), self.around, -1).target
            corners.append(here)
        return corners

    def past(
        self, robot: FloatArray, goal: FloatArray, others: Sequence[tuple[FloatArray, float]]
    ) -> FloatArray:
        """Return the next point, (3,), of the path to a goal past others (positions, radii)."""
        area = copy(self.area)
        # A quarter wider, for robots that cut corners.
        discs = [[*point, 1.25 * radius + 0.25 * self.radius, 0.0] for point, radius in others]
        area.circles = np.vstack([area.circles, discs])
        wide = KeepOut(area, self.radius, self.clearance, self._reach)
        x, y, z = robot.tolist()
        to = (goal[0], goal[1], goal[2])
        return np.array(head_for((x, y, z), to, wide.to_goal(to), wide.around, -1).target)

    def exit_from(self, position: ArrayLike) -> FloatArray | None:
        """Return where a robot at a position (3,) leaves the zone that it is in, or None outside.

        It is the nearest clear position that a straight line reaches without obstacles and, if
        possible, other zones; otherwise the first point of the path there.
        """
        if self.is_free(position):
            return None
        x, y, z = np.asarray(position, dtype=float).tolist()
        touching = self.circles.copy()
        touching[:, 3] -= 0.1 * self.clearance
        clear = is_clear((x, y, z), (x, y, z), all_felt(touching), 0.0, False)
        if clear and not beyond_walls((x, y, z), self.around):
            return None
        if self._open.is_empty:
            return None
        point = shapely.Point(x, y)
        # Past other zones, or through them without another exit.
        zones = self.area.shapes['keep_out']
        others = [zone for zone in zones if zone.distance(point) > self.radius]
        past_others = self._solid.difference(shapely.union_all(others).buffer(self.radius))
        # With a margin if possible, as lines are not followed exactly.
        margin = 0.5 * self.clearance
        ample = past_others.buffer(-margin)
        allowed_ones = (ample, past_others, self._solid) if others else (ample, self._solid)
        for allowed in allowed_ones:
            near = self._straight_exit(point, allowed)
            if near is not None:
                return np.array([near.x, near.y, z])
        near = nearest_points(self._open, point)[0]
        lasting = Area(self.area.settings.without_keep_outs())
        around = KeepOut(lasting, self.radius, self.clearance, self._reach)
        goal = (near.x, near.y, z)
        heading = head_for((x, y, z), goal, around.to_goal(goal), around.around, -1)
        return np.array([*heading.target[:2], z])

    def _straight_exit(self, point: shapely.Point, allowed: BaseGeometry) -> shapely.Point | None:
        """Return the nearest clear point that an allowed straight line reaches."""
        near = nearest_points(self._open, point)[0]
        shapely.prepare(allowed)
        if allowed.covers(shapely.LineString([point, near])):
            return near
        outline = shapely.get_coordinates(self._open.segmentize(0.5 * self._step))
        ends = [[(point.x, point.y), corner] for corner in outline.tolist()]
        lines = shapely.linestrings(ends)
        rows = np.flatnonzero(shapely.covers(allowed, lines))
        if not len(rows):
            return None
        return shapely.Point(outline[rows[np.argmin(shapely.length(lines[rows]))]])

    @cached_property
    def _open(self) -> BaseGeometry:
        """Region of robots that leave a zone: clear of everything by the clearance."""
        reach = self.circles[: self._round, 3] + 0.95 * self.clearance
        centres = shapely.points(self.circles[: self._round, :2])
        discs = shapely.buffer(centres, reach / math.cos(math.pi / 64), quad_segs=16)
        whole = self.area.border if self._allowed is None else self._allowed
        return whole.difference(shapely.union_all(discs))

    @cached_property
    def _solid(self) -> BaseGeometry:
        """Region of a robot that leaves a zone: inside of the border, clear of obstacles."""
        solid = shapely.union_all(list(map(level_shape, self.area.settings.obstacles)))
        inside = self.area.border.difference(solid.buffer(self.radius))
        shapely.prepare(inside)
        return inside

    @property
    def _step(self) -> float:
        return max(self.radius + self.clearance, 1e-3)

    def moved_out(self, robot: ArrayLike, waypoint: ArrayLike) -> FloatArray | None:
        """Return a waypoint moved to the minimum admissible distance (001, section 4.3), or None.

        It is moved away from walls, and then out of round obstacles towards the robot.
        """
        start = np.asarray(robot, dtype=float)
        point = np.array(waypoint, dtype=float)
        if self._allowed is not None:
            if self._allowed.is_empty:
                return None
            level = shapely.Point(point[:2])
            if not self._allowed.covers(level):
                near = nearest_points(self._allowed, level)[0]
                if near.distance(level) > 1e-9:
                    point[:2] = near.x, near.y
        line = point - start
        part = 1.0
        round_ones = self.circles[: self._round]
        least = round_ones[:, 3] + 0.9 * self.clearance
        for _ in range(len(round_ones) + 1):
            here = start + part * line
            changed = False
            for circle, reach in zip(round_ones, least):
                keep = np.array([1.0, 1.0, circle[4]])
                offset = (here - circle[:3]) * keep
                if float(offset @ offset) >= reach * reach * (1.0 - 1e-12):
                    continue
                direction = line * keep
                from_start = (start - circle[:3]) * keep
                a = float(direction @ direction)
                b = float(direction @ from_start)
                c = float(from_start @ from_start) - reach * reach
                if c < 0.0 or a == 0.0:
                    return None
                part = (-b - math.sqrt(max(b * b - a * c, 0.0))) / a
                here = start + part * line
                changed = True
            if not changed:
                return point if part == 1.0 else here if self.is_free(here) else None
            if part <= 0.0:
                return None
        return None


def _simplified(region: BaseGeometry, detail: float) -> BaseGeometry:
    """Return a region without finer detail than given [m], inside of the original."""
    if shapely.get_num_coordinates(region.simplify(detail)) == shapely.get_num_coordinates(region):
        return region
    return region.buffer(-detail, join_style='mitre').simplify(detail)


#: Shared KeepOut of equal robots.
shared_keep_out = lru_cache(maxsize=64)(KeepOut)
