"""How far inside the view of a camera a box of positions is."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from maasi_drivers.vision.camera_model import Camera
from maasi_filter.models.pose import Pose

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

    Parameters
    ----------
    camera : Camera
        On the robot.
    lower, upper : array_like, at least 2 values
        Offsets of the box from the robot, in its frame, of which x and y are used [m].
    robot_height : float
        Height of the robot's origin over the floor [m].
    marker_radius : float
        Markers whose centre lies in the box must be seen as a whole [m].

    Returns
    -------
    float
        Smallest distance of the box to the image's border [px]; negative where a
        part of the box is not seen, minus infinity where it lies behind the camera.

    Raises
    ------
    ValueError
        Where a bound is not finite, or a lower one is not below its upper one.
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
