"""Projection of pixels to ground that is not flat."""

import numpy as np
from numpy.typing import ArrayLike

from maasi_drivers.vision.camera_model import Camera
from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.models.pose import Pose


def project_to_terrain(
    camera: Camera, pixels: ArrayLike, pose: Pose, terrain: Terrain
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pixel positions on the ground; results as those of `Camera.back_project`.

    Derivatives are those on the plane that touches the ground there.
    """
    points, by_pixel = camera.undistort(pixels)
    turn, centre = pose.rotation() @ camera.rotation, camera.centre(pose)
    rays = points[:, :1] * turn[:, 0] + points[:, 1:] * turn[:, 1] + turn[:, 2]
    found = terrain.meets(centre, rays)
    # A shift w of a point on a ray r shifts the intersection with the plane by w - r (n w) / (n r).
    slopes = terrain.slopes(np.nan_to_num(found))
    normal = np.column_stack([-slopes, np.ones(len(found))])
    with np.errstate(invalid='ignore', divide='ignore'):
        along = rays[:, :2] / (normal * rays).sum(axis=1, keepdims=True)
        scale = ((found - centre) * rays).sum(axis=1) / (rays * rays).sum(axis=1)
    along[~np.isfinite(scale)] = np.nan
    by_ray = [
        scale[:, None] * (turn[:2, k] - along * (normal @ turn[:, k])[:, None]) for k in (0, 1)
    ]
    by_pixel = by_ray[0][..., None] * by_pixel[:, None, 0] + (
        by_ray[1][..., None] * by_pixel[:, None, 1]
    )
    shifts = np.zeros((len(found), 3, 6))
    shifts[:, [0, 1, 2], [0, 1, 2]] = 1.0
    # A small rotation r of the robot moves a point by r x arm.
    arm = found - pose.position
    shifts[:, 1, 3], shifts[:, 2, 3] = -arm[:, 2], arm[:, 1]
    shifts[:, 0, 4], shifts[:, 2, 4] = arm[:, 2], -arm[:, 0]
    shifts[:, 0, 5], shifts[:, 1, 5] = -arm[:, 1], arm[:, 0]
    through = np.einsum('na,nak->nk', normal, shifts)
    by_pose = shifts[:, :2] - along[:, :, None] * through[:, None, :]
    return found[:, :2], by_pixel, by_pose
