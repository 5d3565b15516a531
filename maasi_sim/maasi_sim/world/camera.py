"""
A simulated camera: the floor with its markers as a robot's camera would deliver it.

The geometry is that of `maasi_drivers.vision.camera_model.Camera`, distortion included; light,
noise, blur and what misleads are set by `RenderSettings`. The image is linear in the light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from maasi_drivers.vision.camera_model import Camera, project_points
from maasi_filter.models.pose import Pose
from maasi_filter.settings import Finite, Settings
from maasi_sim.world.noise_streams import noise_stream
from maasi_sim.world.world import World

Array = NDArray[np.float64]
Colour = Sequence[float]

_DISC, _RECTANGLE = 0, 1
_NOISE_TABLE_SIZE = 1 << 16
_MAXIMUM_SUBSAMPLES = 33
_TEXTURE_CELL = 0.01


class DistractorSettings(Settings):
    """Things on the floor that are not markers; drawn at random over the bounds."""

    sheets: int = Field(default=0, ge=0, description='Pale blue sheets of 10 to 25 cm [1]')
    lines: int = Field(default=0, ge=0, description='Blue lines of 20 to 80 cm, 3 to 8 mm wide [1]')
    purple: int = Field(default=0, ge=0, description="Purple discs of the markers' size [1]")
    cyan: int = Field(
        default=0, ge=0, description="Pale greenish-blue discs of the markers' size [1]"
    )
    large: int = Field(
        default=0, ge=0, description='Blue discs of three times the size of markers [1]'
    )


class RenderSettings(Settings):
    """How the simulated camera sees: moderate by default, exact with `RenderSettings.ideal()`."""

    marker_diameter: float = Field(default=0.03, gt=0, description='Diameter of the markers [m]')
    marker_colour: list[Finite] = Field(
        default_factory=lambda: [0.08, 0.17, 0.62],
        min_length=3,
        max_length=3,
        description='Reflectance of the markers in R, G, B, 0 to 1',
    )
    floor_colour: list[Finite] = Field(
        default_factory=lambda: [0.47, 0.47, 0.46],
        min_length=3,
        max_length=3,
        description='Reflectance of the floor in R, G, B, 0 to 1',
    )
    floor_texture: float = Field(
        default=0.03, ge=0, le=1, description='Relative amplitude of the speckle of the floor [-]'
    )
    light_variation: float = Field(
        default=0.15,
        ge=0,
        lt=1,
        description='Relative amplitude of light and shade over the floor [-]',
    )
    light_wavelength: float = Field(
        default=3.0, gt=0, description='Distance from one bright place to the next [m]'
    )
    vignetting: float = Field(
        default=0.1,
        ge=0,
        lt=1,
        description='Part of the light lost in the corners of the image [-]',
    )
    exposure_drift: float = Field(
        default=0.08, ge=0, lt=1, description='Relative amplitude of the drift of exposure [-]'
    )
    white_balance_drift: float = Field(
        default=0.03,
        ge=0,
        lt=1,
        description="Relative amplitude of the drift of each channel's gain [-]",
    )
    drift_period: float = Field(default=20.0, gt=0, description='Period of the drifts, about [s]')
    shot_noise: float = Field(
        default=0.06,
        ge=0,
        description='Variance of the noise for each grey level of signal [grey level]',
    )
    read_noise: float = Field(
        default=1.5, ge=0, description='Deviation of the noise in the dark [grey level]'
    )
    exposure_time: float = Field(
        default=0.006, ge=0, description='Time over which motion blurs the image [s]'
    )
    blur: float = Field(default=0.5, ge=0, description='Deviation of the blur of the lens [px]')
    jpeg_quality: int | None = Field(
        default=None, ge=1, le=100, description='Passed through JPEG at this quality; none: not [1]'
    )
    distractors: DistractorSettings = Field(
        default_factory=DistractorSettings, description='What misleads'
    )

    @model_validator(mode='after')
    def _colours(self) -> RenderSettings:
        for name in ('marker_colour', 'floor_colour'):
            colour = getattr(self, name)
            if not all(0 <= value <= 1 for value in colour):
                raise ValueError(f'{name}: got {colour}, allowed are numbers from 0 to 1')
        return self

    @classmethod
    def ideal(cls, **changes: object) -> RenderSettings:
        """Return settings without noise, blur, drift or uneven light, but for the changes given."""
        values: dict[str, object] = dict.fromkeys(
            (
                'floor_texture',
                'light_variation',
                'vignetting',
                'exposure_drift',
                'white_balance_drift',
                'shot_noise',
                'read_noise',
                'exposure_time',
                'blur',
            ),
            0.0,
        )
        return cls.model_validate(values | changes)


@dataclass(frozen=True)
class Shape:
    """
    Something flat on the floor.

    Attributes
    ----------
    centre : (x, y)
        Map frame [m].
    half_size : (a, b)
        Radius twice for a disc, half the sides for a rectangle [m].
    colour : (r, g, b)
        Reflectance, 0 to 1.
    rectangle : bool
        Else it is a disc.
    angle : float
        Of a rectangle's first side from the x axis [rad].

    """

    centre: tuple[float, float]
    half_size: tuple[float, float]
    colour: Colour
    rectangle: bool = False
    angle: float = 0.0


def disc(centre: ArrayLike, radius: float, colour: Colour) -> Shape:
    """Return a disc on the floor: centre [m, map], radius [m], reflectance."""
    x, y = (float(value) for value in np.asarray(centre, dtype=float)[:2])
    return Shape((x, y), (radius, radius), tuple(colour))


def draw_distractors(
    settings: RenderSettings, world: World, generator: np.random.Generator
) -> list[Shape]:
    """
    Draw the distractors of a world.

    None but sheets touches a marker: a marker half under something else is no fair target.
    """
    counts = settings.distractors
    low, high = world.bounds[:2, 0], world.bounds[:2, 1]
    radius = 0.5 * settings.marker_diameter
    shapes: list[Shape] = []

    def draw(reach: float, clear: bool) -> tuple[float, float] | None:
        for _ in range(1000):
            x, y = generator.uniform(low, high)
            gaps = np.linalg.norm(world.targets[:, :2] - np.array([x, y]), axis=1)
            if not clear or not gaps.size or gaps.min() > reach + 2.0 * radius:
                return float(x), float(y)
        return None

    for _ in range(counts.sheets):
        centre = draw(0.0, False)
        sides = generator.uniform(0.05, 0.125, size=2)
        colour = np.array([0.60, 0.68, 0.80]) * generator.uniform(0.85, 1.15)
        if centre is not None:
            angle = float(generator.uniform(0, np.pi))
            sizes = (float(sides[0]), float(sides[1]))
            shapes.append(Shape(centre, sizes, colour.tolist(), True, angle))
    for _ in range(counts.lines):
        half = float(generator.uniform(0.1, 0.4))
        width = float(generator.uniform(0.0015, 0.004))
        angle = float(generator.uniform(0, np.pi))
        line = _clear_line(world, half, angle, radius, generator, low, high)
        if line is not None:
            shapes.append(Shape(line, (half, width), settings.marker_colour, True, angle))
    for count, size, colours in (
        (counts.purple, 1.0, [[0.42, 0.12, 0.50]]),
        (counts.cyan, 1.0, [[0.35, 0.55, 0.62]]),
        (counts.large, 3.0, [settings.marker_colour]),
    ):
        for _ in range(count):
            centre = draw(size * radius, True)
            if centre is not None:
                shapes.append(disc(centre, size * radius, colours[0]))
    return shapes


def _clear_line(
    world: World,
    half: float,
    angle: float,
    radius: float,
    generator: np.random.Generator,
    low: Array,
    high: Array,
) -> tuple[float, float] | None:
    along = np.array([np.cos(angle), np.sin(angle)])
    for _ in range(1000):
        centre = generator.uniform(low, high)
        offsets = world.targets[:, :2] - centre
        nearest = np.clip(offsets @ along, -half, half)[:, None] * along
        if not len(offsets) or np.linalg.norm(offsets - nearest, axis=1).min() > 2.5 * radius:
            return float(centre[0]), float(centre[1])
    return None


def scene_of(world: World, settings: RenderSettings, seed: int) -> list[Shape]:
    """Return what lies on the floor, bottom first: distractors, obstacles, markers."""
    shapes = draw_distractors(settings, world, noise_stream(seed, purpose='distractors'))
    shapes += [
        disc(centre, float(radius), (0.25, 0.24, 0.23))
        for centre, radius in zip(world.obstacles.centres, world.obstacles.radii)
    ]
    radius = 0.5 * settings.marker_diameter
    return shapes + [disc(target, radius, settings.marker_colour) for target in world.targets]


@njit(cache=True, error_model='numpy')
def _floor_points(rays, turn, centre, floor_x, floor_y):  # type: ignore[no-untyped-def]
    """Where each pixel's ray meets the floor; NaN above the horizon."""
    above = centre[2] > 0.0
    for row in range(floor_x.shape[0]):
        us, vs, xs, ys = rays[0, row], rays[1, row], floor_x[row], floor_y[row]
        for column in range(floor_x.shape[1]):
            u, v = us[column], vs[column]
            down = turn[2, 0] * u + turn[2, 1] * v + turn[2, 2]
            scale = -centre[2] / down
            scale = scale if down < -1e-6 and above else np.nan
            xs[column] = centre[0] + scale * (turn[0, 0] * u + turn[0, 1] * v + turn[0, 2])
            ys[column] = centre[1] + scale * (turn[1, 0] * u + turn[1, 1] * v + turn[1, 2])


@njit(cache=True)
def _place(  # type: ignore[no-untyped-def]
    shapes,
    rims,
    floor_x,
    floor_y,
    centre,
    origin,
    turn,
    matrix,
    distortion,
    largest,
    velocity,
    rotation_rate,
    exposure_time,
    margin,
    boxes,
    drift,
):
    """
    Find the pixels that each shape may touch, and how far it moves during the exposure.

    boxes (n, 4): left, top, right, bottom; empty where the shape is out of view. drift (n, 2): in
    the floor's coordinates of mid exposure [m].
    """
    height, width = floor_x.shape
    left = bottom = np.inf
    right = top = -np.inf
    horizon = False
    # The outline bounds what the image sees: the floor is a smooth map of the image.
    for row in range(height):
        step = 1 if row == 0 or row == height - 1 else max(width - 1, 1)
        for column in range(0, width, step):
            x, y = floor_x[row, column], floor_y[row, column]
            if np.isnan(x):
                horizon = True
            else:
                left, right = min(left, x), max(right, x)
                bottom, top = min(bottom, y), max(top, y)
    slack = 0.02 * (right - left + top - bottom) if right > left else 0.0
    for i in range(shapes.shape[0]):
        boxes[i, :] = 0
        drift[i, :] = 0.0
        x, y = shapes[i, 1], shapes[i, 2]
        a, b = shapes[i, 3], shapes[i, 4]
        reach = slack + (a if shapes[i, 0] == _DISC else np.sqrt(a * a + b * b))
        if not horizon and (
            x < left - reach or x > right + reach or y < bottom - reach or y > top + reach
        ):
            continue
        spread = 0.0
        if exposure_time > 0.0 and centre[2] > 0.0:
            # The floor's point under a pixel moves with the camera, the shape against it.
            ax, ay, az = x - origin[0], y - origin[1], -origin[2]
            moved_x = velocity[0] + rotation_rate[1] * az - rotation_rate[2] * ay
            moved_y = velocity[1] + rotation_rate[2] * ax - rotation_rate[0] * az
            moved_z = velocity[2] + rotation_rate[0] * ay - rotation_rate[1] * ax
            drift[i, 0] = -exposure_time * (moved_x + (x - centre[0]) / centre[2] * moved_z)
            drift[i, 1] = -exposure_time * (moved_y + (y - centre[1]) / centre[2] * moved_z)
            move = np.sqrt(drift[i, 0] ** 2 + drift[i, 1] ** 2)
            spread = move * max(matrix[0, 0], matrix[1, 1]) / centre[2]
        pixels = project_points(rims[i], centre, turn, matrix, distortion, largest)
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        lost = False
        for k in range(pixels.shape[0]):
            if np.isnan(pixels[k, 0]):
                lost = True
            else:
                low_x, high_x = min(low_x, pixels[k, 0]), max(high_x, pixels[k, 0])
                low_y, high_y = min(low_y, pixels[k, 1]), max(high_y, pixels[k, 1])
        if lost:
            boxes[i, 2], boxes[i, 3] = width, height
            continue
        more = margin + spread
        boxes[i, 0] = int(min(max(np.floor(low_x - more), 0.0), width))
        boxes[i, 1] = int(min(max(np.floor(low_y - more), 0.0), height))
        boxes[i, 2] = int(min(max(np.ceil(high_x + more) + 1.0, boxes[i, 0]), width))
        boxes[i, 3] = int(min(max(np.ceil(high_y + more) + 1.0, boxes[i, 1]), height))


@njit(cache=True)
def _signed_distance(kind, a, b, cosine, sine, dx, dy):  # type: ignore[no-untyped-def]
    """Distance to the edge, negative inside, and its gradient by x and y."""
    if kind == _DISC:
        distance = np.sqrt(dx * dx + dy * dy)
        if distance < 1e-9:
            return -a, 1.0, 0.0
        return distance - a, dx / distance, dy / distance
    x = cosine * dx + sine * dy
    y = -sine * dx + cosine * dy
    from_x, from_y = abs(x) - a, abs(y) - b
    if from_x > from_y:
        sign = 1.0 if x >= 0 else -1.0
        return from_x, sign * cosine, sign * sine
    sign = 1.0 if y >= 0 else -1.0
    return from_y, -sign * sine, sign * cosine


@njit(cache=True)
def _paint(albedo, floor_x, floor_y, shapes, boxes, drift, blur):  # type: ignore[no-untyped-def]
    """Blend shapes (n, 10) into the albedo inside their pixel boxes, edges softened, blurred."""
    height, width = floor_x.shape
    soft = np.sqrt(1.0 + 6.28318530718 * blur * blur)
    for index in range(shapes.shape[0]):
        kind = int(shapes[index, 0])
        cx, cy, a, b = shapes[index, 1], shapes[index, 2], shapes[index, 3], shapes[index, 4]
        cosine, sine = shapes[index, 5], shapes[index, 6]
        move = np.sqrt(drift[index, 0] ** 2 + drift[index, 1] ** 2)
        for row in range(boxes[index, 1], boxes[index, 3]):
            for column in range(boxes[index, 0], boxes[index, 2]):
                x, y = floor_x[row, column], floor_y[row, column]
                if np.isnan(x):
                    continue
                # The footprint of the pixel on the floor, from its neighbours.
                c0, c1 = max(column - 1, 0), min(column + 1, width - 1)
                r0, r1 = max(row - 1, 0), min(row + 1, height - 1)
                per_column = 1.0 / (c1 - c0)
                per_row = 1.0 / (r1 - r0)
                xc = (floor_x[row, c1] - floor_x[row, c0]) * per_column
                yc = (floor_y[row, c1] - floor_y[row, c0]) * per_column
                xr = (floor_x[r1, column] - floor_x[r0, column]) * per_row
                yr = (floor_y[r1, column] - floor_y[r0, column]) * per_row
                if np.isnan(xc + yc + xr + yr):
                    continue
                distance, nx, ny = _signed_distance(kind, a, b, cosine, sine, x - cx, y - cy)
                # Farther from the edge than it is soft and moves, a pixel is in or out.
                edge = np.sqrt(xc * xc + yc * yc + xr * xr + yr * yr)
                if abs(distance) > 0.5 * (move + soft * edge):
                    cover = 1.0 if distance < 0.0 else 0.0
                else:
                    footprint = np.sqrt(abs(xc * yr - xr * yc))
                    count = min(int(np.ceil(2.0 * move / footprint)) + 1, _MAXIMUM_SUBSAMPLES)
                    cover = 0.0
                    for sample in range(count):
                        t = (sample + 0.5) / count - 0.5
                        distance, nx, ny = _signed_distance(
                            kind,
                            a,
                            b,
                            cosine,
                            sine,
                            x - cx - t * drift[index, 0],
                            y - cy - t * drift[index, 1],
                        )
                        slope = np.sqrt((nx * xc + ny * yc) ** 2 + (nx * xr + ny * yr) ** 2)
                        cover += min(max(0.5 - distance / (slope * soft), 0.0), 1.0)
                    cover /= count
                if cover > 0.0:
                    for channel in range(3):
                        albedo[channel, row, column] += cover * (
                            shapes[index, 7 + channel] - albedo[channel, row, column]
                        )


@njit(cache=True)
def _floor_albedo(floor_x, floor_y, colour, texture, albedo):  # type: ignore[no-untyped-def]
    """Fill albedo (3, h, w) with the floor's colour, speckled by an integer hash of its place."""
    height, width = floor_x.shape
    for channel in range(3):
        albedo[channel] = colour[channel]
    if texture == 0.0:
        return
    per_cell = 1.0 / _TEXTURE_CELL
    for row in range(height):
        for column in range(width):
            x, y = floor_x[row, column], floor_y[row, column]
            if x == x:
                a = np.uint32(np.int32(np.floor(per_cell * x)))
                b = np.uint32(np.int32(np.floor(per_cell * y)))
                h = np.uint32(a * np.uint32(0x8DA6B343) ^ b * np.uint32(0xD8163841))
                h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(0x5BD1E995))
                h = np.uint32(h ^ (h >> np.uint32(15)))
                level = np.float32(h & np.uint32(0xFFFF)) / np.float32(32767.5)
                factor = np.float32(1.0) + np.float32(texture) * (level - np.float32(1.0))
                for channel in range(3):
                    albedo[channel, row, column] *= factor


@njit(cache=True)
def _expose(albedo, floor_x, floor_y, lens, light, gains, noise, offsets, read, shot, image):  # type: ignore[no-untyped-def]
    """
    Turn albedo (3, h, w) into grey levels (h, w, 3): light, gains, noise, quantisation.

    light: amplitude, wave vector x and y [turns/m], phase [turns]. The light is a smooth wave of
    parabolas, much like a sine but without its cost.
    """
    height, width = floor_x.shape
    brightness = np.empty(width, dtype=np.float32)
    levels = np.empty((3, width), dtype=np.uint8)
    amplitude = 4.0 * light[0]
    read2, shot1 = np.float32(read * read), np.float32(shot)
    zero, half, full = np.float32(0.0), np.float32(0.5), np.float32(255.0)
    # Row by row over contiguous pieces: that is what the compiler makes fast code of.
    for row in range(height):
        xs, ys, fall_off = floor_x[row], floor_y[row], lens[row]
        for column in range(width):
            turns = light[1] * xs[column] + light[2] * ys[column] + light[3]
            t = 2.0 * (turns - np.floor(turns)) - 1.0
            wave = amplitude * t * (1.0 - abs(t))
            wave = wave if wave == wave else 0.0
            brightness[column] = np.float32(255.0 * fall_off[column] * (1.0 + wave))
        for channel in range(3):
            gain = np.float32(gains[channel])
            grain = noise[offsets[row, channel] : offsets[row, channel] + width]
            line, level = albedo[channel, row], levels[channel]
            for column in range(width):
                value = brightness[column] * gain * line[column]
                value += grain[column] * np.sqrt(read2 + shot1 * value) + half
                value = value if value > zero else zero
                value = value if value < full else full
                level[column] = np.uint8(np.int32(value))
        for column in range(width):
            for channel in range(3):
                image[row, column, channel] = levels[channel, column]


def _noise_table() -> NDArray[np.float32]:
    """Normal numbers that every camera's noise is read from, at offsets drawn for each row."""
    generator = np.random.Generator(np.random.PCG64(20240601))
    return generator.standard_normal(_NOISE_TABLE_SIZE, dtype=np.float32)


class CameraRenderer:
    """
    Renders what one robot's camera sees.

    Parameters
    ----------
    camera : Camera
        Geometry; the true one (a driver may believe another).
    settings : RenderSettings
        Light, noise, blur.
    shapes : sequence of Shape
        What lies on the floor, bottom first; see `scene_of`.
    seed : int
        Of the run.
    robot : str
        Whose camera it is: with the seed and the step it keys the noise.

    """

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
            row[0] = _RECTANGLE if shape.rectangle else _DISC
            row[1:3], row[3:5] = shape.centre, shape.half_size
            row[5], row[6] = np.cos(shape.angle), np.sin(shape.angle)
            row[7:10] = shape.colour
        self._rims = self._shape_rims()
        # Light belongs to the room, the drift of exposure and white balance to each camera.
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

    def _shape_rims(self) -> Array:
        """Points (n, 16, 3) around each shape, a little outside it."""
        angles = np.arange(16) * (np.pi / 8.0)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        # A square around the rectangle's own axes: circle points pushed out to the sides.
        square = circle / np.abs(circle).max(axis=1, keepdims=True)
        rims = np.zeros((len(self._shapes), 16, 3))
        for rim, shape in zip(rims, self._shapes):
            outline = square if shape[0] == _RECTANGLE else 1.03 * circle
            local = outline * shape[3:5]
            rim[:, 0] = shape[1] + shape[5] * local[:, 0] - shape[6] * local[:, 1]
            rim[:, 1] = shape[2] + shape[6] * local[:, 0] + shape[5] * local[:, 1]
        return rims

    def gains(self, time: float) -> Array:
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
    ) -> NDArray[np.uint8]:
        """
        Render an image.

        Parameters
        ----------
        pose : Pose
            True pose of the robot at the middle of the exposure, map frame.
        step : int
            Discrete step: keys the noise.
        time : float
            For the drift of exposure and white balance [s].
        velocity : array_like, shape (3,)
            Of the robot, map frame [m/s].
        angular_velocity : array_like, shape (3,)
            Of the robot, its own frame [rad/s].

        Returns
        -------
        ndarray, shape (h, w, 3), uint8
            R, G, B.

        """
        settings, camera = self.settings, self.camera
        rotation = pose.rotation()
        turn = rotation @ camera.rotation
        centre = pose.position + rotation @ camera.position
        _floor_points(self._rays, turn, centre, self._floor_x, self._floor_y)
        _floor_albedo(
            self._floor_x,
            self._floor_y,
            self._floor_colour,
            settings.floor_texture,
            self._albedo,
        )
        _place(
            self._shapes,
            self._rims,
            self._floor_x,
            self._floor_y,
            centre,
            pose.position,
            turn,
            camera.matrix,
            camera.distortion,
            camera.largest_radius,
            np.array(velocity, dtype=float),
            rotation @ np.asarray(angular_velocity, dtype=float),
            settings.exposure_time,
            3.0 + 2.0 * settings.blur,
            self._boxes,
            self._drift,
        )
        _paint(
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
        _expose(
            self._albedo,
            self._floor_x,
            self._floor_y,
            self._lens,
            self._light,
            self.gains(time),
            self._noise,
            offsets,
            settings.read_noise,
            settings.shot_noise,
            image,
        )
        return (
            image if settings.jpeg_quality is None else through_jpeg(image, settings.jpeg_quality)
        )


def through_jpeg(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """Return an RGB image as it comes out of JPEG at a quality of 1 to 100."""
    _, encoded = cv2.imencode(
        '.jpg', cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    decoded = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR))
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), dtype=np.uint8)
