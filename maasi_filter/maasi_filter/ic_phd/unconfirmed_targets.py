"""Targets that were detected once, lost from the intensity, and not found: potential ones, too.

A PHD takes each miss for a sign that nothing is there: the mass of a target that was detected falls
by 1 - pi again and again, although its detection proves that it exists. What is known without
doubt are the detections. One that no found target explains was caused by a target that is still to
be found, first seen then: it has the intensity (N0 / V) e(x) pi N(z; g(x), R), with e the share
that the measurements without such a detection have left unseen at x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numba import njit
from numpy.typing import NDArray

from maasi_filter.exploration import Exploration
from maasi_filter.ic_phd.births import LEAST_UNEXPLORED, _draw
from maasi_filter.ic_phd.clusters import Cluster, group_clusters
from maasi_filter.ic_phd.found_targets import (
    LARGEST_INNOVATION,
    LEAST_MISS,
    LEAST_PROBABILITY,
    exclusive,
    found_intensity,
)
from maasi_filter.ic_phd.phd import MeasurementSet
from maasi_filter.models.detection import DetectionModel
from maasi_filter.models.measurement import TWO_PI, wrap
from maasi_filter.models.pose import Pose
from maasi_filter.vector_math import arctan2

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
# Scans that may come in before all are looked through for what is explained by now.
MOST_WAITING = 256
# Detections that are looked at together; the time for it grows with the square.
MOST_DETECTIONS = 256
# Nodes of the quadrature over the noise: of range and of each angle.
RANGE_NODES = 3
ANGLE_NODES = 5


@dataclass
class _Scan:
    """Detections of a robot at a step; pi (m,) where they point at."""

    measurements: MeasurementSet
    position: FloatArray
    probability: FloatArray
    clutter: float


@njit(cache=True, error_model='numpy')
def _as_seen(points, sensor_position, distance, bearing, elevation):  # type: ignore[no-untyped-def]
    """Fill range and angles of places (n, d) from a robot."""
    solid = points.shape[1] == 3
    for i in range(points.shape[0]):
        x = points[i, 0] - sensor_position[0]
        y = points[i, 1] - sensor_position[1]
        z = points[i, 2] - sensor_position[2] if solid else 0.0
        level = math.sqrt(x * x + y * y)
        distance[i] = math.sqrt(level * level + z * z)
        bearing[i] = arctan2(y, x)
        elevation[i] = arctan2(z, level)


@njit(cache=True, error_model='numpy')
def _fill_hits(  # type: ignore[no-untyped-def]
    points, starts, sensor_positions, values, cartesian, centres, information, reaches, near, hits
):
    """Fill which places (m, n, d) of detections other detections (m,) may come from, too.

    `near` (m, m) tells where there may be any, `hits` (m, m, n) which; arbitrary where there are
    none. Scans begin at `starts`.
    """
    number, nodes, d = points.shape
    distance = np.empty(nodes)
    bearing = np.empty(nodes)
    elevation = np.empty(nodes)
    middle = np.zeros(3)
    z = np.zeros(3)
    apart = np.zeros(3)
    inverse = np.zeros((3, 3))
    for m in range(number):
        radius = 0.0
        for a in range(d):
            middle[a] = points[m, :, a].mean()
        for i in range(nodes):
            square = 0.0
            for a in range(d):
                square += (points[m, i, a] - middle[a]) ** 2
            radius = max(radius, math.sqrt(square))
        for scan in range(starts.shape[0] - 1):
            sensor = sensor_positions[scan]
            square = 0.0
            for a in range(d):
                square += (middle[a] - sensor[a]) ** 2
            away = math.sqrt(square)
            looked = False
            for other in range(starts[scan], starts[scan + 1]):
                # An error of the range alone may be too much, whatever the angles.
                near[m, other] = abs(away - values[other, 0]) <= reaches[other] + radius
                if not near[m, other]:
                    continue
                inverse[:d, :d] = information[other]
                row = hits[m, other]
                if cartesian[other]:
                    for i in range(nodes):
                        for a in range(d):
                            apart[a] = points[m, i, a] - centres[other, a]
                        square = 0.0
                        for a in range(d):
                            for b in range(d):
                                square += apart[a] * inverse[a, b] * apart[b]
                        row[i] = square < LARGEST_INNOVATION
                    continue
                if not looked:
                    _as_seen(points[m], sensor, distance, bearing, elevation)
                    looked = True
                z[:d] = values[other]
                z[1] = wrap(z[1])
                for i in range(nodes):
                    e0 = z[0] - distance[i]
                    e1 = z[1] - bearing[i]
                    e1 = e1 - TWO_PI if e1 >= math.pi else e1
                    e1 = e1 + TWO_PI if e1 < -math.pi else e1
                    e2 = z[2] - elevation[i]
                    square = e0 * e0 * inverse[0, 0] + e1 * e1 * inverse[1, 1]
                    square += 2.0 * e0 * e1 * inverse[0, 1] + e2 * e2 * inverse[2, 2]
                    square += 2.0 * e2 * (e0 * inverse[0, 2] + e1 * inverse[1, 2])
                    row[i] = square < LARGEST_INNOVATION


@njit(cache=True, error_model='numpy')
def _weigh(  # type: ignore[no-untyped-def]
    kept,
    points,
    factors,
    unseen_now,
    near,
    hits,
    scan,
    miss,
    explained,
    least_unexplored,
    mass,
    means,
    covariances,
):
    """Fill mass, mean and covariance of the target of each detection that is kept.

    What the scans of the kept ones left unseen is undone where one of their detections may come
    from.
    """
    nodes, d = points.shape[1:]
    born = np.empty(nodes)
    done = np.empty(nodes, np.int64)
    for m in kept:
        born[:] = unseen_now[m]
        done[:] = -1
        for other in kept:
            if not near[m, other]:
                continue
            here = scan[other]
            more = 1.0 / miss[other]
            row = hits[m, other]
            for i in range(nodes):
                again = row[i] and done[i] != here
                born[i] *= more if again else 1.0
                done[i] = here if again else done[i]
        total = 0.0
        # A detection may be false, too, as births have it.
        false = 0.0
        for i in range(nodes):
            born[i] = factors[m, i] * min(born[i], 1.0)
            total += born[i]
            false += factors[m, i] * least_unexplored
        mass[m] = 0.0
        if total <= 0.0:
            continue
        mass[m] = total / (total + explained[m] + false)
        for a in range(d):
            means[m, a] = 0.0
            for i in range(nodes):
                means[m, a] += born[i] / total * points[m, i, a]
        for a in range(d):
            for b in range(a + 1):
                value = 0.0
                for i in range(nodes):
                    value += (
                        born[i]
                        / total
                        * (points[m, i, a] - means[m, a])
                        * (points[m, i, b] - means[m, b])
                    )
                covariances[m, a, b] = value
                covariances[m, b, a] = value


def _quadrature(dimension: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes (n, d) and weights (n,) of the standard normal distribution."""
    rules = [
        np.polynomial.hermite_e.hermegauss(number)
        for number in (RANGE_NODES, *[ANGLE_NODES] * (dimension - 1))
    ]
    nodes = np.stack(np.meshgrid(*[rule[0] for rule in rules], indexing='ij'), axis=-1)
    weights = np.ones(())
    for rule in rules:
        weights = np.multiply.outer(weights, rule[1] / math.sqrt(2.0 * math.pi))
    return nodes.reshape(-1, dimension), weights.ravel()


class LostTargets:
    """Detections that no found target explains yet, and where their targets may be.

    Where more than 256 of them wait, the oldest are forgotten.

    Parameters
    ----------
    dimension : int
        2 or 3.
    intensity : float
        N0 / V, of targets before the search, 1 / m^d.
    least_mass : float
        Detections that are more probably explained than 1 minus this are forgotten.
    """

    def __init__(self, dimension: int, intensity: float, least_mass: float) -> None:
        self.dimension = dimension
        self.intensity = intensity
        self.least_mass = least_mass
        self._scans: list[_Scan] = []
        self._new: list[tuple[MeasurementSet, Pose, DetectionModel, float]] = []
        self._room = MOST_WAITING
        self._nodes, self._weights = _quadrature(dimension)

    def __len__(self) -> int:
        return len(self._scans) + len(self._new)

    def add(
        self,
        measurements: MeasurementSet,
        used: NDArray[np.bool_],
        pose: Pose,
        detection: DetectionModel,
        clutter: float,
    ) -> None:
        """Take in the detections of a robot.

        Parameters
        ----------
        used : (m,) array of bool
            Which of them may come from a target at all; at least one.
        clutter : float
            Intensity of false ones.
        """
        if not used.all():
            measurements = _chosen(measurements, used)
        # Most steps never ask for them, so pi is not worked out before.
        self._new.append((measurements, pose, detection, clutter))

    def _take_new(self) -> None:
        for measurements, pose, detection, clutter in self._new:
            probability = np.maximum(
                detection.probability(measurements.centres, pose), LEAST_PROBABILITY
            )
            self._scans.append(_Scan(measurements, pose.position, probability, clutter))
        self._new.clear()

    @property
    def crowded(self) -> bool:
        """Whether so many detections wait that those explained by now are to be forgotten."""
        return len(self) > self._room

    def clusters(
        self,
        positions: FloatArray,
        covariances: FloatArray,
        exploration: Exploration,
        least_distance: float,
    ) -> list[Cluster]:
        """Return where targets are that were detected and are none of the found ones.

        Parameters
        ----------
        positions, covariances : (f, d), (f, d, d) arrays
            Of the found targets, metres.
        exploration : Exploration
            e now.
        least_distance : float
            Nearer ones are one, metres.
        """
        self._take_new()
        shares = []
        for scan in self._scans:
            kappa = found_intensity(
                positions,
                covariances,
                np.zeros(len(positions)),
                scan.probability,
                scan.measurements,
                Pose(scan.position),
            )
            # Were nothing explored, and nothing missed.
            most = self.intensity * scan.probability * scan.measurements.volume
            kappa = exclusive(kappa, most + scan.clutter)
            shares.append(kappa.sum(axis=0) + scan.clutter)
        self._keep(
            [
                self.intensity * scan.probability * scan.measurements.volume
                > self.least_mass * share
                for scan, share in zip(self._scans, shares)
            ],
            shares,
        )
        self._forget_oldest(shares)
        if not self._scans:
            return []
        kept, mass, means, spreads = self._look(np.concatenate(shares), exploration)
        keep = np.zeros(len(mass), np.bool_)
        keep[kept] = True
        ends = np.cumsum([len(scan.measurements) for scan in self._scans])[:-1]
        self._keep(np.split(keep, ends), shares)
        # Several detections may be of the same target.
        groups = group_clusters(
            mass[kept], means[kept], spreads[kept], self.least_mass, least_distance
        )
        return [
            Cluster(item.position, item.covariance, item.radius, min(item.mass, 1.0))
            for item in groups
        ]

    def _keep(self, keep: list[NDArray[np.bool_]], shares: list[FloatArray]) -> None:
        """Forget detections, in `shares`, too."""
        kept = [index for index, mask in enumerate(keep) if mask.any()]
        scans = []
        for index in kept:
            scan, mask = self._scans[index], keep[index]
            if not mask.all():
                scan = _Scan(
                    _chosen(scan.measurements, mask),
                    scan.position,
                    scan.probability[mask],
                    scan.clutter,
                )
                shares[index] = shares[index][mask]
            scans.append(scan)
        self._scans = scans
        shares[:] = [shares[index] for index in kept]
        self._room = len(scans) + MOST_WAITING

    def _forget_oldest(self, shares: list[FloatArray]) -> None:
        """Forget the oldest detections where there are more than can be looked at."""
        counts = [len(scan.measurements) for scan in self._scans]
        keep = np.arange(sum(counts)) >= sum(counts) - MOST_DETECTIONS
        if not keep.all():
            self._keep(np.split(keep, np.cumsum(counts)[:-1]), shares)

    def _look(
        self, explained: FloatArray, exploration: Exploration
    ) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """Return which detections still may be of lost targets, and mass, mean and covariance."""
        sets = [scan.measurements for scan in self._scans]
        joined = _joined(sets)
        counts = [len(item) for item in sets]
        scan = np.repeat(np.arange(len(sets)), counts)
        probability = np.concatenate([item.probability for item in self._scans])
        d = self.dimension
        number = len(joined)
        nodes = len(self._nodes)
        places = [self._places(item, exploration.bounds) for item in self._scans]
        points = np.concatenate([points for points, _ in places])
        sizes = np.concatenate([size for _, size in places])
        reaches = np.sqrt(LARGEST_INNOVATION * joined.covariances[:, 0, 0])
        near = np.empty((number, number), np.bool_)
        hits = np.empty((number, number, nodes), np.bool_)
        _fill_hits(
            points,
            np.concatenate([[0], np.cumsum(counts)]),
            np.stack([item.position for item in self._scans]),
            joined.values,
            joined.cartesian,
            joined.centres,
            joined.information,
            np.where(joined.cartesian, np.inf, reaches),
            near,
            hits,
        )
        factors = self.intensity * probability[:, None] * self._weights * sizes
        unseen = exploration.at(points.reshape(-1, d)).reshape(number, nodes)
        miss = np.maximum(1.0 - probability, LEAST_MISS)
        mass = np.empty(number)
        means = np.empty((number, d))
        covariances = np.empty((number, d, d))
        kept = np.arange(number)
        while True:
            _weigh(
                kept,
                points,
                factors,
                unseen,
                near,
                hits,
                scan,
                miss,
                explained,
                LEAST_UNEXPLORED,
                mass,
                means,
                covariances,
            )
            keep = mass[kept] >= self.least_mass
            if keep.all():
                return kept, mass, means, covariances
            kept = kept[keep]

    def _places(self, scan: _Scan, bounds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return places (m, n, d) that detections may come from, and |dx/dz|, 0 out of bounds."""
        number, nodes = len(scan.measurements), len(self._nodes)
        points = np.empty((number * nodes, self.dimension))
        size = np.empty(number * nodes)
        _draw(
            scan.measurements.values,
            scan.measurements.cartesian,
            scan.measurements.centres,
            scan.measurements.roots,
            scan.measurements.volume,
            scan.position,
            bounds,
            np.tile(self._nodes, (number, 1)),
            nodes * np.arange(number + 1),
            points,
            size,
            np.empty(number, np.bool_),
        )
        return points.reshape(number, nodes, -1), size.reshape(number, nodes)

    # The state as arrays.

    def arrays(self) -> dict[str, NDArray]:
        """Return the state, for a file."""
        self._take_new()
        d = self.dimension
        sets = [scan.measurements for scan in self._scans]
        joined = _joined(sets) if sets else _nothing(d)
        return {
            **{f'lost_{item.name}': getattr(joined, item.name) for item in fields(joined)},
            'lost_scans': np.array([len(item) for item in sets], np.int64),
            'lost_positions': np.array([scan.position for scan in self._scans]).reshape(-1, 3),
            'lost_probability': np.concatenate(
                [np.zeros(0), *[scan.probability for scan in self._scans]]
            ),
            'lost_clutter': np.array([scan.clutter for scan in self._scans], float),
            'lost_room': np.array(self._room),
        }

    def restore(self, state: dict[str, NDArray]) -> None:
        """Take the state of `arrays`."""
        names = [item.name for item in fields(MeasurementSet)]
        joined = MeasurementSet(**{name: state[f'lost_{name}'] for name in names})
        ends = np.cumsum(state['lost_scans'])
        self._room = int(state['lost_room'])
        self._scans = []
        self._new.clear()
        for index, (count, end) in enumerate(zip(state['lost_scans'], ends)):
            part = slice(int(end - count), int(end))
            self._scans.append(
                _Scan(
                    _chosen(joined, part),
                    state['lost_positions'][index],
                    state['lost_probability'][part],
                    float(state['lost_clutter'][index]),
                )
            )


def _chosen(measurements: MeasurementSet, mask: NDArray[np.bool_] | slice) -> MeasurementSet:
    """Return some of the measurements."""
    return MeasurementSet(
        **{item.name: getattr(measurements, item.name)[mask] for item in fields(measurements)}
    )


def _joined(sets: list[MeasurementSet]) -> MeasurementSet:
    """Return all measurements as one set."""
    return MeasurementSet(
        **{
            item.name: np.concatenate([getattr(one, item.name) for one in sets])
            for item in fields(MeasurementSet)
        }
    )


def _nothing(d: int) -> MeasurementSet:
    """Return a set without measurements."""
    matrix = np.empty((0, d, d))
    return MeasurementSet(
        np.empty((0, d)),
        matrix,
        np.empty(0, np.bool_),
        np.empty((0, d)),
        matrix,
        matrix,
        np.empty(0),
        np.empty(0),
        np.empty((0, 2)),
    )
