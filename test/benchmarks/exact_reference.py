"""Exact filter of targets that stand still: a Poisson multi-Bernoulli mixture, on adaptive grids.

After García-Fernández et al. (2018). A global hypothesis is a partition of the detections into
tracks. With rho = N0 / V, its weight is the product of kappa + rho F over tracks of one detection
and rho F over the others; F is the integral over positions of pi g for the detections of a track
and 1 - pi for the other scans. Tracks that no detection links are independent: each group of tracks
has its own mixture.
"""

import math
from functools import cached_property
from itertools import product

import numpy as np
from numba import njit

from maasi_filter.models.detection import detection_probability_at
from maasi_filter.models.measurement import wrap

# Weight of a hypothesis relative to the best one of its group, and how many a group has.
LEAST_WEIGHT, MOST_HYPOTHESES = 1e-6, 1000
LEAST_EXISTENCE = 1e-5  # r of a track
ROOT = 32  # cells on a side of the coarsest grid
LEAST_SPACING = 0.03  # of cells [m]
TOLERANCE = 1e-3  # change of the log of F at which a grid is fine enough
# Logs of densities relative to the largest one, below which cells are left out: of a grid, and of
# one that is refined.
CUT, LOOSE_CUT = 16.0, 25.0
GATE = 36.0  # squared normalised distance of a detection from the nearest cell
CORNERS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])


@njit(cache=True, error_model='numpy')
def add_misses(cells, spacing, logs, counts, poses, kind, parameters):  # type: ignore[no-untyped-def]
    """Return the log of the product of 1 - pi over all scans (n,); `logs` keep it by cell."""
    out = np.empty(len(cells))
    for i in range(len(cells)):
        a, b = int(cells[i, 0] / spacing), int(cells[i, 1] / spacing)
        for k in range(counts[a, b], len(poses)):
            x, y = cells[i, 0] - poses[k, 0], cells[i, 1] - poses[k, 1]
            pi = detection_probability_at(kind, parameters, x, y, 0.0, 1.0, 0.0)
            logs[a, b] += math.log1p(-pi)
        counts[a, b] = len(poses)
        out[i] = logs[a, b]
    return out


@njit(cache=True, error_model='numpy')
def add_seen(logs, cells, poses, kind, parameters, seen, deviations, reach):  # type: ignore[no-untyped-def]
    """Add the log of pi g / (1 - pi) of detections to `logs`; return a bound on it.

    `seen` (s, 3) are scan, range and bearing; the bound is that of the last one within `reach`.
    """
    bound = np.empty(len(cells))
    for i in range(len(cells)):
        for s in range(len(seen)):
            k = int(seen[s, 0])
            x, y = cells[i, 0] - poses[k, 0], cells[i, 1] - poses[k, 1]
            pi = detection_probability_at(kind, parameters, x, y, 0.0, 1.0, 0.0)
            distance = max(math.sqrt(x * x + y * y), 1e-9)
            gap, turn = abs(seen[s, 1] - distance), abs(wrap(seen[s, 2] - math.atan2(y, x)))
            square = (gap / deviations[0]) ** 2 + (turn / deviations[1]) ** 2
            logs[i] += math.log(pi / (1.0 - pi) / (2.0 * math.pi * deviations[0] * deviations[1]))
            logs[i] -= 0.5 * square
            near = (max(gap - reach, 0.0) / deviations[0]) ** 2
            near += (max(turn - reach / distance, 0.0) / deviations[1]) ** 2
            bound[i] = logs[i] + 0.5 * (square - near)
    return bound


class Track:
    """Detections that may be of one target, and cells of where it then is."""

    def __init__(self, exact, seen, cells, spacing, logs):
        """Take in the last detection, and refine cells until the mass F changes no more.

        `logs` (n,) are of the other detections at the cells, and of `spacing` metres.
        """
        self.seen, self.exact = seen, exact
        before, coarse, logs = -math.inf, None, logs.copy()
        bound = exact.add_seen(logs, cells, spacing, seen[-1:])
        while True:
            self.mass = float(np.logaddexp.reduce(logs)) + 2.0 * math.log(spacing)
            fine = abs(self.mass - before) < TOLERANCE
            coarse = coarse if fine else (cells, spacing, logs)
            if fine or spacing < LEAST_SPACING:
                break
            before = self.mass
            kept = cells[bound > bound.max() - LOOSE_CUT]
            spacing *= 0.5
            cells = (kept[:, None] + 0.5 * spacing * CORNERS).reshape(-1, 2)
            logs = exact.log_missed(cells, spacing)
            bound = exact.add_seen(logs, cells, spacing, seen)
        self.cells, self.spacing, self.logs = coarse
        self._keep()

    def _keep(self):
        kept = self.logs > self.logs.max() - CUT
        self.cells, self.logs = self.cells[kept], self.logs[kept]

    @property
    def log_weight(self):
        log_mass = self.exact.log_rate + self.mass
        return float(np.logaddexp(self.exact.log_clutter, log_mass)) if self.single else log_mass

    @property
    def single(self):
        return len(self.seen) == 1

    @property
    def existence(self):
        return math.exp(self.exact.log_rate + self.mass - self.log_weight)

    def miss(self, pose):
        """Take in a scan without a detection; return the change of the log weight."""
        before, model = self.log_weight, self.exact.sensor.detection
        self.logs = self.logs + np.log1p(-model.probability(self.cells, pose))
        self.mass = float(np.logaddexp.reduce(self.logs)) + 2.0 * math.log(self.spacing)
        self._keep()
        self.__dict__.pop('moments', None)
        return self.log_weight - before

    @cached_property
    def moments(self):
        """Mean, and mean of the outer products of positions."""
        weights = np.exp(self.logs - self.logs.max())
        weights /= weights.sum()
        inside = np.eye(2) * self.spacing**2 / 12.0
        return weights @ self.cells, (self.cells.T * weights) @ self.cells + inside


class Reference:
    """Exact filter of the targets in a square of `side` metres, of which `expected` are expected.

    `groups` are mixtures of (weight, set of tracks); `lost` is the largest weight that the limit on
    hypotheses has cost.
    """

    def __init__(self, sensor, side, expected, clutter):
        self.sensor, self.lost = sensor, 0.0
        self.log_rate = math.log(expected / side**2)
        self.log_clutter = math.log(clutter) if clutter > 0.0 else -math.inf
        self._deviations = np.sqrt(np.diagonal(sensor.covariance))
        self._poses, self.groups, self._missed = np.empty((0, 2)), [], {}
        self._side = side / ROOT
        axis = self._side * (np.arange(ROOT) + 0.5)
        self._root = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)

    def log_missed(self, cells, spacing):
        """Return the log of e at cells of a grid (n,)."""
        if spacing not in self._missed:
            shape = (round(ROOT * self._side / spacing),) * 2
            self._missed[spacing] = np.zeros(shape), np.zeros(shape, np.int16)
        model, kept = self.sensor.detection.kernel(), self._missed[spacing]
        return add_misses(cells, spacing, *kept, self._poses, *model)

    def add_seen(self, logs, cells, spacing, seen):
        """Add detections to the logs (n,) of cells; return a bound on them (n,)."""
        kernel, reach = self.sensor.detection.kernel(), spacing * math.sqrt(0.5)
        return add_seen(logs, cells, self._poses, *kernel, np.array(seen), self._deviations, reach)

    def _reaches(self, cells, spacing, pose, value):
        """Whether a detection is within the gate of a cell."""
        x, y = (cells - pose.position[:2]).T
        distance, reach = np.maximum(np.hypot(x, y), 1e-9), spacing * math.sqrt(0.5)
        turn = np.abs(np.mod(value[1] - np.arctan2(y, x) + math.pi, 2.0 * math.pi) - math.pi)
        gaps = np.abs(value[0] - distance) - reach, turn - reach / distance
        squares = [(np.maximum(gap, 0.0) / dev) ** 2 for gap, dev in zip(gaps, self._deviations)]
        return bool((sum(squares) < GATE).any())

    def update(self, pose, values):
        """Take in a scan of detections (m, 2)."""
        number = len(self._poses)
        self._poses = np.concatenate([self._poses, pose.position[None, :2]])
        tracks = {track: g for g, group in enumerate(self.groups) for _, t in group for track in t}
        values = [v for v in values if self._reaches(self._root, self._side, pose, v)]
        seen = [(float(number), *value) for value in values]
        unseen = self.log_missed(self._root, self._side)
        born = [Track(self, [item], self._root, self._side, unseen) for item in seen]
        joined, change, linked = {}, {}, [set() for _ in values]
        for track, g in tracks.items():
            change[track] = track.miss(pose)
            cells, spacing = track.cells, track.spacing
            reached = [j for j, v in enumerate(values) if self._reaches(cells, spacing, pose, v)]
            new = {
                j: Track(self, [*track.seen, seen[j]], cells, spacing, track.logs) for j in reached
            }
            for j, longer in new.items():
                log_ratio = longer.log_weight - track.log_weight - born[j].log_weight
                if log_ratio > math.log(LEAST_WEIGHT):
                    joined[track, j] = math.exp(min(log_ratio, 600.0)), longer
                    linked[j].add(g)
        # Groups that a detection links become one.
        sets = [({g}, set()) for g in range(len(self.groups))]
        for j, link in enumerate(linked):
            touched = [item for item in sets if item[0] & link]
            sets = [item for item in sets if item not in touched]
            groups = set().union(*(item[0] for item in touched))
            sets.append((groups, {j}.union(*(item[1] for item in touched))))
        mixtures = [self._extended(g, sorted(js), joined, change, born) for g, js in sets]
        self.groups = [part for mixture in mixtures for part in independent(mixture)]

    def _extended(self, groups, detections, joined, change, born):
        """Return the mixture of groups after a scan, by all ways to assign its detections."""
        mixture = [(1.0, frozenset())]
        for g in sorted(groups):
            pairs = product(mixture, self.groups[g])
            mixture = self._limited([(v * w, one | other) for (v, one), (w, other) in pairs])
        extended, best = {}, 0.0

        def assign(place, weight, kept):
            nonlocal best
            if weight * bounds[place] < LEAST_WEIGHT * best:
                return
            if place == len(detections):
                best = max(best, weight)
                key = frozenset(track for track in kept if track.existence > LEAST_EXISTENCE)
                extended[key] = extended.get(key, 0.0) + weight
                return
            j = detections[place]
            for track in kept & candidates[place]:
                ratio, longer = joined[track, j]
                assign(place + 1, weight * ratio, kept - {track} | {longer})
            assign(place + 1, weight, kept | {born[j]})

        logs = [math.log(w) + sum(change[track] for track in tracks) for w, tracks in mixture]
        for log, (_, tracks) in sorted(zip(logs, mixture), key=lambda item: -item[0]):
            candidates = [{t for t in tracks if (t, j) in joined} for j in detections]
            most = [
                max([1.0, *(joined[t, j][0] for t in found)])
                for j, found in zip(detections, candidates)
            ]
            bounds = [math.prod(most[place:]) for place in range(len(most) + 1)]
            assign(0, math.exp(log - max(logs)), tracks)
        return self._limited([(weight, key) for key, weight in extended.items()])

    def _limited(self, mixture):
        """Return the most probable hypotheses with weights that sum to one."""
        mixture = sorted(mixture, key=lambda item: -item[0])
        total = sum(weight for weight, _ in mixture)
        kept = [item for item in mixture[:MOST_HYPOTHESES] if item[0] > LEAST_WEIGHT * total]
        rest = sum(weight for weight, _ in kept)
        self.lost = max(self.lost, sum(w for w, _ in mixture[MOST_HYPOTHESES:]) / total)
        return [(weight / rest, tracks) for weight, tracks in kept]

    def targets(self):
        """Return r, mean, covariance and hits of potential targets, the best hypothesis first.

        A track of another hypothesis counts for the target with which it shares most detections.
        """
        found = []
        for mixture in self.groups:
            rows = {}
            for weight, tracks in mixture:
                alike = {}
                for track in sorted(tracks, key=lambda track: track.seen):
                    shared = {other: len({*track.seen} & {*other.seen}) for other in rows}
                    best = max(shared, key=shared.get, default=track)
                    best = best if shared.get(best) else track
                    rows.setdefault(best, np.zeros(7))
                    alike.setdefault(best, []).append(track)
                for best, others in alike.items():
                    most = max(others, key=lambda other: other.existence)
                    mean, square = most.moments
                    row = np.concatenate([[1.0], mean, square.ravel()])
                    rows[best] += weight * most.existence * row
            for track, row in rows.items():
                mean, square = row[1:3] / row[0], row[3:].reshape(2, 2) / row[0]
                found.append((row[0], mean, square - np.outer(mean, mean), len(track.seen)))
        return found


def independent(mixture):
    """Return mixtures whose product is this one: a track of all hypotheses is its own group."""
    common = frozenset.intersection(*(tracks for _, tracks in mixture))
    rest = [(weight, tracks - common) for weight, tracks in mixture]
    groups = [[(1.0, frozenset({track}))] for track in sorted(common, key=lambda t: t.seen)]
    return groups + ([rest] if any(tracks for _, tracks in rest) else [])
