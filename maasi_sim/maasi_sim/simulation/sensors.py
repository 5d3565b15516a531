"""Simulated range sensors: range, bearing and elevation of targets, and a laser scanner."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.models.measurement import wrap_angle
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.settings import NotNegative, Positive, Settings
from maasi_sim.simulation.world import noise_stream


class RangingSensor:
    """A robot's ranging sensor (000, eq. (3) to (9)); seed, robot and step key its random numbers.

    Shapes and units: targets (n, 2 or 3), true positions, and bounds (d, 2) of clutter [m, map].
    It does not see targets that the `terrain` hides.
    """

    def __init__(
        self,
        sensor: Sensor,
        targets: FloatArray,
        seed: int,
        robot: str,
        bounds: FloatArray | None = None,
        terrain: Terrain | None = None,
    ) -> None:
        self.sensor = sensor
        self.targets = np.asarray(targets, dtype=float)
        self.seed, self.robot = seed, robot
        self.bounds, self.terrain = bounds, terrain
        self._spread = np.linalg.cholesky(sensor.covariance)

    def measure(
        self, pose: Pose, step: int, targets: FloatArray | None = None
    ) -> tuple[FloatArray, IntArray]:
        """Return one sweep in random order, and the index of each return's target, -1 for clutter.

        Shapes and units: targets (n, 2 or 3) [m, map], where they have moved; returned (m, d) [m,
        rad], bearings from the map's x axis, and (m,).
        """
        dimension = self.sensor.dimension
        generator = noise_stream(self.seed, self.robot, step, 'ranging')
        count = len(self.targets)
        # The number of draws does not depend on detections: targets do not affect each other.
        chance = generator.random(count)
        noise = generator.standard_normal((count, dimension))
        positions = (self.targets if targets is None else targets)[:, :dimension]
        values = self.sensor.measurement.measure(positions, pose)
        seen = chance < self.sensor.detection.probability(positions, pose)
        seen &= values[:, 0] <= self.sensor.maximum_range
        if self.terrain is not None:
            seen[seen] = self.terrain.visible(
                pose.position, self.terrain.on_ground(positions[seen])
            )
        # Summed in a fixed order: the result must not depend on the linear algebra library.
        errors = np.zeros((count, dimension))
        for column in range(dimension):
            errors += noise[:, column, None] * self._spread[:, column]
        returns, causes = (values + errors)[seen], np.flatnonzero(seen)
        if self.sensor.clutter > 0.0 and self.bounds is not None:
            clutter = self._clutter(generator, self.bounds, pose)
            returns = np.concatenate([returns, clutter])
            causes = np.concatenate([causes, np.full(len(clutter), -1)])
        order = generator.permutation(len(returns))
        returns, causes = returns[order], causes[order]
        returns[:, 0] = np.maximum(returns[:, 0], 1e-6)
        returns[:, 1] = wrap_angle(returns[:, 1])
        if dimension == 3:
            returns[:, 2] = np.clip(returns[:, 2], -0.5 * math.pi, 0.5 * math.pi)
        return returns, causes

    def _clutter(
        self, generator: np.random.Generator, bounds: FloatArray, pose: Pose
    ) -> FloatArray:
        """Return false detections, uniform in range and angles or in the bounds."""
        if self.sensor.clutter_in == 'area':
            low, high = bounds.T
        else:
            size = bounds[:, 1] - bounds[:, 0]
            reach = min(math.sqrt(float((size * size).sum())), self.sensor.maximum_range)
            low = np.array([0.0, -math.pi, -0.5 * math.pi][: len(bounds)])
            high = np.array([reach, math.pi, 0.5 * math.pi][: len(bounds)])
        number = generator.poisson(self.sensor.clutter * float(np.prod(high - low)))
        clutter = generator.uniform(low, high, size=(number, len(bounds)))
        if self.sensor.clutter_in == 'measurements':
            return clutter
        values = self.sensor.measurement.measure(clutter, pose)
        return values[values[:, 0] <= self.sensor.maximum_range]


class LaserSettings(Settings):
    """A planar laser scanner; defaults of the TurtleBot3's."""

    beams: int = Field(360, ge=1, le=100_000, description='Beams per turn [1]')
    minimum_range: NotNegative = Field(0.12, description='Smallest range [m]')
    maximum_range: Positive = Field(3.5, description='Largest range [m]')
    noise: NotNegative = Field(0.01, description='Deviation of ranges [m]')
    rate: Positive = Field(5.0, description='Turns per second [Hz]')
    wall_margin: NotNegative = Field(
        0.3, description='Distance of the walls outside the bounds [m]'
    )

    @model_validator(mode='after')
    def _ordered(self) -> LaserSettings:
        if self.maximum_range <= self.minimum_range:
            raise ValueError(
                f'maximum_range: got {self.maximum_range}, '
                f'allowed is more than minimum_range ({self.minimum_range})'
            )
        return self


@njit(cache=True)
def _cast(x, y, yaw, count, things, ranges):  # type: ignore[no-untyped-def]
    """Compute ranges (count,) of beams from yaw, anticlockwise, to circles, edges (n, 4), walls."""
    circles, edges, walls = things
    for beam in range(count):
        angle = yaw + 2.0 * math.pi * beam / count
        dx, dy = math.cos(angle), math.sin(angle)
        nearest = np.inf
        # Walls: lower and upper x, lower and upper y; seen from inside only.
        if dx > 0.0 and x < walls[1]:
            nearest = min(nearest, (walls[1] - x) / dx)
        elif dx < 0.0 and x > walls[0]:
            nearest = min(nearest, (walls[0] - x) / dx)
        if dy > 0.0 and y < walls[3]:
            nearest = min(nearest, (walls[3] - y) / dy)
        elif dy < 0.0 and y > walls[2]:
            nearest = min(nearest, (walls[2] - y) / dy)
        for i in range(edges.shape[0]):
            ox, oy, ex, ey = edges[i, 0] - x, edges[i, 1] - y, edges[i, 2], edges[i, 3]
            across = dx * ey - dy * ex
            if across != 0.0 and 0.0 <= (ox * dy - oy * dx) / across <= 1.0:
                along = (ox * ey - oy * ex) / across
                nearest = min(nearest, along) if along >= 0.0 else nearest
        for i in range(circles.shape[0]):
            ox, oy = circles[i, 0] - x, circles[i, 1] - y
            along = ox * dx + oy * dy
            gap = ox * ox + oy * oy - along * along
            square = circles[i, 2] * circles[i, 2] - gap
            if square >= 0.0:
                half = math.sqrt(square)
                if along - half > 0.0:
                    nearest = min(nearest, along - half)
                elif along + half > 0.0:
                    nearest = 0.0
        ranges[beam] = nearest


class LaserScanner:
    """A robot's laser scanner at its origin, first beam straight ahead; walls around the bounds.

    It sees the area's solid objects and other robots.
    """

    def __init__(self, settings: LaserSettings, area: Area, seed: int, robot: str) -> None:
        self.settings, self.seed, self.robot = settings, seed, robot
        margin = settings.wall_margin
        low, high = area.bounds[:2, 0] - margin, area.bounds[:2, 1] + margin
        self._walls = np.array([low[0], high[0], low[1], high[1]])
        self._circles = area.solid[:, [0, 1, 3]]
        self._edges = area.solid_edges()

    def scan(
        self, pose: Pose, step: int, centres: ArrayLike = (), radii: ArrayLike = ()
    ) -> NDArray[np.float32]:
        """Return the ranges of one turn (beams,), anticlockwise from straight ahead [m].

        Infinite without a return, minus infinite below the minimum range (REP 117).
        `centres`, `radii`: further circles, the other robots.
        """
        settings = self.settings
        circles = np.concatenate([self._circles, _circles(centres, radii)])
        ranges = np.empty(settings.beams)
        x, y = float(pose.position[0]), float(pose.position[1])
        _cast(x, y, pose.yaw, settings.beams, (circles, self._edges, self._walls), ranges)
        noise = noise_stream(self.seed, self.robot, step, 'laser').standard_normal(settings.beams)
        ranges += settings.noise * noise
        ranges[ranges > settings.maximum_range] = np.inf
        ranges[ranges < settings.minimum_range] = -np.inf
        return ranges.astype(np.float32)


def _circles(centres: ArrayLike, radii: ArrayLike) -> FloatArray:
    radius = np.asarray(radii, dtype=float).reshape(-1)
    centre = np.asarray(centres, dtype=float)
    centre = centre.reshape(len(radius), centre.shape[-1] if centre.ndim > 1 else 2)
    return np.concatenate([centre[:, :2], radius[:, None]], axis=1)
