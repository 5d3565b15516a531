"""Which markers on the floor a camera sees as a whole."""

import numpy as np


def sees_whole(camera, places, pose, radius):
    """Return for markers at places (n, 2) [m, map] whether their rims are inside the image."""
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], axis=1)
    points = np.pad(places, ((0, 0), (0, 1)))
    rims = (points[:, None, :] + circle).reshape(-1, 3)
    return (camera.margin(rims, pose) >= 0).reshape(len(points), -1).all(axis=1)
