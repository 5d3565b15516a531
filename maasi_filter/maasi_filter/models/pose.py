"""Positions and orientations in the frame `map` (ENU, metres, radians)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray


def finite_vector(name: str, value: ArrayLike, length: int) -> FloatArray:
    """Return `value` as an array of `length` finite floats; ValueError names `name`."""
    array = np.array(value, dtype=float)
    if array.shape != (length,):
        raise ValueError(f'{name}: got shape {array.shape}, allowed is ({length},)')
    # Faster than NumPy for so few numbers.
    if not all(map(math.isfinite, array.tolist())):
        raise ValueError(f'{name}: got {array.tolist()}, allowed are finite numbers only')
    return array


@dataclass(frozen=True)
class Pose:
    """Position and orientation of a body.

    Parameters
    ----------
    position : (3,) array
        Metres, frame `map`. With two numbers z is 0.
    orientation : (4,) array
        Quaternion w, x, y, z that rotates body axes into map axes; normalised here.

    Raises
    ------
    ValueError
        If a number is not finite, or the quaternion is zero.
    """

    position: FloatArray
    orientation: FloatArray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))

    def __post_init__(self) -> None:
        position = np.asarray(self.position, dtype=float)
        if position.shape == (2,):
            position = np.append(position, 0.0)
        position = finite_vector('position', position, 3)
        orientation = finite_vector('orientation', self.orientation, 4)
        w, x, y, z = orientation.tolist()
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if norm < 1e-9:
            raise ValueError('orientation: got a zero quaternion, allowed are unit quaternions')
        # Keep unit quaternions bit for bit, so that copies of a pose are equal.
        if abs(norm - 1.0) > 1e-12:
            orientation = orientation / norm
        position.setflags(write=False)
        orientation.setflags(write=False)
        object.__setattr__(self, 'position', position)
        object.__setattr__(self, 'orientation', orientation)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Pose):
            return NotImplemented
        return bool(
            np.array_equal(self.position, other.position)
            and np.array_equal(self.orientation, other.orientation)
        )

    def __hash__(self) -> int:
        return hash((self.position.tobytes(), self.orientation.tobytes()))

    @classmethod
    def from_yaw(cls, position: ArrayLike, yaw: float) -> Pose:
        """Return a level pose with a heading of `yaw` radians, anticlockwise from the x axis."""
        half = 0.5 * float(yaw)
        return cls(np.asarray(position, dtype=float), np.array([np.cos(half), 0, 0, np.sin(half)]))

    @classmethod
    def from_rpy(cls, position: ArrayLike, rpy: Sequence[float]) -> Pose:
        """Return a pose from roll, pitch and yaw about fixed axes of its parent [rad]."""
        orientation = np.array([1.0, 0.0, 0.0, 0.0])
        for axis, angle in enumerate(rpy):
            turn = np.zeros(4)
            turn[0], turn[1 + axis] = math.cos(0.5 * angle), math.sin(0.5 * angle)
            orientation = quaternion_product(turn, orientation)
        return cls(np.array(position, dtype=float), orientation)

    @property
    def yaw(self) -> float:
        """Heading in radians, in (-pi, pi]."""
        w, x, y, z = self.orientation.tolist()
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    def rotation(self) -> FloatArray:
        """Return the (3, 3) matrix that rotates body axes into map axes."""
        w, x, y, z = self.orientation.tolist()
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    def inverse(self) -> Pose:
        """Return the pose of the map's origin relative to this pose."""
        w, x, y, z = self.orientation
        return Pose(-(self.rotation().T @ self.position), np.array([w, -x, -y, -z]))


def quaternion_product(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Return the Hamilton product of two quaternions w, x, y, z, each of shape (4,)."""
    w1, x1, y1, z1 = np.asarray(first, dtype=float).tolist()
    w2, x2, y2, z2 = np.asarray(second, dtype=float).tolist()
    return np.array(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ]
    )


def compose(pose_a: Pose, pose_b: Pose) -> Pose:
    """Return `pose_b`, given in the frame of `pose_a`, in the frame of `pose_a`'s parent."""
    return Pose(
        pose_a.position + pose_a.rotation() @ pose_b.position,
        quaternion_product(pose_a.orientation, pose_b.orientation),
    )


def inverse(pose: Pose) -> Pose:
    """Return the inverse of `pose`."""
    return pose.inverse()
