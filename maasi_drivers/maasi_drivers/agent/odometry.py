"""Odometry in the map, velocities from poses, and poses at a stamp. Without ROS."""

import math
from bisect import bisect_left
from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose, compose, finite_vector, inverse


@dataclass(frozen=True)
class StampedPose:
    """Pose and velocity of a robot at a stamp.

    Attributes
    ----------
    stamp : int
        [ns]; whole, so that equal stamps are equal.
    pose : Pose
        In the map frame.
    covariance : ndarray, shape (6, 6)
        Of x, y, z [m] and rotations about the map's axes [rad].
    velocity : ndarray, shape (3,)
        Map frame [m/s].
    angular_velocity : ndarray, shape (3,)
        The robot's frame [rad/s].
    """

    stamp: int
    pose: Pose
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))
    angular_velocity: FloatArray = field(default_factory=lambda: np.zeros(3))


class MapOdometry:
    """Converts odometry, which starts at zero, into poses in the map.

    initial: pose of the robot in the map when the odometry showed `origin`; origin: default
    zero; for a robot that was not restarted, its first message.
    """

    def __init__(self, initial: Pose, origin: Pose | None = None) -> None:
        self.map_from_odom = initial if origin is None else compose(initial, inverse(origin))
        self._turn = self.map_from_odom.rotation()

    def apply(
        self,
        stamp: int,
        pose: Pose,
        covariance: ArrayLike | None = None,
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> StampedPose:
        """Convert an odometry message; raises ValueError if a number is not finite.

        stamp in ns; pose and covariance (6, 6, default zero) in the odometry frame, as in
        `nav_msgs/Odometry`; twist in the robot's frame [m/s, rad/s].
        """
        matrix = np.zeros((6, 6))
        if covariance is not None:
            turn = np.zeros((6, 6))
            turn[:3, :3] = turn[3:, 3:] = self._turn
            matrix = turn @ finite_vector('covariance', np.ravel(covariance), 36).reshape(6, 6)
            matrix = matrix @ turn.T
        placed = compose(self.map_from_odom, pose)
        return StampedPose(
            stamp,
            placed,
            matrix,
            placed.rotation() @ finite_vector('velocity', velocity, 3),
            finite_vector('angular_velocity', angular_velocity, 3),
        )


def is_in_map(frame: str, origin: str, map_frame: str) -> bool:
    """Return whether odometry is in the map, by its `header.frame_id` or `odometry_origin`."""
    return origin == 'map' or frame.strip('/') == map_frame


def interpolate(first: StampedPose, second: StampedPose, stamp: int) -> StampedPose:
    """Return the pose at a stamp between two others: position linear, orientation by slerp."""
    if stamp == first.stamp:
        return first
    if stamp == second.stamp:
        return second
    part = (stamp - first.stamp) / (second.stamp - first.stamp)

    def mix(a: FloatArray, b: FloatArray) -> FloatArray:
        return (1.0 - part) * a + part * b

    a, b = first.pose.orientation, second.pose.orientation
    cosine = float((a * b).sum())
    if cosine < 0.0:
        b, cosine = -b, -cosine
    angle = float(np.arccos(min(cosine, 1.0)))
    if angle < 1e-6:
        orientation = mix(a, b)
    else:
        orientation = (np.sin((1.0 - part) * angle) * a + np.sin(part * angle) * b) / np.sin(angle)
    return StampedPose(
        stamp,
        Pose(mix(first.pose.position, second.pose.position), orientation),
        mix(first.covariance, second.covariance),
        mix(first.velocity, second.velocity),
        mix(first.angular_velocity, second.angular_velocity),
    )


class PoseHistory:
    """The latest poses of a robot, to find its pose at an image."""

    def __init__(self, length: int = 512) -> None:
        self.length = length
        self._poses: list[StampedPose] = []

    @property
    def latest(self) -> StampedPose | None:
        """The last pose added, or None."""
        return self._poses[-1] if self._poses else None

    @property
    def first(self) -> int | None:
        """The earliest retained stamp [ns], or None."""
        return self._poses[0].stamp if self._poses else None

    def add(self, pose: StampedPose) -> None:
        """Add a pose, unless its stamp is not later than the last one."""
        if self._poses and pose.stamp <= self._poses[-1].stamp:
            return
        self._poses.append(pose)
        del self._poses[: -self.length]

    def clear(self) -> None:
        """Discard everything, as after a jump of the clock."""
        self._poses.clear()

    def at(self, stamp: int) -> StampedPose | None:
        """Return the interpolated pose at a stamp [ns], or None outside of the retained range."""
        poses = self._poses
        if not poses or not poses[0].stamp <= stamp <= poses[-1].stamp:
            return None
        index = bisect_left(poses, stamp, key=attrgetter('stamp'))
        return interpolate(poses[max(index - 1, 0)], poses[index], stamp)


class PoseSpeed:
    """Velocities from differences of poses."""

    def __init__(self) -> None:
        self._before: tuple[int, Pose] | None = None

    def with_velocity(self, stamp: int, pose: Pose) -> StampedPose:
        """Return a pose at a stamp [ns] with the velocity since the last one."""
        velocity, turning = np.zeros(3), np.zeros(3)
        before, self._before = self._before, (stamp, pose)
        if before is not None and 0 < stamp - before[0] < 1_000_000_000:
            period = 1e-9 * (stamp - before[0])
            velocity = (pose.position - before[1].position) / period
            change = compose(inverse(before[1]), pose).orientation
            change = change if change[0] >= 0.0 else -change
            half = float(np.linalg.norm(change[1:]))
            angle = 2.0 * math.atan2(half, float(change[0]))
            turning = change[1:] * (angle / half if half > 0.0 else 2.0) / period
            # Faster changes are jumps of the pose [m/s, rad/s].
            if max(np.linalg.norm(velocity), np.linalg.norm(turning)) > 50.0:
                velocity, turning = np.zeros(3), np.zeros(3)
        return StampedPose(stamp, pose, velocity=velocity, angular_velocity=turning)
