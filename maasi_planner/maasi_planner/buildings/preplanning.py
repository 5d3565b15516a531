"""Pre-planning: from objects to cuboids (004, IV), and paths around obstacles."""

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_planner.buildings.settings import (
    FACES,
    BoxSettings,
    CuboidSettings,
    Face,
    ObjectSettings,
    SearchCameraSettings,
)

_THINNEST = 1.0  # least thickness of a cuboid [m]


def detection_probability(distance: float, camera: SearchCameraSettings) -> float:
    """Return p_d at a distance from the face [m]: (4), but 0 only below d_min, not at d_min."""
    if distance < camera.least_distance:
        return 0.0
    span = camera.largest_distance - camera.least_distance
    return max(0.0, 1.0 - (distance - camera.least_distance) / span)


def footprint(distance: float, camera: SearchCameraSettings) -> float:
    """Return r, the side length of the camera's square footprint at a distance [m] (III-C)."""
    return 2.0 * distance * math.tan(0.5 * camera.angle)


@dataclass(frozen=True)
class Cell:
    """A part of a face, and the cuboid from which it is searched."""

    target: int  # index of the object
    face: str  # west, east, south, north, bottom or top
    centre: FloatArray  # (3,) of the cell [m]
    normal: FloatArray  # (3,) outward
    size: FloatArray  # (2,): sides of the cell [m]
    box: FloatArray  # (3, 2): lower and upper corner of the cuboid [m]

    def sides(self) -> FloatArray:
        """Return lower and upper corner of the cell, (3, 2) [m], equal along its normal."""
        half = np.zeros(3)
        half[self.normal == 0.0] = 0.5 * self.size
        return np.stack([self.centre - half, self.centre + half], axis=1)

    def distance(self, position: ArrayLike) -> float:
        """Return the distance of a position (3,) from the face [m]."""
        return float((np.asarray(position, dtype=float) - self.centre) @ self.normal)


@dataclass(frozen=True)
class CoveragePlan:
    """Cells of the searched faces with their cuboids, planned before take-off."""

    cells: list[Cell]
    lost: list[tuple[Cell, str]]  # other cells, with reasons
    area: FloatArray  # (3, 2): admissible positions [m]
    objects: FloatArray  # (n, 3, 2): true size, without clearance [m]
    obstacles: FloatArray
    distance: float  # d [m]
    footprint: float  # r [m]
    coverage: float  # share of the faces that snapshots cover, 0 to 1
    boxes: FloatArray = field(init=False)
    centres: FloatArray = field(init=False)
    solids: FloatArray = field(init=False)  # objects and obstacles

    def __post_init__(self) -> None:
        boxes = np.array([cell.box for cell in self.cells]).reshape(-1, 3, 2)
        object.__setattr__(self, 'boxes', boxes)
        object.__setattr__(self, 'centres', boxes.mean(axis=2))
        object.__setattr__(self, 'solids', np.concatenate([self.objects, self.obstacles]))

    def inside(self, position: ArrayLike) -> BoolArray:
        """Return which cuboids contain a position (3,), (N,)."""
        point = np.asarray(position, dtype=float)
        return np.asarray(
            ((self.boxes[:, :, 0] <= point) & (point <= self.boxes[:, :, 1])).all(axis=1)
        )

    def hits(self, position: ArrayLike) -> bool:
        """Return whether a position (3,) is inside an object or obstacle."""
        return bool(_inside(np.asarray(position, dtype=float), self.solids).all(axis=1).any())

    def path_hits(self, begin: ArrayLike, end: ArrayLike) -> bool:
        """Return whether the segment between two positions (3,) cuts an object or obstacle."""
        ends = np.asarray(begin, dtype=float), np.asarray(end, dtype=float)
        return bool(segment_cuts(*ends, self.solids).any())


def _inside(position: FloatArray, boxes: FloatArray) -> BoolArray:
    point = position[..., None, :]
    return np.asarray((boxes[:, :, 0] < point) & (point < boxes[:, :, 1]))


def segment_cuts(begin: FloatArray, end: FloatArray, boxes: FloatArray) -> BoolArray:
    """Return which boxes (n, 3, 2) have interiors that segments (..., 3) cut, (..., n)."""
    offset = end - begin
    with np.errstate(divide='ignore', invalid='ignore'):
        first = (boxes[:, :, 0] - begin[..., None, :]) / offset[..., None, :]
        second = (boxes[:, :, 1] - begin[..., None, :]) / offset[..., None, :]
    still = np.broadcast_to(offset[..., None, :] == 0.0, first.shape)
    within = _inside(begin, boxes)
    enter = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(first, second))
    leave = np.where(still, np.where(within, np.inf, -np.inf), np.maximum(first, second))
    start = np.maximum(enter.max(axis=-1), 0.0)
    stop = np.minimum(leave.min(axis=-1), 1.0)
    return np.asarray(start < stop - 1e-12)


def plan_mission(settings: CuboidSettings, area: ArrayLike) -> CoveragePlan:
    """Return the coverage plan of a mission in an area (3, 2) [m]."""
    bounds = np.asarray(area, dtype=float)
    if not settings.objects:
        raise ValueError('objects: got none, allowed is at least one object to search')
    objects = _boxes('objects', settings.objects, bounds)
    obstacles = _boxes('obstacles', settings.obstacles, bounds)
    solids = np.concatenate([objects, obstacles])
    camera = settings.camera
    span = camera.largest_distance - camera.least_distance
    distance = camera.least_distance + (1.0 - settings.detection_probability) * span
    side = footprint(distance, camera)
    cells: list[Cell] = []
    lost: list[tuple[Cell, str]] = []
    seen = total = 0.0
    for index, item in enumerate(settings.objects):
        for face in item.faces:
            for cell in _face_cells(index, face, objects[index], distance, side, settings):
                size = float(np.prod(cell.size))
                total += size
                box, reason = _usable(cell, bounds, solids, settings)
                if reason:
                    lost.append((cell, reason))
                    continue
                seen += float(np.prod(np.minimum(side / cell.size, 1.0))) * size
                cells.append(replace(cell, box=box))
    if not cells:
        reasons = '; '.join(sorted({reason for _, reason in lost}))
        raise ValueError(
            f'objects: no cuboid can be reached ({reasons}); allowed is an area that leaves space '
            f'at {distance:.1f} m from a face'
        )
    return CoveragePlan(cells, lost, bounds, objects, obstacles, distance, side, seen / total)


def _boxes(key: str, items: Sequence[BoxSettings], area: FloatArray) -> FloatArray:
    boxes = np.zeros((len(items), 3, 2))
    for index, item in enumerate(items):
        box = item.array(float(area[2, 0]))
        outside = (box[:, 0] < area[:, 0] - 1e-9) | (box[:, 1] > area[:, 1] + 1e-9)
        # An obstacle may extend beyond the area.
        wrong = (
            outside.any()
            if isinstance(item, ObjectSettings)
            else ((box[:, 1] <= area[:, 0]) | (box[:, 0] >= area[:, 1])).any()
        )
        if wrong:
            raise ValueError(
                f'{key}[{index}]: read centre {item.centre}, size {item.size}, allowed is what '
                f'lies inside the area, {area.tolist()} [m]'
            )
        boxes[index] = box
    return boxes


def _face_cells(
    index: int, face: Face, box: FloatArray, distance: float, side: float, settings: CuboidSettings
) -> Iterator[Cell]:
    axis, upper = divmod(FACES.index(face), 2)
    others = [a for a in range(3) if a != axis]
    normal = np.zeros(3)
    normal[axis] = 1.0 if upper else -1.0
    lengths = (box[:, 1] - box[:, 0])[others]
    if settings.coverage == 'strict':
        counts = np.ceil(lengths / side - 1e-9).astype(int)
    else:
        counts = np.maximum(np.floor(lengths / side + 0.5).astype(int), 1)
    size = lengths / counts
    half = 0.5 * settings.cuboid_size
    for j in range(counts[1]):
        for i in range(counts[0]):
            centre = np.empty(3)
            centre[axis] = box[axis, upper]
            centre[others] = box[others, 0] + (np.array([i, j]) + 0.5) * size
            middle = centre + distance * normal
            corners = np.stack([middle - half, middle + half], axis=1)
            yield Cell(index, face, centre, normal, size, corners)


def _usable(
    cell: Cell, area: FloatArray, solids: FloatArray, settings: CuboidSettings
) -> tuple[FloatArray, str]:
    box = np.stack(
        [np.maximum(cell.box[:, 0], area[:, 0]), np.minimum(cell.box[:, 1], area[:, 1])], axis=1
    )
    if (box[:, 1] - box[:, 0] < _THINNEST).any():
        if cell.box[2, 1] < area[2, 0] + _THINNEST:
            return box, 'a cuboid is below the floor'
        if cell.box[2, 0] > area[2, 1] - _THINNEST:
            return box, 'a cuboid is above the ceiling'
        return box, 'a cuboid is outside the area'
    for solid in solids:
        wall = solid + np.array([-settings.clearance, settings.clearance])
        if ((box[:, 0] >= wall[:, 1]) | (box[:, 1] <= wall[:, 0])).any():
            continue
        # Keep the largest part next to the solid.
        parts = []
        for axis in range(3):
            below, above = box.copy(), box.copy()
            below[axis, 1] = min(box[axis, 1], wall[axis, 0])
            above[axis, 0] = max(box[axis, 0], wall[axis, 1])
            parts += [below, above]
        thickness = [float((part[:, 1] - part[:, 0]).min()) for part in parts]
        volumes = [
            float(np.prod(part[:, 1] - part[:, 0])) if thin >= _THINNEST else 0.0
            for part, thin in zip(parts, thickness)
        ]
        if max(volumes) <= 0.0:
            return box, 'a cuboid is inside another object'
        box = parts[int(np.argmax(volumes))]
    middle = box.mean(axis=1)
    near = cell.centre + 1e-6 * cell.normal
    if segment_cuts(middle, near, solids).any():
        return box, 'another object blocks the view from a cuboid'
    return box, ''


_BERTH = 3.0  # distance of intermediate targets from the corners of obstacles [m]


class PathFinder:
    """Fastest paths around boxes (n, 3, 2) [m] by a visibility graph of their corners."""

    def __init__(self, solids: FloatArray, area: FloatArray, speed: float, climb: float) -> None:
        self.solids, self.area = solids, area
        self._speeds = np.array([speed, speed, max(climb, 1e-3)])
        self._down = speed

    def first_corner(self, point: FloatArray, target: FloatArray) -> FloatArray:
        """Return the next corner (3,) of the path to a target, or the target."""
        if not segment_cuts(point, target, self.solids).any():
            return target
        points = np.vstack([point, target, self._corners(point, target)])
        number = len(points)
        offset = points[None, :, :] - points[:, None, :]
        times = np.abs(offset) / self._speeds
        times[:, :, 2] = np.where(
            offset[:, :, 2] > 0.0, times[:, :, 2], -offset[:, :, 2] / self._down
        )
        times = times.max(axis=2) + 1e-3 * np.sqrt((offset * offset).sum(axis=2))
        for i in range(number):
            blocked = segment_cuts(
                np.broadcast_to(points[i], points.shape), points, self.solids
            ).any(axis=1)
            times[i, blocked] = np.inf
        best = np.full(number, np.inf)
        before = np.full(number, -1)
        best[0] = 0.0
        queue = [(0.0, 0)]
        while queue:
            spent, i = heapq.heappop(queue)
            if i == 1:
                break
            if spent > best[i]:
                continue
            for j in np.flatnonzero(spent + times[i] < best - 1e-12):
                best[j] = spent + times[i, j]
                before[j] = i
                heapq.heappush(queue, (float(best[j]), int(j)))
        if not np.isfinite(best[1]):
            return target
        node = 1
        while before[node] != 0:
            node = int(before[node])
        return np.asarray(points[node])

    def reaches(self, point: FloatArray, target: FloatArray) -> bool:
        """Return whether a path leads from a position to a target."""
        if not segment_cuts(point, target, self.solids).any():
            return True
        return bool((self.first_corner(point, target) != target).any())

    def _corners(self, point: FloatArray, target: FloatArray) -> FloatArray:
        points = np.array(
            [
                (x, y, height)
                for box in self.solids
                for height in (point[2], target[2], box[2, 1] + _BERTH)
                for x in (box[0, 0] - _BERTH, box[0, 1] + _BERTH)
                for y in (box[1, 0] - _BERTH, box[1, 1] + _BERTH)
            ]
        )
        free = ((points >= self.area[:, 0]) & (points <= self.area[:, 1])).all(axis=1)
        free &= ~np.all(_inside(points, self.solids), axis=2).any(axis=1)
        return np.asarray(points[free])
