"""Pinhole camera on a robot: pixels to the floor and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_drivers.settings.camera import CameraSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose

# From optical axes (x right, y down, z forward) to REP-103 axes (x forward, y left, z up).
_OPTICAL_TO_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

_NEWTON_STEPS = 12


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Return the (3, 3) rotation Rz(yaw) Ry(pitch) Rx(roll); angles about fixed axes [rad]."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


@njit(cache=True)
def _distort(x, y, k):
    """Plumb-bob model at a normalised point: distorted point, Jacobian xx, yy and xy = yx."""
    k1, k2, p1, p2, k3 = k[0], k[1], k[2], k[3], k[4]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
        slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
    )


@njit(cache=True)
def project_points(points, centre, turn, matrix, k, largest_radius):
    """Pixels (n, 2) of points (n, 3); turn (3, 3) from the optical frame to the map."""
    pixels = np.full((points.shape[0], 2), np.nan)
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        depth = turn[0, 2] * dx + turn[1, 2] * dy + turn[2, 2] * dz
        if not depth > 1e-9:
            continue
        x = (turn[0, 0] * dx + turn[1, 0] * dy + turn[2, 0] * dz) / depth
        y = (turn[0, 1] * dx + turn[1, 1] * dy + turn[2, 1] * dz) / depth
        if x * x + y * y >= largest_radius * largest_radius:
            continue
        u, v, _, _, _ = _distort(x, y, k)
        pixels[i, 0] = matrix[0, 0] * u + matrix[0, 2]
        pixels[i, 1] = matrix[1, 1] * v + matrix[1, 2]
    return pixels


@njit(cache=True)
def _undistort(pixels, matrix, k, largest_radius):
    """Normalised points (n, 2) of pixels, and their derivatives by the pixels (n, 2, 2)."""
    count = pixels.shape[0]
    points = np.full((count, 2), np.nan)
    jacobians = np.full((count, 2, 2), np.nan)
    for i in range(count):
        goal_x = (pixels[i, 0] - matrix[0, 2]) / matrix[0, 0]
        goal_y = (pixels[i, 1] - matrix[1, 2]) / matrix[1, 1]
        x, y = goal_x, goal_y
        error = np.inf
        xx, yy, xy = 1.0, 1.0, 0.0
        for _ in range(_NEWTON_STEPS):
            u, v, xx, yy, xy = _distort(x, y, k)
            error = abs(u - goal_x) + abs(v - goal_y)
            determinant = xx * yy - xy * xy
            if error < 1e-13 or determinant == 0.0:
                break
            x -= (yy * (u - goal_x) - xy * (v - goal_y)) / determinant
            y -= (xx * (v - goal_y) - xy * (u - goal_x)) / determinant
        determinant = xx * yy - xy * xy
        if error < 1e-9 and determinant > 0.0 and x * x + y * y < largest_radius**2:
            points[i, 0], points[i, 1] = x, y
            jacobians[i, 0, 0] = yy / (determinant * matrix[0, 0])
            jacobians[i, 1, 1] = xx / (determinant * matrix[1, 1])
            jacobians[i, 0, 1] = -xy / (determinant * matrix[1, 1])
            jacobians[i, 1, 0] = -xy / (determinant * matrix[0, 0])
    return points, jacobians


@njit(cache=True)
def _to_floor(points, by_pixel, centre, turn, origin, height):
    """Floor positions (n, 2) of ideal rays, derivatives by pixel (n, 2, 2) and by pose (n, 2, 6).

    A change w of a point on the ray moves where the ray meets the plane by w_xy - slope w_z.
    """
    count = points.shape[0]
    positions = np.full((count, 2), np.nan)
    jacobian_pixel = np.full((count, 2, 2), np.nan)
    jacobian_pose = np.full((count, 2, 6), np.nan)
    for i in range(count):
        u, v = points[i, 0], points[i, 1]
        down = turn[2, 0] * u + turn[2, 1] * v + turn[2, 2]
        scale = (height - centre[2]) / down if down != 0.0 else np.nan
        if not (scale > 0.0 and np.isfinite(scale)):
            continue
        for axis in range(2):
            ray = turn[axis, 0] * u + turn[axis, 1] * v + turn[axis, 2]
            positions[i, axis] = centre[axis] + scale * ray
        arm_x, arm_y = positions[i, 0] - origin[0], positions[i, 1] - origin[1]
        arm_z = height - origin[2]
        for axis in range(2):
            ray = turn[axis, 0] * u + turn[axis, 1] * v + turn[axis, 2]
            slope = ray / down
            by_u = scale * (turn[axis, 0] - slope * turn[2, 0])
            by_v = scale * (turn[axis, 1] - slope * turn[2, 1])
            for column in range(2):
                jacobian_pixel[i, axis, column] = (
                    by_u * by_pixel[i, 0, column] + by_v * by_pixel[i, 1, column]
                )
            along_x, along_y = (1.0, 0.0) if axis == 0 else (0.0, 1.0)
            jacobian_pose[i, axis, 0] = along_x
            jacobian_pose[i, axis, 1] = along_y
            jacobian_pose[i, axis, 2] = -slope
            # A small rotation r of the robot moves the point by r x arm.
            jacobian_pose[i, axis, 3] = -along_y * arm_z - slope * arm_y
            jacobian_pose[i, axis, 4] = along_x * arm_z + slope * arm_x
            jacobian_pose[i, axis, 5] = -along_x * arm_y + along_y * arm_x
    return positions, jacobian_pixel, jacobian_pose


def _largest_radius(k: FloatArray) -> float:
    """Normalised radius up to which the radial model grows, so that it can be inverted."""
    k1, k2, _, _, k3 = k
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0]) if np.any(k[[0, 1, 4]]) else np.empty(0)
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if real.size else np.inf


def _points(name: str, values: ArrayLike, columns: int) -> FloatArray:
    points = np.atleast_2d(np.asarray(values, dtype=np.float64))
    if points.size == 0:
        return np.empty((0, columns))
    if points.ndim != 2 or points.shape[1] != columns:
        raise ValueError(f'{name}: got an array of shape {points.shape}, allowed (n, {columns})')
    return points


@dataclass(frozen=True)
class Camera:
    """A calibrated camera mounted on a robot.

    Attributes
    ----------
    width, height : int
        Image size [px].
    matrix : ndarray, shape (3, 3)
        Intrinsic matrix, the left part of C in 001, eq. (18) [px].
    distortion : ndarray, shape (5,)
        Plumb-bob coefficients k1, k2, p1, p2, k3.
    position : ndarray, shape (3,)
        Optical centre in the robot's frame [m].
    rotation : ndarray, shape (3, 3)
        From the optical frame to the robot's.
    """

    width: int
    height: int
    matrix: FloatArray
    distortion: FloatArray
    position: FloatArray
    rotation: FloatArray
    largest_radius: float = np.inf

    @classmethod
    def from_settings(cls, settings: CameraSettings) -> Camera:
        """Build the camera that the settings describe."""
        cx, cy = settings.principal_point or (
            (settings.width - 1) / 2.0,
            (settings.height - 1) / 2.0,
        )
        fx, fy = settings.focal_length
        distortion = np.zeros(5)
        distortion[: len(settings.distortion)] = settings.distortion
        return cls(
            width=settings.width,
            height=settings.height,
            matrix=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            distortion=distortion,
            position=np.array(settings.mount.position, dtype=np.float64),
            rotation=rotation_from_rpy(*settings.mount.rpy) @ _OPTICAL_TO_BODY,
            largest_radius=_largest_radius(distortion),
        )

    def centre(self, pose: Pose) -> FloatArray:
        """Return the optical centre in the map frame, shape (3,) [m]."""
        return np.asarray(pose.position) + pose.rotation() @ self.position

    def project(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Project positions in the map frame to pixels (001, eq. (17)).

        Parameters
        ----------
        positions : array_like, shape (n, 3)
            Map frame [m].
        pose : Pose
            Of the robot in the map frame.

        Returns
        -------
        ndarray, shape (n, 2)
            Pixels, also outside the image; NaN for what is behind the camera or so far off its axis
            that the distortion model does not hold.
        """
        return np.asarray(
            project_points(
                _points('positions', positions, 3),
                self.centre(pose),
                pose.rotation() @ self.rotation,
                self.matrix,
                self.distortion,
                self.largest_radius,
            )
        )

    def undistort(self, pixels: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Invert intrinsics and distortion.

        Returns
        -------
        points : ndarray, shape (n, 2)
            Normalised image coordinates of ideal rays; NaN where the distortion has no inverse.
        jacobians : ndarray, shape (n, 2, 2)
            Derivatives of the points by the pixels [1/px].
        """
        points, jacobians = _undistort(
            _points('pixels', pixels, 2), self.matrix, self.distortion, self.largest_radius
        )
        return points, jacobians

    def back_project(
        self, pixels: ArrayLike, pose: Pose, height: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Back-project pixels to the plane z = height (001, eq. (17) with z_w known).

        Parameters
        ----------
        pixels : array_like, shape (n, 2)
            (column, row) [px].
        pose : Pose
            Of the robot in the map frame.
        height : float
            Of the plane in the map frame [m].

        Returns
        -------
        positions : ndarray, shape (n, 2)
            In the map frame [m]; NaN where the ray does not meet the plane.
        by_pixel : ndarray, shape (n, 2, 2)
            Derivatives by the pixel [m/px].
        by_pose : ndarray, shape (n, 2, 6)
            Derivatives by x, y, z of the robot and by rotations about the map's axes [m/m, m/rad].
        """
        rotation = pose.rotation()
        points, by_pixel = self.undistort(pixels)
        positions, jacobian_pixel, jacobian_pose = _to_floor(
            points,
            by_pixel,
            pose.position + rotation @ self.position,
            rotation @ self.rotation,
            pose.position,
            float(height),
        )
        return positions, jacobian_pixel, jacobian_pose

    def margin(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return how far inside the image positions (n, 3) are seen, shape (n,) [px].

        Negative outside, minus infinity where the camera cannot see at all.
        """
        pixels = self.project(positions, pose)
        # The image reaches half a pixel beyond the outermost pixel centres.
        margins = np.minimum(
            np.minimum(pixels[:, 0] + 0.5, self.width - 0.5 - pixels[:, 0]),
            np.minimum(pixels[:, 1] + 0.5, self.height - 0.5 - pixels[:, 1]),
        )
        return np.where(np.isnan(margins), -np.inf, margins)

    def pixels_per_metre(self, pose: Pose) -> float:
        """Return the image's scale on the floor at its centre [px/m]; NaN above the horizon."""
        _, by_pixel, _ = self.back_project(
            [[(self.width - 1) / 2.0, (self.height - 1) / 2.0]], pose, 0.0
        )
        return float(1.0 / np.sqrt(np.abs(np.linalg.det(by_pixel[0]))))


# Points on the rim of a marker.
_RIM_POINTS = 24


def box_view_margin(
    camera: Camera,
    lower: ArrayLike,
    upper: ArrayLike,
    robot_height: float,
    marker_radius: float = 0.0,
) -> float:
    """Return how far inside the image a box field of view lies, markers at its rim included.

    The distance to the border [px] is negative where a part of the box is not seen, minus infinity
    where it lies behind the camera. `lower` and `upper` are offsets from the robot [m].
    """
    low = np.asarray(lower, dtype=np.float64)[:2]
    high = np.asarray(upper, dtype=np.float64)[:2]
    if not (np.all(np.isfinite(low)) and np.all(np.isfinite(high)) and np.all(low < high)):
        raise ValueError(
            f'box field of view: got lower {low.tolist()}, upper {high.tolist()}, '
            'allowed finite offsets with lower below upper'
        )
    along = np.linspace(0.0, 1.0, 33)[:, None]
    corners = np.array([[low[0], low[1]], [high[0], low[1]], high, [low[0], high[1]]])
    rim = np.concatenate(
        [a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))]
    )
    angles = np.arange(_RIM_POINTS) * (2.0 * np.pi / _RIM_POINTS)
    circle = marker_radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    outline = (rim[:, None, :] + circle).reshape(-1, 2)
    outline = np.concatenate([outline, np.zeros((len(outline), 1))], axis=1)
    return float(camera.margin(outline, Pose.from_yaw([0.0, 0.0, robot_height], 0.0)).min())
