"""Small pictures of what cameras saw as their robots measured, and where detections are in them."""

import base64
from collections import defaultdict, deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.models.pose import Pose
from maasi_sim.run.bag import COMPRESSED_TYPE, IMAGE_TYPE

# Types of images, and the last parts of their topics' names.
IMAGES = {IMAGE_TYPE: 'camera/image_raw', COMPRESSED_TYPE: 'camera/image_raw/compressed'}
# Largest width [px], quality as JPEG, and time from one of a robot to the next [s].
_WIDTH, _QUALITY, _PERIOD = 240, 60, 0.5
_KEPT = 16  # images of a camera that are kept until the detections in them come


class Pictures:
    """Keeps the last images of cameras, of which most are never decoded."""

    def __init__(self) -> None:
        # By namespace of the robot: stamps, and what reads the images.
        self._images: dict[str, deque[Any]] = defaultdict(lambda: deque(maxlen=_KEPT))
        self._last: dict[str, float] = {}

    def keep(self, topic: str, stamp: float, read: Callable[[], Any]) -> None:
        """Keep an image with a stamp [s]; `read` returns its message."""
        self._images[topic.partition('/camera/')[0]].append((stamp, read))

    def at(self, space: str, stamp: float) -> Any:
        """Return the message of a robot's image with a stamp [s], if a picture is due, or None."""
        # A copy: another thread may keep images meanwhile.
        images = dict(self._images[space].copy())
        if stamp not in images or abs(stamp - self._last.get(space, -_PERIOD)) < _PERIOD:
            return None
        self._last[space] = stamp
        return images[stamp]()


def picture(
    message: Any, camera: dict[str, Any] | None, pose: Pose, values: ArrayLike
) -> list[Any]:
    """Return an image as JPEG in base64, its size [px], and detections in it: column, row, radius.

    The camera is that of a scene; without it, the detections' places are not known. Values are
    range, bearing and elevation of detections, which are on the floor.
    """
    # Deferred: they take long to import, and most runs show no picture.
    import cv2

    from maasi_drivers.settings.camera import CameraSettings
    from maasi_drivers.vision.camera_model import Camera
    from maasi_drivers.vision.images import decode_image, image_to_array

    image = image_to_array(message) if hasattr(message, 'encoding') else decode_image(message)
    height, width = image.shape[:2]
    size = min(width, _WIDTH), round(height * min(1.0, _WIDTH / width))
    small = cv2.resize(image[:, :, ::-1], size, interpolation=cv2.INTER_AREA)
    data = cv2.imencode('.jpg', small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    marks: list[Any] | None = None
    if camera is not None:
        reach, bearing, elevation = np.reshape(np.asarray(values, dtype=float), (-1, 3)).T
        level, (x, y, _) = reach * np.cos(elevation), pose.position
        floor = x + level * np.cos(bearing), y + level * np.sin(bearing), 0.0 * level
        places, model = np.stack(floor, 1), Camera.from_settings(CameraSettings(**camera))
        pixels = model.project(places, pose)
        radius = np.array([0.5 * camera['marker_diameter'], 0.0, 0.0])
        radii = np.linalg.norm(model.project(places + radius, pose) - pixels, axis=1)
        rows = np.column_stack([pixels, radii]).round(1)
        marks = rows[np.isfinite(rows).all(axis=1)].tolist()
    return [base64.b64encode(data).decode(), [width, height], marks]
