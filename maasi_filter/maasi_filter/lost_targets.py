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

from maasi_filter.births import LEAST_UNEXPLORED, _draw
from maasi_filter.clusters import Cluster, group_clusters
from maasi_filter.detection_model import DetectionModel
from maasi_filter.exploration import Exploration
from maasi_filter.found_targets import (
    LARGEST_INNOVATION,
    LEAST_MISS,
    LEAST_PROBABILITY,
    _predict,
    exclusive,
    found_intensity,
)
from maasi_filter.phd import MeasurementSet
from maasi_filter.pose import Pose

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
# Scans that may wait before they are looked through for what is explained by now.
MOST_WAITING = 256
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
def _see_again(  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    points, unseen, scan, sensor_positions, values, cartesian, centres, information, miss
):
    """Undo, in place, what scans left of `unseen` where one of their detections may come from."""
    d = points.shape[1]
    error = np.empty(d)
    jacobian = np.empty((d, d))
    for i in range(points.shape[0]):
        done = -1
        for m in range(values.shape[0]):
            if scan[m] == done:
                continue
            _predict(
                points[i],
                sensor_positions[m],
                values[m],
                cartesian[m],
                centres[m],
                error,
                jacobian,
            )
            square = 0.0
            for a in range(d):
                for b in range(d):
                    square += error[a] * information[m, a, b] * error[b]
            if square < LARGEST_INNOVATION:
                unseen[i] /= miss[m]
                done = scan[m]
        unseen[i] = min(unseen[i], 1.0)


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
        self._room = MOST_WAITING
        self._nodes, self._weights = _quadrature(dimension)

    def __len__(self) -> int:
        return len(self._scans)

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
        probability = np.maximum(
            detection.probability(measurements.centres, pose), LEAST_PROBABILITY
        )
        self._scans.append(_Scan(measurements, pose.position.copy(), probability, clutter))

    @property
    def crowded(self) -> bool:
        """Whether so many detections wait that those explained by now are to be forgotten."""
        return len(self._scans) > self._room

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
        while self._scans:
            mass, means, spreads = self._look(shares, exploration)
            keep = mass >= self.least_mass
            if keep.all():
                # Several detections may be of the same target.
                groups = group_clusters(mass, means, spreads, self.least_mass, least_distance)
                return [
                    Cluster(item.position, item.covariance, item.radius, min(item.mass, 1.0))
                    for item in groups
                ]
            ends = np.cumsum([len(scan.measurements) for scan in self._scans])[:-1]
            self._keep(np.split(keep, ends), shares)
        return []

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
        self._room = 2 * len(scans) + MOST_WAITING

    def _look(
        self, shares: list[FloatArray], exploration: Exploration
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return mass, mean and covariance of the target of each detection that is left."""
        sets = [scan.measurements for scan in self._scans]
        joined = _joined(sets)
        counts = [len(item) for item in sets]
        scan = np.repeat(np.arange(len(sets)), counts)
        sensors = np.repeat(np.stack([item.position for item in self._scans]), counts, axis=0)
        probability = np.concatenate([item.probability for item in self._scans])
        miss = np.maximum(1.0 - probability, LEAST_MISS)
        explained = np.concatenate(shares)
        d = self.dimension
        number = len(joined)
        mass = np.zeros(number)
        means = np.zeros((number, d))
        covariances = np.zeros((number, d, d))
        for m in range(number):
            one = np.zeros(number, np.bool_)
            one[m] = True
            points, size = self._points(_chosen(joined, one), sensors[m], exploration.bounds)
            unseen = exploration.at(points)
            _see_again(
                points,
                unseen,
                scan,
                sensors,
                joined.values,
                joined.cartesian,
                joined.centres,
                joined.information,
                miss,
            )
            factor = self.intensity * probability[m] * self._weights * size
            born = factor * unseen
            total = float(born.sum())
            if total <= 0.0:
                continue
            # A detection may be false, too, as births have it.
            false = LEAST_UNEXPLORED * float(factor.sum())
            mass[m] = total / (total + float(explained[m]) + false)
            means[m] = born @ points / total
            offset = points - means[m]
            covariances[m] = (born[:, None] * offset).T @ offset / total
        return mass, means, covariances

    def _points(
        self, measurement: MeasurementSet, sensor: FloatArray, bounds: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return places (n, d) that a detection may come from, and |dx/dz|, 0 out of bounds."""
        number = len(self._nodes)
        points = np.empty((number, self.dimension))
        size = np.empty(number)
        _draw(
            measurement.values,
            measurement.cartesian,
            measurement.centres,
            measurement.roots,
            measurement.volume,
            sensor,
            bounds,
            self._nodes,
            np.array([0, number]),
            points,
            size,
            np.empty(1, np.bool_),
        )
        return points, size

    # The state as arrays.

    def arrays(self) -> dict[str, NDArray]:
        """Return the state, for a file."""
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
