"""Simulated odometry: starts at zero, with noise and drift that grows with distance."""

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose, inverse
from maasi_filter.settings import NotNegative, Settings
from maasi_planner.motion import RobotState
from maasi_sim.simulation.world import noise_stream

_LEAST_VARIANCE = 1e-12  # keeps reported variances positive, as consumers invert them


class OdometrySettings(Settings):
    """Errors of a robot's odometry; all zero: perfect."""

    position_noise: NotNegative = Field(
        0.002, description='Deviation of each coordinate, independent at each step [m]'
    )
    heading_noise: NotNegative = Field(
        0.002, description='Deviation of the heading, independent at each step [rad]'
    )
    velocity_noise: NotNegative = Field(
        0.005, description='Deviation of each velocity component [m/s]'
    )
    position_drift: NotNegative = Field(
        0.0,
        description='Deviation of the drift of x and y after one metre; grows with the root of '
        'the path length [m]',
    )
    heading_drift: NotNegative = Field(
        0.0,
        description='Deviation of the drift of the heading after one metre; grows with the root '
        'of the path length [rad]',
    )
    position_offset: NotNegative = Field(
        0.0,
        description='Length of a constant position error in a random direction of each run; '
        'horizontal for robots on the floor [m]',
    )


@dataclass(frozen=True)
class OdometryReading:
    """Odometry of one step, as in ``nav_msgs/Odometry``."""

    pose: Pose  # in the frame of the robot at the start
    covariance: FloatArray  # (6, 6) of the pose [m, rad]
    velocity: FloatArray  # in the robot's frame [m/s]
    angular_velocity: FloatArray  # in the robot's frame [rad/s]


class OdometryModel:
    """A robot's odometry, zero at its start.

    Height, roll and pitch have noise only; x, y and heading also drift. The covariance
    describes the errors of `reported`, by default those of `settings`.
    """

    def __init__(
        self,
        settings: OdometrySettings,
        start: Pose,
        seed: int,
        robot: str,
        reported: OdometrySettings | None = None,
    ) -> None:
        self.settings = settings
        self.reported = reported or settings
        self.seed, self.robot = seed, robot
        # Plain numbers: small arrays are several times slower.
        to_start = inverse(Pose.from_yaw(start.position, start.yaw))
        self._shift = to_start.position.tolist()
        self._rotation = to_start.rotation().tolist()
        self._quaternion = to_start.orientation.tolist()
        self._last = self._from_start(*start.position.tolist())
        self._offset = (0.0, 0.0)
        self._turn = 0.0
        axes = 3 if start.position[2] > 0.0 else 2
        self._constant = np.zeros(3)  # the constant error of the position [m]
        if settings.position_offset > 0.0:
            drawn = noise_stream(seed, robot, 0, 'offset').standard_normal(axes)
            self._constant[:axes] = drawn * (settings.position_offset / math.hypot(*drawn))
        offset = np.zeros(3)
        offset[:axes] = self.reported.position_offset**2 / axes
        self._noise_covariance = np.diag(
            [*(self.reported.position_noise**2 + _LEAST_VARIANCE + offset)]
            + [_LEAST_VARIANCE] * 2
            + [self.reported.heading_noise**2 + _LEAST_VARIANCE]
        )
        # Covariance of the drift of x, y and heading h: xx, xy, yy, xh, yh, hh.
        self._drift = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def step(self, state: RobotState, step: int) -> OdometryReading:
        """Return the odometry of the next true state; the discrete step keys the noise."""
        settings = self.settings
        generator = noise_stream(self.seed, self.robot, step, 'odometry')
        dx, dy, dh, nx, ny, nz, nh, *twist_noise = generator.standard_normal(13).tolist()
        x, y, z = self._from_start(*state.pose.position.tolist())
        move_x, move_y = x - self._last[0], y - self._last[1]
        distance = math.sqrt(move_x * move_x + move_y * move_y)
        drifts = (settings, self.reported)
        if distance > 0.0 and any(one.position_drift + one.heading_drift > 0.0 for one in drifts):
            root = math.sqrt(distance)
            before = self._place(x, y)
            self._turn += settings.heading_drift * root * dh
            # A heading error rotates the estimate around the robot, not around the origin.
            after = self._place(x, y)
            drift = settings.position_drift * root
            self._offset = (
                self._offset[0] + before[0] - after[0] + drift * dx,
                self._offset[1] + before[1] - after[1] + drift * dy,
            )
            self._grow(move_x, move_y, distance)
        self._last = (x, y, z)
        noise = settings.position_noise
        place = self._place(x, y)
        half = 0.5 * (self._turn + settings.heading_noise * nh)
        w1, z1 = math.cos(half), math.sin(half)
        attitude = state.pose.orientation.tolist()
        w2, x2, y2, z2 = _product(self._quaternion, attitude)
        linear, angular = settings.velocity_noise, settings.heading_noise
        velocity = _into_body(attitude, state.velocity.tolist())
        turning = state.angular_velocity.tolist()
        return OdometryReading(
            Pose(
                np.array([place[0] + noise * nx, place[1] + noise * ny, z + noise * nz])
                + self._constant,
                np.array(
                    [w1 * w2 - z1 * z2, w1 * x2 - z1 * y2, w1 * y2 + z1 * x2, w1 * z2 + z1 * w2]
                ),
            ),
            self._covariance(),
            np.array([v + linear * n for v, n in zip(velocity, twist_noise[:3])]),
            np.array([v + angular * n for v, n in zip(turning, twist_noise[3:])]),
        )

    def _from_start(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        (a, b, c), (d, e, f), (g, h, i) = self._rotation
        tx, ty, tz = self._shift
        return (tx + a * x + b * y + c * z, ty + d * x + e * y + f * z, tz + g * x + h * y + i * z)

    def _place(self, x: float, y: float) -> tuple[float, float]:
        cosine, sine = math.cos(self._turn), math.sin(self._turn)
        return (self._offset[0] + cosine * x - sine * y, self._offset[1] + sine * x + cosine * y)

    def _grow(self, move_x: float, move_y: float, distance: float) -> None:
        """Propagate the covariance of the drift over a move, which a heading error rotates."""
        cosine, sine = math.cos(self._turn), math.sin(self._turn)
        # d(x, y) / d(heading).
        a = -(sine * move_x + cosine * move_y)
        b = cosine * move_x - sine * move_y
        xx, xy, yy, xh, yh, hh = self._drift
        place = distance * self.reported.position_drift**2
        self._drift = (
            xx + 2.0 * a * xh + a * a * hh + place,
            xy + a * yh + b * xh + a * b * hh,
            yy + 2.0 * b * yh + b * b * hh + place,
            xh + a * hh,
            yh + b * hh,
            hh + distance * self.reported.heading_drift**2,
        )

    def _covariance(self) -> FloatArray:
        covariance = self._noise_covariance.copy()
        xx, xy, yy, xh, yh, hh = self._drift
        covariance[0, 0] += xx
        covariance[1, 1] += yy
        covariance[5, 5] += hh
        covariance[0, 1] = covariance[1, 0] = xy
        covariance[0, 5] = covariance[5, 0] = xh
        covariance[1, 5] = covariance[5, 1] = yh
        return covariance


def _product(first: list[float], second: list[float]) -> tuple[float, float, float, float]:
    w1, x1, y1, z1 = first
    w2, x2, y2, z2 = second
    return (
        w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
        w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
        w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
    )


def _into_body(orientation: list[float], vector: list[float]) -> tuple[float, float, float]:
    """Return a vector of the map in the axes of a body with an orientation w, x, y, z."""
    w, x, y, z = orientation
    a, b, c = vector
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c,
        2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c,
        2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )
