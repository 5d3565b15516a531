"""
A simulated camera: images of the floor with its markers.

The geometry is that of `maasi_drivers.vision.camera_model.Camera`, distortion included; light,
noise, blur and distractors are set by `RenderSettings`. The image is linear in the light.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_drivers.vision.camera_model import Camera
from maasi_filter.arrays import FloatArray, ImageArray
from maasi_filter.models.pose import Pose
from maasi_sim.world.floor_scene import Shape
from maasi_sim.world.noise_streams import noise_stream
from maasi_sim.world.render_kernels import (
    DISC,
    RECTANGLE,
    Exposure,
    Motion,
    View,
    expose,
    floor_albedo,
    floor_points,
    paint,
    place,
)
from maasi_sim.world.render_settings import RenderSettings

_NOISE_TABLE_SIZE = 1 << 16


def _noise_table() -> NDArray[np.float32]:
    """Return normal numbers for the noise of all cameras, read at offsets drawn for each row."""
    generator = np.random.Generator(np.random.PCG64(20240601))
    return generator.standard_normal(_NOISE_TABLE_SIZE, dtype=np.float32)


class CameraRenderer:
    """Renders what one robot's camera sees."""

    def __init__(
        self,
        camera: Camera,
        settings: RenderSettings,
        shapes: Sequence[Shape],
        seed: int,
        robot: str,
    ) -> None:
        self.camera = camera
        self.settings = settings
        self.seed = seed
        self.robot = robot
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        points, _ = camera.undistort(np.stack([columns.ravel(), rows.ravel()], axis=1))
        self._rays = np.ascontiguousarray(points.T.reshape(2, camera.height, camera.width))
        radius = np.hypot(
            (columns - 0.5 * (camera.width - 1)) / camera.width,
            (rows - 0.5 * (camera.height - 1)) / camera.height,
        )
        self._lens = 1.0 - settings.vignetting * 2.0 * radius**2
        self._shapes = np.zeros((len(shapes), 10))
        for row, shape in zip(self._shapes, shapes):
            row[0] = RECTANGLE if shape.rectangle else DISC
            row[1:3], row[3:5] = shape.centre, shape.half_size
            row[5], row[6] = np.cos(shape.angle), np.sin(shape.angle)
            row[7:10] = shape.colour
        self._rims = self._shape_rims()
        # Uneven light is common to all cameras; exposure and white balance drift in each one.
        room = noise_stream(seed, purpose='light')
        direction, phase = room.uniform(0.0, 2.0 * np.pi), room.uniform(0.0, 1.0)
        wave = np.array([np.cos(direction), np.sin(direction)]) / settings.light_wavelength
        self._light = np.array([settings.light_variation, *wave, phase])
        drift = noise_stream(seed, robot, purpose='camera drift')
        self._drift_phases = drift.uniform(0.0, 2.0 * np.pi, size=4)
        self._drift_rates = 2.0 * np.pi / settings.drift_period * drift.uniform(0.7, 1.4, size=4)
        self._noise = _noise_table()
        self._floor_x = np.empty((camera.height, camera.width))
        self._floor_y = np.empty_like(self._floor_x)
        self._albedo = np.empty((3, camera.height, camera.width), dtype=np.float32)
        self._boxes = np.zeros((len(shapes), 4), dtype=np.int64)
        self._drift = np.zeros((len(shapes), 2))
        self._floor_colour = np.array(settings.floor_colour, dtype=float)

    def _shape_rims(self) -> FloatArray:
        """Points (n, 16, 3) around each shape, a little outside it."""
        angles = np.arange(16) * (np.pi / 8.0)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        # A square around the rectangle's own axes: circle points pushed out to the sides.
        square = circle / np.abs(circle).max(axis=1, keepdims=True)
        rims = np.zeros((len(self._shapes), 16, 3))
        for rim, shape in zip(rims, self._shapes):
            outline = square if shape[0] == RECTANGLE else 1.03 * circle
            local = outline * shape[3:5]
            rim[:, 0] = shape[1] + shape[5] * local[:, 0] - shape[6] * local[:, 1]
            rim[:, 1] = shape[2] + shape[6] * local[:, 0] + shape[5] * local[:, 1]
        return rims

    def gains(self, time: float) -> FloatArray:
        """Return exposure times white balance of R, G, B at a time [s], shape (3,)."""
        waves = np.sin(self._drift_phases + self._drift_rates * time)
        exposure = 1.0 + self.settings.exposure_drift * waves[0]
        return exposure * (1.0 + self.settings.white_balance_drift * waves[1:])

    def render(
        self,
        pose: Pose,
        step: int,
        time: float,
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> ImageArray:
        """Render an image."""
        settings, camera = self.settings, self.camera
        rotation = pose.rotation()
        turn = rotation @ camera.rotation
        centre = pose.position + rotation @ camera.position
        floor_points(self._rays, turn, centre, self._floor_x, self._floor_y)
        floor_albedo(
            self._floor_x,
            self._floor_y,
            self._floor_colour,
            settings.floor_texture,
            self._albedo,
        )
        view = View(centre, turn, camera.matrix, camera.distortion, float(camera.largest_radius))
        motion = Motion(
            pose.position,
            np.array(velocity, dtype=float),
            rotation @ np.asarray(angular_velocity, dtype=float),
            float(settings.exposure_time),
        )
        place(
            self._shapes,
            self._rims,
            self._floor_x,
            self._floor_y,
            view,
            motion,
            3.0 + 2.0 * settings.blur,
            self._boxes,
            self._drift,
        )
        paint(
            self._albedo,
            self._floor_x,
            self._floor_y,
            self._shapes,
            self._boxes,
            self._drift,
            settings.blur,
        )
        offsets = noise_stream(self.seed, self.robot, step, 'camera').integers(
            0, len(self._noise) - camera.width, size=(camera.height, 3)
        )
        image = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
        exposure = Exposure(
            self._lens,
            self._light,
            self.gains(time),
            float(settings.read_noise),
            float(settings.shot_noise),
        )
        expose(self._albedo, self._floor_x, self._floor_y, exposure, self._noise, offsets, image)
        return (
            image if settings.jpeg_quality is None else through_jpeg(image, settings.jpeg_quality)
        )


def through_jpeg(image: ImageArray, quality: int) -> ImageArray:
    """Return an RGB image after JPEG compression at a quality of 1 to 100."""
    _, encoded = cv2.imencode(
        '.jpg', cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    decoded = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR))
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), dtype=np.uint8)
