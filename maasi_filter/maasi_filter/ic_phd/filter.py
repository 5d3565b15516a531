"""Particle PHD filter with an iterated corrector (000, sections 3.2, 3.3)."""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from operator import itemgetter
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.found_targets import SAME_TARGET, Change, distance
from maasi_filter.geometry.area import Area
from maasi_filter.ic_phd.births import (
    gaussian_births,
    jittered,
    measurement_births,
    noise_in_space,
    resample,
    uniform_births,
)
from maasi_filter.ic_phd.clusters import clusters_of, kmeans
from maasi_filter.ic_phd.corrector import phd_correct, phd_scan
from maasi_filter.measurement_check import (
    FOUND,
    CheckedMeasurement,
    check_measurements,
    count_dropped,
    count_unexplained,
    within_range,
)
from maasi_filter.models.sensor import LEAST_PER_SCAN
from maasi_filter.records import UNLABELLED, AgentMeasurement, FilterResult, FoundTarget, Label
from maasi_filter.reports import Report, seen_by_others
from maasi_filter.search_filter import SearchFilter
from maasi_filter.settings import FilterSettings

PARALLEL_PARTICLES = 65_536  # particle sets below this size are faster on one thread
LEAST_BIRTHS = 20  # fewest particles of a birth, when many detections share the particle budget


class IcPhdFilter(SearchFilter):
    """Particle PHD filter with an iterated corrector, K-means and removal of found targets."""

    particles: FloatArray = np.empty((0, 0))
    weights: FloatArray = np.empty(0)
    saved: ClassVar[dict[str, Any]] = {
        **SearchFilter.saved,
        'particles': FloatArray,
        'weights': FloatArray,
        '_centres': FloatArray,
    }

    def __init__(
        self, settings: FilterSettings, area: Area | ArrayLike, generator: np.random.Generator
    ) -> None:
        super().__init__(settings, area, generator)
        if self.area.terrain is not None:
            raise ValueError(
                "filter.method: read 'ic_phd' with environment.terrain, allowed with it is 'pmb': "
                'this one would take hidden targets for missed ones'
            )
        self._numbers: Any = settings.resolved()
        self.particles = np.empty((0, self.dimension))
        self.weights = np.empty(0)
        self._centres: FloatArray = np.empty((0, self.dimension))
        self._pool: ThreadPoolExecutor | None = None

    @property
    def expected_number(self) -> float:
        """Mass of the particles."""
        return float(self.weights.sum())

    def step(
        self, measurements: Sequence[AgentMeasurement], steps: int, time: float
    ) -> FilterResult:
        """Predict, correct with one robot after another, extract clusters, mark found targets."""
        dropped: dict[str, int] = {}
        members = check_measurements(measurements, steps, time, self._numbers, self.dimension)
        members = [self._without_found(member, dropped) for member in members]
        # Prediction, 000 (12): targets stand still and survive with p_s.
        self.weights = self.weights * self._numbers.survival_probability**steps
        if self._numbers.births != 'measurement':
            self._append(*self._born_anywhere(members))
        for index, member in enumerate(members):
            self._correct(member, members[:index], dropped)
        if any(len(member.values) for member in members):
            self._resample()
        newly_found = self._extract(members, time)
        return FilterResult(
            list(self.clusters), newly_found, bool(newly_found), self.expected_number, dropped
        )

    def _correct(
        self,
        member: CheckedMeasurement,
        before: Sequence[CheckedMeasurement],
        dropped: dict[str, int],
    ) -> None:
        """Correct with the detections of one robot (000, (13), (16)); births are in D^{o-1}."""
        births, intensity = self._births(member, before)
        sensor = member.sensor
        per_scan = max(sensor.clutter * sensor.clutter_space(self.bounds), LEAST_PER_SCAN)
        clutter = sensor.clutter_at(member.values, per_scan, self.bounds)
        scan = phd_scan(member.values, member.sensor, member.pose)
        factor, normaliser = phd_correct(
            self.particles, self.weights, scan, clutter + intensity.sum(axis=1), self._threads()
        )
        self.weights = self.weights * factor
        self._append(births, (intensity / normaliser[:, None]).ravel())
        self.exploration.update(member.sensor.detection, member.pose)
        unexplained = member.values[normaliser <= clutter]
        if len(unexplained):
            centres = member.sensor.measurement.inverse(unexplained, member.pose)
            count_unexplained(centres, self.bounds, dropped)

    def _births(
        self, member: CheckedMeasurement, before: Sequence[CheckedMeasurement]
    ) -> tuple[FloatArray, FloatArray]:
        """Return births at the detections of a robot, if they are of that kind, and b (m, J)."""
        numbers = self._numbers
        count = len(member.values)
        if numbers.births != 'measurement' or not count:
            return np.empty((0, self.dimension)), np.zeros((count, 0))
        share = numbers.particles // (2 * count)
        number = max(LEAST_BIRTHS, min(numbers.birth_particles, share))
        return measurement_births(member, before, self.area, number, self.generator)

    def _born_anywhere(
        self, members: Sequence[CheckedMeasurement]
    ) -> tuple[FloatArray, FloatArray]:
        """Return births independent of single measurements: uniform (001) or Gaussian (003)."""
        numbers = self._numbers
        expected, number = numbers.birth_targets, numbers.birth_particles
        if numbers.births == 'uniform' and members:
            return uniform_births(self.area, expected, number, self.generator)
        seen = [member for member in members if len(member.values)]
        if numbers.births == 'uniform' or not seen:
            return np.empty((0, self.dimension)), np.empty(0)
        centres = np.concatenate([m.sensor.measurement.inverse(m.values, m.pose) for m in seen])
        spreads = [noise_in_space(m) for m in seen]
        spread = np.average(spreads, axis=0, weights=[len(m.values) for m in seen])
        return gaussian_births(centres, spread, self.area, expected, number, self.generator)

    def _append(self, particles: FloatArray, weights: FloatArray) -> None:
        self.particles = np.concatenate([self.particles, particles])
        self.weights = np.concatenate([self.weights, weights])

    def _resample(self) -> None:
        numbers = self._numbers
        expected = self.expected_number
        if not expected > 1e-12:
            self.particles, self.weights = np.empty((0, self.dimension)), np.empty(0)
            return
        wanted = math.ceil(numbers.particles_per_target * expected)
        number = min(max(wanted, numbers.particles_minimum, 1), numbers.particles)
        index = resample(self.weights, number, self.generator)
        self.particles = jittered(
            self.particles, index, numbers.jitter_deviation, self.bounds, self.generator
        )
        self.weights = np.full(number, expected / number)

    def _extract(self, members: Sequence[CheckedMeasurement], time: float) -> list[FoundTarget]:
        """Find clusters by K-means; narrow and heavy ones are found targets (000, section 3.3)."""
        numbers = self._numbers
        if not members or not self.expected_number > 0.0:
            self.clusters = self.clusters if len(self.weights) else []
            return []
        label, centres = kmeans(
            self.particles,
            self.weights,
            max(1, round(self.expected_number)),
            self.generator,
            self._centres,
            numbers.kmeans_iterations,
        )
        clusters = clusters_of(self.particles, self.weights, label, centres)
        narrow = {
            g
            for g, cluster in clusters.items()
            if cluster.radius <= numbers.found_radius and cluster.mass >= numbers.found_mass
        }
        newly_found = []
        for g in sorted(narrow):
            position, covariance = clusters[g].position, clusters[g].covariance
            covariance = covariance + numbers.jitter_deviation**2 * np.eye(self.dimension)
            settled = (*self.found_targets, *self.rejected)
            known = [distance(position, covariance, target) for target in settled]
            if min(known, default=math.inf) < SAME_TARGET:
                continue
            credit, label_of = nearest_detection(position, members, numbers.removal_distance)
            number, robot, index = self._found.next_id(), credit.robot, credit.index
            target = FoundTarget(number, position, covariance, robot, index, time, label=label_of)
            self._found.targets.append(target)
            newly_found.append(target)
        if narrow:
            alive = ~np.isin(label, list(narrow))
            self.particles, self.weights = self.particles[alive], self.weights[alive]
        remaining = [g for g in clusters if g not in narrow]
        self._centres = centres[remaining]
        self.clusters = sorted((clusters[g] for g in remaining), key=lambda item: -item.mass)
        return newly_found

    def _without_found(
        self, member: CheckedMeasurement, dropped: dict[str, int]
    ) -> CheckedMeasurement:
        member = within_range(member, dropped)
        settled = (*self.found_targets, *self.rejected)
        if not settled:
            return member
        centres = member.sensor.measurement.inverse(member.values, member.pose)
        keep = kept_measurements(
            centres,
            settled,
            self._numbers.removal_distance,
            self._numbers.removal == 'every',
        )
        count_dropped(dropped, FOUND, int((~keep).sum()))
        return member.only(keep)

    def _threads(self) -> ThreadPoolExecutor | None:
        threads = self.settings.threads or os.cpu_count() or 1
        if len(self.weights) < PARALLEL_PARTICLES or threads < 2:
            return None
        if self._pool is None:
            self._pool = ThreadPoolExecutor(threads)
        return self._pool

    def thin(self, report: Report) -> None:
        """Multiply the PHD by 1 - p in the zone: a measurement of others without detections."""
        super().thin(report)
        seen = seen_by_others(report.shape, report.weight, self.particles)
        self.weights = self.weights * (1.0 - seen)

    def adopt(self, change: Change) -> None:
        """Remove the particles within T_z of new found targets."""
        super().adopt(change)
        for target in change.changed:
            offset = self.particles - target.position
            keep = (offset * offset).sum(axis=1) > self._numbers.removal_distance**2
            self.particles, self.weights = self.particles[keep], self.weights[keep]


def nearest_detection(
    position: FloatArray, members: Sequence[CheckedMeasurement], limit: float
) -> tuple[CheckedMeasurement, Label]:
    """Return the robot with the nearest detection, otherwise the last, and the label within T_z."""
    apart, labelled = [(math.inf, members[-1])], [(limit, UNLABELLED)]
    for member in members:
        centres = member.sensor.measurement.inverse(member.values, member.pose)
        distances = np.sqrt(np.square(centres - position).sum(axis=1)).tolist()
        apart += [(distance, member) for distance in distances]
        labelled += zip(distances, member.labels)
    return min(apart, key=itemgetter(0))[1], min(labelled, key=itemgetter(0))[1]


def kept_measurements(
    centres: FloatArray, targets: Sequence[FoundTarget], limit: float, every: bool
) -> BoolArray:
    """Return which of m detections remain without all, or the closest, within T_z of targets."""
    keep = np.ones(len(centres), np.bool_)
    for target in targets:
        apart = np.sqrt(((centres - target.position) ** 2).sum(axis=1))
        near = keep & (apart <= limit)
        if every:
            keep &= ~near
        elif near.any():
            keep[int(np.argmin(np.where(near, apart, np.inf)))] = False
    return keep
