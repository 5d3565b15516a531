"""Pinhole camera on a robot: projection to pixels and to the floor."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from maasi_drivers.settings.camera import CameraSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose

# From optical axes (x right, y down, z forward) to REP-103 axes (x forward, y left, z up).
_OPTICAL_TO_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

_STEPS, _EXACT = 60, 1e-11  # iterations to invert a distortion: number, error [px]
_MISSED = 1e-6  # undistorted points farther from their pixel are invalid [px]


@dataclass(frozen=True)
class Camera:
    """A calibrated camera mounted on a robot.

    `matrix` (3, 3) is the left part of C in paper 001, eq. (18) [px]; `distortion` has the
    coefficients of the `model` in OpenCV's order. Centre [m] and rotation of the optical frame
    are in the robot's frame.
    """

    width: int
    height: int
    matrix: FloatArray
    distortion: FloatArray
    position: FloatArray
    rotation: FloatArray
    largest_radius: float = np.inf
    model: str = 'plumb_bob'

    @classmethod
    def from_settings(cls, settings: CameraSettings) -> Camera:
        """Create the camera of the settings."""
        cx, cy = settings.principal_point or (
            (settings.width - 1) / 2.0,
            (settings.height - 1) / 2.0,
        )
        fx, fy = settings.focal_length
        mount = Pose.from_rpy(settings.mount.position, settings.mount.rpy)
        distortion = np.zeros(max(len(settings.distortion), settings.least_coefficients))
        distortion[: len(settings.distortion)] = settings.distortion
        return cls(
            width=settings.width,
            height=settings.height,
            matrix=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            distortion=distortion,
            position=mount.position,
            rotation=mount.rotation() @ _OPTICAL_TO_BODY,
            largest_radius=_largest_radius(distortion, settings.distortion_model),
            model=settings.distortion_model,
        )

    def centre(self, pose: Pose) -> FloatArray:
        """Return the optical centre in the map frame, shape (3,) [m]."""
        return np.asarray(pose.position) + pose.rotation() @ self.position

    def project(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return the pixels (n, 2) of positions (n, 3) in the map (paper 001, eq. (17)) [m].

        Also outside of the image; nan behind the camera, or too far off its axis for the
        distortion model.
        """
        points = np.reshape(np.asarray(positions, float), (-1, 3)) - self.centre(pose)
        points = points @ (pose.rotation() @ self.rotation)
        with np.errstate(invalid='ignore', divide='ignore'):
            x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
            seen = (points[:, 2] > 1e-9) & (x * x + y * y < self.largest_radius**2)
        pixels = np.full((len(points), 2), np.nan)
        pixels[seen] = self._distorted(np.stack([x[seen], y[seen]], axis=1))[0]
        return pixels

    def _distorted(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the pixels (n, 2) of normalised points (n, 2) with derivatives (n, 2, 2)."""
        if not len(points):
            return np.empty((0, 2)), np.empty((0, 2, 2))
        still = np.zeros(3)
        rays = cv2.convertPointsToHomogeneous(points)
        wide = self.model == 'equidistant'
        project, first = (cv2.fisheye.projectPoints, 11) if wide else (cv2.projectPoints, 3)
        pixels, slopes = project(rays, still, still, self.matrix, self.distortion)
        # By the translation along x and y, at a depth of 1.
        return np.reshape(pixels, (-1, 2)), np.reshape(slopes[:, first : first + 2], (-1, 2, 2))

    def undistort(self, pixels: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return rays (n, 2) of pixels (nan: no inverse) with derivatives (n, 2, 2) [1/px]."""
        given = np.reshape(np.asarray(pixels, float), (-1, 2))
        points = (given - self.matrix[:2, 2]) / self.matrix[[0, 1], [0, 1]]
        points *= np.minimum(1.0, 0.9 * self.largest_radius / np.hypot(*points.T).clip(1e-9))[
            :, None
        ]
        # Newton's method for all models; a step that increases the error is halved.
        active, step = np.arange(len(given)), np.zeros_like(points)
        missed, share = np.full(len(given), np.inf), np.ones(len(given))
        for _ in range(_STEPS):
            tried = points[active] + share[active, None] * step[active]
            again, slopes = self._distorted(tried)
            error = given[active] - again
            size = np.abs(error).max(axis=1, initial=0.0)
            better = (size < missed[active]) & (np.linalg.det(slopes) > 0.0)
            better &= (tried * tried).sum(axis=1) < self.largest_radius**2
            nearer = active[better]
            points[nearer], missed[nearer], share[nearer] = tried[better], size[better], 1.0
            step[nearer] = np.linalg.solve(slopes[better], error[better][..., None])[..., 0]
            share[active[~better]] *= 0.5
            active = active[(missed[active] > _EXACT) & (share[active] > 1e-9)]
            if not len(active):
                break
        again, slopes = self._distorted(points)
        good = (np.abs(again - given) < _MISSED).all(axis=1) & (np.linalg.det(slopes) > 0.0)
        good &= (points * points).sum(axis=1) < self.largest_radius**2
        jacobians = np.full(slopes.shape, np.nan)
        jacobians[good] = np.linalg.inv(slopes[good])
        return np.where(good[:, None], points, np.nan), jacobians

    def back_project(
        self, pixels: ArrayLike, pose: Pose, height: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return pixel positions on the plane z = height [m, map] (paper 001, eq. (17), z_w known).

        Positions (n, 2), nan where a ray does not meet the plane; derivatives by pixel (n,
        2, 2) [m/px], and (n, 2, 6) by x, y, z of the robot and rotations about map axes
        [m/m, m/rad].
        """
        points, by_pixel = self.undistort(pixels)
        turn, centre = pose.rotation() @ self.rotation, self.centre(pose)
        # Directions of the rays in the map, and their descent per metre along the axis.
        x, y, down = (points[:, :1] * row[0] + points[:, 1:] * row[1] + row[2] for row in turn)
        with np.errstate(invalid='ignore', divide='ignore'):
            scale = (height - centre[2]) / down
            scale[~((scale > 0.0) & np.isfinite(scale))] = np.nan
            rays = np.concatenate([x, y], axis=1)
            slopes = rays / down
        slopes[np.isnan(scale[:, 0])] = np.nan
        positions = centre[:2] + scale * rays
        by_u, by_v = (scale * (turn[:2, k] - slopes * turn[2, k]) for k in (0, 1))
        by_pixel = by_u[..., None] * by_pixel[:, None, 0] + by_v[..., None] * by_pixel[:, None, 1]
        # A small rotation r of the robot moves a point by r x arm. A shift w of a point on a ray
        # shifts the intersection with the plane by w_xy - slope w_z.
        arm_x, arm_y = (positions - pose.position[:2]).T
        arm_z = height - pose.position[2]
        by_pose = np.zeros((len(points), 2, 6))
        by_pose[:, [0, 1], [0, 1]] = 1.0
        by_pose[..., 2] = -slopes
        by_pose[..., 3] = -slopes * arm_y[:, None]
        by_pose[..., 4] = slopes * arm_x[:, None]
        by_pose[:, 1, 3] -= arm_z
        by_pose[:, 0, 4] += arm_z
        by_pose[:, 0, 5], by_pose[:, 1, 5] = -arm_y, arm_x
        return positions, by_pixel, by_pose

    def margin(self, positions: ArrayLike, pose: Pose) -> FloatArray:
        """Return the distance of positions (n, 3) to the image border, inside positive, (n,) [px].

        Minus infinity where the camera cannot see.
        """
        pixels, last = self.project(positions, pose), np.array([self.width, self.height]) - 1.0
        # The image extends half a pixel beyond the outermost pixel centres.
        margins = np.minimum(pixels, last - pixels).min(axis=1) + 0.5
        return np.where(np.isnan(margins), -np.inf, margins)


def _largest_radius(distortion: FloatArray, model: str) -> float:
    """Return the radius of a normalised point beyond which a model has no inverse."""
    if model == 'equidistant':
        # Angles from the axis, up to 90 degrees.
        k1, k2, k3, k4 = distortion
        ends = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    else:
        k1, k2, _, _, k3, *below = distortion[:8].tolist()
        # Polynomials of the squared radius: the radial model stops growing or divides by zero.
        top, bottom = np.poly1d([k3, k2, k1, 1.0]), np.poly1d([*below[::-1], 1.0])
        grows = top * bottom + 2.0 * np.poly1d([1.0, 0.0]) * (
            top.deriv() * bottom - top * bottom.deriv()
        )
        ends = np.concatenate([grows.roots, bottom.roots])
    ends = np.sqrt(ends.real[(np.abs(ends.imag) < 1e-9) & (ends.real > 0)])
    end = float(ends.min(initial=np.inf))
    if model == 'equidistant':
        end = float(np.tan(end)) if end < 0.5 * np.pi else np.inf
    return end


def box_view_margin(
    camera: Camera, lower: ArrayLike, upper: ArrayLike, robot_height: float
) -> float:
    """Return the distance of a box field of view to the image border, inside positive [px].

    Minus infinity for a box behind the camera. `lower` and `upper`: offsets from the robot [m].
    """
    (left, bottom), (right, top) = (np.asarray(corner, float)[:2] for corner in (lower, upper))
    corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    sides = np.linspace(corners, np.roll(corners, -1, axis=0), 33)
    rim = np.pad(sides.reshape(-1, 2), ((0, 0), (0, 1)))
    return float(camera.margin(rim, Pose.from_yaw([0.0, 0.0, robot_height], 0.0)).min())
