"""A simulated camera: images (h, w) of the floor [m, map] and markers, in linear light."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_drivers.vision.camera_model import Camera
from maasi_filter.arrays import FloatArray, ImageArray
from maasi_filter.geometry.terrain import Terrain, ray_length
from maasi_filter.models.pose import Pose
from maasi_sim.simulation.floor import RenderSettings, Shape
from maasi_sim.simulation.world import noise_stream

DISC, RECTANGLE = 0, 1


class Shot(NamedTuple):
    """A camera in the map, and the motion of its robot during the exposure."""

    centre: FloatArray  # (3,) [m]
    turn: FloatArray  # (3, 3) from camera to map
    matrix: FloatArray
    distortion: FloatArray
    largest_radius: float
    origin: FloatArray  # (3,) of the robot [m]
    velocity: FloatArray  # (3,) in the map [m/s]
    rotation_rate: FloatArray  # (3,) in the map [rad/s]
    exposure_time: float  # [s]
    heights: FloatArray  # of the ground at each shape [m]
    level: bool  # whether the ground is the plane z = 0


class Exposure(NamedTuple):
    """Conversion of light to grey levels."""

    lens: FloatArray  # share of transmitted light, (h, w)
    light: FloatArray  # amplitude, wave vector [turns/m] and phase [turns], (4,)
    gains: FloatArray  # of R, G, B
    read_noise: float  # deviation in the dark
    shot_noise: float  # variance per grey level of signal


@njit(cache=True, error_model='numpy')
def floor_points(rays, turn, centre, floor_x, floor_y):  # type: ignore[no-untyped-def]
    """Intersect each pixel's ray with the floor; nan above the horizon."""
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


@njit(cache=True, error_model='numpy')
def terrain_points(rays, turn, centre, surface, floor_x, floor_y):  # type: ignore[no-untyped-def]
    """Intersect each pixel's ray with the terrain; nan where it does not meet it."""
    way = np.empty(3)
    for row in range(floor_x.shape[0]):
        for column in range(floor_x.shape[1]):
            u, v = rays[0, row, column], rays[1, row, column]
            for axis in range(3):
                way[axis] = turn[axis, 0] * u + turn[axis, 1] * v + turn[axis, 2]
            scale = ray_length(surface, centre, way) if u == u else np.inf
            scale = scale if scale < np.inf else np.nan
            floor_x[row, column] = centre[0] + scale * way[0]
            floor_y[row, column] = centre[1] + scale * way[1]


@njit(cache=True)
def _project(points, shot):  # type: ignore[no-untyped-def]
    """Project points (n, 3) to pixels (n, 2), as `Camera.project`, in a kernel for small images."""
    centre, turn, matrix, k = shot.centre, shot.turn, shot.matrix, shot.distortion
    pixels = np.full((points.shape[0], 2), np.nan)
    for i in range(points.shape[0]):
        dx, dy, dz = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        depth = turn[0, 2] * dx + turn[1, 2] * dy + turn[2, 2] * dz
        x = (turn[0, 0] * dx + turn[1, 0] * dy + turn[2, 0] * dz) / max(depth, 1e-9)
        y = (turn[0, 1] * dx + turn[1, 1] * dy + turn[2, 1] * dz) / max(depth, 1e-9)
        r2 = x * x + y * y
        if depth > 1e-9 and r2 < shot.largest_radius * shot.largest_radius:
            radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
            u = x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x)
            v = y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y
            pixels[i, 0] = matrix[0, 0] * u + matrix[0, 2]
            pixels[i, 1] = matrix[1, 1] * v + matrix[1, 2]
    return pixels


@njit(cache=True)
def place(shapes, rims, floor_x, floor_y, shot, margin, boxes, drift):  # type: ignore[no-untyped-def]
    """Find the pixels that each shape may touch, and its motion during the exposure.

    boxes (n, 4): left, top, right, bottom; empty out of view. drift (n, 2): on the floor [m].
    """
    centre, matrix = shot.centre, shot.matrix
    origin, exposure_time = shot.origin, shot.exposure_time
    velocity, rotation_rate = shot.velocity, shot.rotation_rate
    height, width = floor_x.shape
    left = bottom = np.inf
    right = top = -np.inf
    horizon = not shot.level
    # The border of the image bounds the visible floor, as floor coordinates vary smoothly over it.
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
        reach = slack + (a if shapes[i, 0] == DISC else np.sqrt(a * a + b * b))
        if not horizon and (
            x < left - reach or x > right + reach or y < bottom - reach or y > top + reach
        ):
            continue
        spread = 0.0
        above = centre[2] - shot.heights[i]
        if exposure_time > 0.0 and above > 0.0:
            # The floor point of a pixel moves with the camera, the shape in the opposite direction.
            ax, ay, az = x - origin[0], y - origin[1], shot.heights[i] - origin[2]
            moved_x = velocity[0] + rotation_rate[1] * az - rotation_rate[2] * ay
            moved_y = velocity[1] + rotation_rate[2] * ax - rotation_rate[0] * az
            moved_z = velocity[2] + rotation_rate[0] * ay - rotation_rate[1] * ax
            drift[i, 0] = -exposure_time * (moved_x + (x - centre[0]) / above * moved_z)
            drift[i, 1] = -exposure_time * (moved_y + (y - centre[1]) / above * moved_z)
            move = np.sqrt(drift[i, 0] ** 2 + drift[i, 1] ** 2)
            spread = move * max(matrix[0, 0], matrix[1, 1]) / above
        pixels = _project(rims[i], shot)
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
    """Return the distance to the edge, negative inside, and its gradient by x and y."""
    if kind == DISC:
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
def paint(albedo, floor_x, floor_y, shapes, boxes, drift, blur):  # type: ignore[no-untyped-def]
    """Blend shapes (n, 10) into the albedo in their pixel boxes, with soft, blurred edges."""
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
                # The pixel's footprint on the floor, from its neighbours.
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
                # Pixels far from the edge, relative to its blur and motion, are fully in or out.
                edge = np.sqrt(xc * xc + yc * yc + xr * xr + yr * yr)
                if abs(distance) > 0.5 * (move + soft * edge):
                    cover = 1.0 if distance < 0.0 else 0.0
                else:
                    footprint = np.sqrt(abs(xc * yr - xr * yc))
                    count = min(int(np.ceil(2.0 * move / footprint)) + 1, 33)
                    cover = 0.0
                    for sample in range(count):
                        t = (sample + 0.5) / count - 0.5
                        dx, dy = x - cx - t * drift[index, 0], y - cy - t * drift[index, 1]
                        distance, nx, ny = _signed_distance(kind, a, b, cosine, sine, dx, dy)
                        slope = np.sqrt((nx * xc + ny * yc) ** 2 + (nx * xr + ny * yr) ** 2)
                        cover += min(max(0.5 - distance / (slope * soft), 0.0), 1.0)
                    cover /= count
                if cover > 0.0:
                    for channel in range(3):
                        albedo[channel, row, column] += cover * (
                            shapes[index, 7 + channel] - albedo[channel, row, column]
                        )


@njit(cache=True)
def floor_albedo(floor_x, floor_y, colour, texture, albedo):  # type: ignore[no-untyped-def]
    """Fill albedo (3, h, w) with the floor's colour, with speckle hashed from its position."""
    height, width = floor_x.shape
    for channel in range(3):
        albedo[channel] = colour[channel]
    if texture == 0.0:
        return
    # Cells of a centimetre.
    per_cell = 100.0
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
def expose(albedo, floor_x, floor_y, exposure, noise, offsets, image):  # type: ignore[no-untyped-def]
    """Convert albedo (3, h, w) to grey levels (h, w, 3); parabolas approximate the light's sine."""
    lens, light, gains = exposure.lens, exposure.light, exposure.gains
    read, shot = exposure.read_noise, exposure.shot_noise
    height, width = floor_x.shape
    brightness = np.empty(width, dtype=np.float32)
    levels = np.empty((3, width), dtype=np.uint8)
    amplitude = 4.0 * light[0]
    read2, shot1 = np.float32(read * read), np.float32(shot)
    zero, half, full = np.float32(0.0), np.float32(0.5), np.float32(255.0)
    # Row by row over contiguous memory, so that the compiler vectorises.
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


class CameraRenderer:
    """Renders the images of one robot's camera."""

    def __init__(
        self,
        camera: Camera,
        settings: RenderSettings,
        shapes: Sequence[Shape],
        seed: int,
        robot: str,
        terrain: Terrain | None = None,
    ) -> None:
        self.camera, self.settings, self.seed, self.robot = camera, settings, seed, robot
        self._terrain = terrain
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
        self._heights = np.zeros(len(shapes))
        if terrain is not None and shapes:
            self._heights = terrain.heights(self._shapes[:, 1:3])
            self._rims[:, :, 2] = terrain.heights(self._rims.reshape(-1, 3)).reshape(-1, 16)
        # Uneven light is common to all cameras; exposure and white balance drift separately.
        room = noise_stream(seed, purpose='light')
        direction, phase = room.uniform(0.0, 2.0 * np.pi), room.uniform(0.0, 1.0)
        wave = np.array([np.cos(direction), np.sin(direction)]) / settings.light_wavelength
        self._light = np.array([settings.light_variation, *wave, phase])
        drift = noise_stream(seed, robot, purpose='camera drift')
        self._drift_phases = drift.uniform(0.0, 2.0 * np.pi, size=4)
        self._drift_rates = 2.0 * np.pi / settings.drift_period * drift.uniform(0.7, 1.4, size=4)
        # Normal numbers shared by all cameras, read at random offsets per row.
        table = np.random.Generator(np.random.PCG64(20240601))
        self._noise = table.standard_normal(1 << 16, dtype=np.float32)
        self._floor_x = np.empty((camera.height, camera.width))
        self._floor_y = np.empty_like(self._floor_x)
        self._albedo = np.empty((3, camera.height, camera.width), dtype=np.float32)
        self._boxes = np.zeros((len(shapes), 4), dtype=np.int64)
        self._drift = np.zeros((len(shapes), 2))
        self._floor_colour = np.array(settings.floor_colour, dtype=float)

    def _shape_rims(self) -> FloatArray:
        """Return points (n, 16, 3) slightly outside of each shape."""
        angles = np.arange(16) * (np.pi / 8.0)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        # A square along the rectangle's axes: circle points moved outwards to the sides.
        square = circle / np.abs(circle).max(axis=1, keepdims=True)
        rims = np.zeros((len(self._shapes), 16, 3))
        for rim, shape in zip(rims, self._shapes):
            outline = square if shape[0] == RECTANGLE else 1.03 * circle
            local = outline * shape[3:5]
            rim[:, 0] = shape[1] + shape[5] * local[:, 0] - shape[6] * local[:, 1]
            rim[:, 1] = shape[2] + shape[6] * local[:, 0] + shape[5] * local[:, 1]
        return rims

    def gains(self, time: float) -> FloatArray:
        """Return exposure times white balance of R, G, B at a time [s], (3,)."""
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
        floor = self._floor_x, self._floor_y
        if self._terrain is None:
            floor_points(self._rays, turn, centre, *floor)
        else:
            terrain_points(self._rays, turn, centre, self._terrain.surface, *floor)
        floor_albedo(*floor, self._floor_colour, settings.floor_texture, self._albedo)
        shot = Shot(
            centre,
            turn,
            camera.matrix,
            camera.distortion,
            # The kernel supports only this model; otherwise shapes may be anywhere.
            float(camera.largest_radius) if camera.model == 'plumb_bob' else 0.0,
            pose.position,
            np.array(velocity, dtype=float),
            rotation @ np.asarray(angular_velocity, dtype=float),
            float(settings.exposure_time),
            self._heights,
            self._terrain is None,
        )
        margin = 3.0 + 2.0 * settings.blur
        place(self._shapes, self._rims, *floor, shot, margin, self._boxes, self._drift)
        paint(self._albedo, *floor, self._shapes, self._boxes, self._drift, settings.blur)
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
        expose(self._albedo, *floor, exposure, self._noise, offsets, image)
        if settings.jpeg_quality is None:
            return image
        quality = [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality]
        _, encoded = cv2.imencode('.jpg', cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality)
        decoded = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR))
        return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), dtype=np.uint8)
