"""Camera pictures of measurements: small cut-outs of what the sensor model covers."""

import base64
from collections import defaultdict, deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_sim.run.bag import COMPRESSED_TYPE, IMAGE_TYPE

if TYPE_CHECKING:
    from maasi_drivers.vision.camera_model import Camera

# Types of images, and last parts of their topics.
IMAGES = {IMAGE_TYPE: 'camera/image_raw', COMPRESSED_TYPE: 'camera/image_raw/compressed'}
# Largest width [px], JPEG quality, and time between pictures of a robot [s].
_WIDTH, _QUALITY, _PERIOD = 240, 60, 0.5
_KEPT = 16  # images of a camera that wait for their detections
# Points per side of a sensor's box, and the margin around it relative to its size.
_POINTS, _AROUND = 25, 0.06
# Part of an image around a target: half its size in diameters of a marker, and at least [px];
# largest size that is shown [px].
_AROUND_TARGET, _LEAST_HALF, _CUT_OUT = 2.0, 16.0, 96


class Pictures:
    """Keeps the last images of cameras; most are never decoded."""

    def __init__(self) -> None:
        # Stamps and readers of images, by namespace of the robot.
        self._images: dict[str, deque[Any]] = defaultdict(lambda: deque(maxlen=_KEPT))
        self._last: dict[str, float] = {}

    def keep(self, topic: str, stamp: float, read: Callable[[], Any]) -> None:
        """Keep an image with a stamp [s]; `read` returns its message."""
        self._images[topic.partition('/camera/')[0]].append((stamp, read))

    def at(self, space: str, stamp: float) -> Any:
        """Return the message of a robot's image with a stamp [s] if a picture is due, else None."""
        # A copy, as another thread may add images.
        images = dict(self._images[space].copy())
        if stamp not in images or abs(stamp - self._last.get(space, -_PERIOD)) < _PERIOD:
            return None
        self._last[space] = stamp
        return images[stamp]()


def picture(message: Any, robot: dict[str, Any], pose: Pose, values: ArrayLike) -> list[Any]:
    """Return the relevant part of an image as JPEG in base64, and its annotations.

    Annotations: size [px], detections (column, row, radius), and corners of the box of the
    sensor model on the floor, empty if it covers the image. The robot is one of a scene;
    without its camera the detections have no pixels. Values: range, bearing and elevation of
    detections on the floor.
    """
    # Deferred: slow imports that most runs do not need.
    import cv2

    from maasi_drivers.settings.camera import CameraSettings
    from maasi_drivers.vision.camera_model import Camera
    from maasi_drivers.vision.images import decode_image, image_to_array

    image = image_to_array(message) if hasattr(message, 'encoding') else decode_image(message)
    camera, corner = robot.get('camera'), np.zeros(2)
    marks: FloatArray | None = None
    outline = np.zeros((0, 2))
    if camera is not None:
        model = Camera.from_settings(CameraSettings(**camera))
        marks = _marks(model, 0.5 * camera['marker_diameter'], pose, values)
        outline = _outline(model, robot.get('view') or {}, pose, image.shape)
    if len(outline):
        size = np.ptp(outline, axis=0)
        limits = np.array(image.shape[1::-1])
        corner = np.clip(np.floor(outline.min(axis=0) - _AROUND * size), 0, limits - 1)
        end = np.clip(np.ceil(outline.max(axis=0) + _AROUND * size), corner + 1, limits)
        (left, top), (right, bottom) = corner.astype(int), end.astype(int)
        image = image[top:bottom, left:right]
    height, width = image.shape[:2]
    shown = min(width, _WIDTH), max(1, round(height * min(1.0, _WIDTH / width)))
    small = cv2.resize(image[:, :, ::-1], shown, interpolation=cv2.INTER_AREA)
    data = cv2.imencode('.jpg', small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    rows = None if marks is None else (marks - [*corner, 0.0]).round(1).tolist()
    text = base64.b64encode(data).decode()
    return [text, [width, height], rows, (outline - corner).round(1).tolist()]


def cut_out(message: Any, robot: dict[str, Any], pose: Pose, position: ArrayLike) -> str | None:
    """Return the part of an image around a position (3,) [m] as JPEG in base64.

    None if the camera is unknown, or the position is not in the image.
    """
    camera = robot.get('camera')
    if camera is None:
        return None
    # Deferred, as in `picture`.
    import cv2

    from maasi_drivers.settings.camera import CameraSettings
    from maasi_drivers.vision.camera_model import Camera
    from maasi_drivers.vision.images import decode_image, image_to_array

    model, place = Camera.from_settings(CameraSettings(**camera)), np.asarray(position)
    around = place + np.array([[0.0, 0.0, 0.0], [camera['marker_diameter'], 0.0, 0.0]])
    middle, edge = model.project(around, pose)
    if not np.isfinite([*middle, *edge]).all():
        return None
    half = max(_AROUND_TARGET * float(np.linalg.norm(edge - middle)), _LEAST_HALF)
    limits = np.array([model.width, model.height])
    # The target itself is in the image.
    if (middle < 0.5 * half).any() or (middle > limits - 0.5 * half).any():
        return None
    image = image_to_array(message) if hasattr(message, 'encoding') else decode_image(message)
    limits = np.array(image.shape[1::-1])
    left, top = np.clip(np.floor(middle - half), 0, limits - 1).astype(int)
    right, bottom = np.clip(np.ceil(middle + half), 1, limits).astype(int)
    part = image[top:bottom, left:right]
    shrink = min(1.0, _CUT_OUT / max(part.shape[:2]))
    size = [max(1, round(shrink * length)) for length in part.shape[1::-1]]
    small = cv2.resize(part[:, :, ::-1], size, interpolation=cv2.INTER_AREA)
    data = cv2.imencode('.jpg', small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return base64.b64encode(data).decode()


def _marks(model: 'Camera', radius: float, pose: Pose, values: ArrayLike) -> FloatArray:
    """Return column, row and radius [px] of detections on the floor in front of the camera."""
    reach, bearing, elevation = np.reshape(np.asarray(values, dtype=float), (-1, 3)).T
    level, (x, y, _) = reach * np.cos(elevation), pose.position
    floor = x + level * np.cos(bearing), y + level * np.sin(bearing), 0.0 * level
    positions = np.stack(floor, 1)
    pixels = model.project(positions, pose)
    edge = model.project(positions + np.array([radius, 0.0, 0.0]), pose)
    rows = np.column_stack([pixels, np.linalg.norm(edge - pixels, axis=1)])
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])


def _outline(
    model: 'Camera', view: dict[str, Any], pose: Pose, shape: tuple[int, ...]
) -> FloatArray:
    """Return the corners of a sensor's box on the floor in an image, (n, 2) [px]; empty if all."""
    if view.get('kind') != 'box':
        return np.zeros((0, 2))
    import cv2

    x, y = (np.linspace(low, high, _POINTS) for low, high in zip(view['lower'][:2], view['upper']))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    if view['turns']:
        cosine, sine = np.cos(pose.yaw), np.sin(pose.yaw)
        grid = grid @ np.array([[cosine, sine], [-sine, cosine]])
    floor = np.column_stack([grid + pose.position[:2], np.zeros(len(grid))])
    pixels = model.project(floor, pose)
    height, width = shape[:2]
    # Points far outside say nothing about the visible part.
    near = (np.abs(pixels - (width / 2, height / 2)) < (width, height)).all(axis=1)
    if near.sum() < 3:
        return np.zeros((0, 2))
    hull = cv2.convexHull(pixels[near].astype(np.float32)).reshape(-1, 2)
    image = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    # Pixel centres have integer coordinates.
    area, common = cv2.intersectConvexConvex(hull + 0.5, image)
    if common is None or area < 4.0 or area > 0.98 * width * height:
        return np.zeros((0, 2))
    return np.asarray(common.reshape(-1, 2), dtype=float)
