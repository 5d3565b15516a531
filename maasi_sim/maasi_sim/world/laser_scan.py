"""A simulated planar laser scanner: rays against circles and the walls of the environment."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from maasi_filter.models.pose import Pose
from maasi_filter.settings import Settings
from maasi_sim.world.noise_streams import noise_stream

Array = NDArray[np.float64]


class LaserSettings(Settings):
    """A planar laser scanner; the defaults are those of the TurtleBot3's."""

    beams: int = Field(default=360, ge=1, le=100_000, description='Beams of a full turn [1]')
    minimum_range: float = Field(default=0.12, ge=0.0, description='Nearest return [m]')
    maximum_range: float = Field(default=3.5, gt=0.0, description='Farthest return [m]')
    noise: float = Field(default=0.01, ge=0.0, description='Deviation of a range [m]')
    rate: float = Field(default=5.0, gt=0.0, description='Turns per second [Hz]')
    wall_margin: float = Field(
        default=0.3, ge=0.0, description='Distance of the walls outside the bounds [m]'
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
def _cast(x, y, yaw, count, circles, walls, ranges):  # type: ignore[no-untyped-def]
    """Ranges (count,) of beams from yaw on, anticlockwise, to circles (n, 3) and walls (4,)."""
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
    """
    One robot's laser scanner, at its origin, first beam straight ahead.

    Parameters
    ----------
    settings : LaserSettings
        Beams, limits, noise.
    bounds : ndarray, shape (d, 2)
        Of the environment; its walls stand ``wall_margin`` outside [m].
    centres : array_like, shape (n, 2) or (n, 3)
        Of the obstacles [m].
    radii : array_like, shape (n,)
        [m].
    seed : int
        Of the run.
    robot : str
        Name of the robot.

    """

    def __init__(
        self,
        settings: LaserSettings,
        bounds: Array,
        centres: ArrayLike,
        radii: ArrayLike,
        seed: int,
        robot: str,
    ) -> None:
        self.settings = settings
        self.seed = seed
        self.robot = robot
        margin = settings.wall_margin
        low, high = bounds[:2, 0] - margin, bounds[:2, 1] + margin
        self._walls = np.array([low[0], high[0], low[1], high[1]])
        self._circles = _circles(centres, radii)

    def scan(
        self, pose: Pose, step: int, centres: ArrayLike = (), radii: ArrayLike = ()
    ) -> NDArray[np.float32]:
        """
        Return the ranges of one turn.

        Parameters
        ----------
        pose : Pose
            True pose of the robot in the map frame.
        step : int
            Discrete step, which keys the noise.
        centres, radii : array_like, shapes (n, 2) and (n,)
            Further circles: the other robots [m].

        Returns
        -------
        ndarray, shape (beams,), float32
            Anticlockwise from straight ahead [m]; infinite without a return, minus infinite below
            the minimum range (REP 117).
        """
        settings = self.settings
        circles = np.concatenate([self._circles, _circles(centres, radii)])
        ranges = np.empty(settings.beams)
        x, y = float(pose.position[0]), float(pose.position[1])
        _cast(x, y, pose.yaw, settings.beams, circles, self._walls, ranges)
        noise = noise_stream(self.seed, self.robot, step, 'laser').standard_normal(settings.beams)
        ranges += settings.noise * noise
        ranges[ranges > settings.maximum_range] = np.inf
        ranges[ranges < settings.minimum_range] = -np.inf
        return ranges.astype(np.float32)


def _circles(centres: ArrayLike, radii: ArrayLike) -> Array:
    radius = np.asarray(radii, dtype=float).reshape(-1)
    centre = np.asarray(centres, dtype=float)
    centre = centre.reshape(len(radius), centre.shape[-1] if centre.ndim > 1 else 2)
    return np.concatenate([centre[:, :2], radius[:, None]], axis=1)
