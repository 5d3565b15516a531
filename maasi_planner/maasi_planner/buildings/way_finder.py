"""Paths around obstacles."""

import heapq

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_planner.buildings.preplanning import segment_cuts

_BERTH = 3.0  # distance of intermediate targets from the corners of obstacles [m]


class WayFinder:
    """Paths around boxes (n, 3, 2) [m]: a visibility graph over their corners, by travel time."""

    def __init__(self, solids: FloatArray, area: FloatArray, speed: float, climb: float) -> None:
        self.solids = solids
        self.area = area
        self._speeds = np.array([speed, speed, max(climb, 1e-3)])
        self._down = speed

    def first_corner(self, place: FloatArray, target: FloatArray) -> FloatArray:
        """Return the next corner (3,) of the path to a target; without any, the target."""
        if not segment_cuts(place, target, self.solids).any():
            return target
        points = np.vstack([place, target, self._corners(place, target)])
        number = len(points)
        way = points[None, :, :] - points[:, None, :]
        times = np.abs(way) / self._speeds
        times[:, :, 2] = np.where(way[:, :, 2] > 0.0, times[:, :, 2], -way[:, :, 2] / self._down)
        times = times.max(axis=2) + 1e-3 * np.sqrt((way * way).sum(axis=2))
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

    def reaches(self, place: FloatArray, target: FloatArray) -> bool:
        """Return whether a path leads from a position to a target."""
        if not segment_cuts(place, target, self.solids).any():
            return True
        return bool((self.first_corner(place, target) != target).any())

    def _corners(self, place: FloatArray, target: FloatArray) -> FloatArray:
        points = np.array(
            [
                (x, y, height)
                for box in self.solids
                for height in (place[2], target[2], box[2, 1] + _BERTH)
                for x in (box[0, 0] - _BERTH, box[0, 1] + _BERTH)
                for y in (box[1, 0] - _BERTH, box[1, 1] + _BERTH)
            ]
        )
        free = ((points >= self.area[:, 0]) & (points <= self.area[:, 1])).all(axis=1)
        low = points[:, None, :] > self.solids[None, :, :, 0]
        high = points[:, None, :] < self.solids[None, :, :, 1]
        free &= ~np.all(low & high, axis=2).any(axis=1)
        return np.asarray(points[free])
