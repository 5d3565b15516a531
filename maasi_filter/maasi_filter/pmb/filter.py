"""Poisson multi-Bernoulli filter (Williams 2015, TOMB/P); equations in `docs/filter.md`."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.found_targets import Change, FoundTargets, nearest
from maasi_filter.geometry.area import Area
from maasi_filter.measurement_check import (
    CheckedMeasurement,
    check_measurements,
    count_unexplained,
    pose_error_of,
    within_range,
    without_repeats,
)
from maasi_filter.pmb.association import associate
from maasi_filter.pmb.component import (
    LEAST_HITS,
    PRIOR,
    Component,
    is_known,
    merge,
    rate_of_targets,
    reflects,
    views,
)
from maasi_filter.pmb.density import Density
from maasi_filter.pmb.labels import LabelTally, associate_by_identity, learn_labels
from maasi_filter.pmb.learnt import Learnt
from maasi_filter.pmb.offsets import Offsets
from maasi_filter.pmb.scan import Scan, make_scan
from maasi_filter.records import AgentMeasurement, Cluster, FilterResult, FoundTarget
from maasi_filter.reports import WITHDRAWN, Report, seen_by_others
from maasi_filter.search_filter import SearchFilter
from maasi_filter.settings import FilterSettings

LEAST_EXISTENCE = 1e-4
MOST_POTENTIAL = 1000  # most components that are not found
LEAST_CLUSTER_MASS = 0.1  # least existence probability of a cluster that is published
FOUND_RADIUS_DEVIATIONS = 2.0  # default of T_r, in standard deviations of the range
# Probability of being a reflection below which a target can be found, and above which a found one
# is withdrawn.
MOST_REFLECTING = 0.3
SURELY_REFLECTING = 0.5
# What exists with more than this probability, and was detected so often, remains a potential target
# with its whole mass, so that a robot looks again; unless it surely is a reflection.
SURE, SURE_HITS, CERTAINLY_REFLECTING = 0.99, 2.0, 0.95
CERTAIN = 0.999  # existence probability of targets that other filters found


class PmbFilter(SearchFilter):
    """Poisson multi-Bernoulli filter; `components` are potential targets, found ones included."""

    saved: ClassVar[dict[str, Any]] = {
        'components': list[Component],
        '_learnt': dict[str, Learnt],
        '_offsets': Offsets,
        '_scans': int,
        '_last_id': int,
        '_last_time': float | None,
    }

    def __init__(
        self, settings: FilterSettings, area: Area | ArrayLike, generator: np.random.Generator
    ) -> None:
        super().__init__(settings, area, generator)
        self._numbers = settings.resolved()
        self.components: list[Component] = []
        self._learnt: dict[str, Learnt] = {}
        self._offsets = Offsets(self._numbers.pmb.offset, self.dimension)
        self._rates: FloatArray = PRIOR
        self._scans = 0
        self._last_id = 0
        self._last_time: float | None = None
        self._frame = np.zeros((3, 3))
        self._frame[0, : self.dimension] = self.bounds[:, 0]
        self._frame[1, : self.dimension] = self.bounds[:, 1]
        self._frame[2] = self.exploration.kernel()[2]

    @property
    def found_targets(self) -> list[FoundTarget]:
        """Targets found so far, in the order of being found."""
        found = [item.target for item in self.components if item.target is not None]
        return sorted(found, key=lambda target: target.id)

    @property
    def potential(self) -> list[Component]:
        """Components that are not found."""
        return [item for item in self.components if item.target is None]

    @property
    def rejected(self) -> list[FoundTarget]:
        """Found targets that persons rejected, and that can be confirmed again."""
        targets = [item.rejected for item in self.components if item.rejected is not None]
        return sorted(targets, key=lambda target: target.id)

    @property
    def _open(self) -> list[Component]:
        """Components that are neither found nor rejected."""
        return [item for item in self.components if not item.settled]

    @property
    def expected_number(self) -> float:
        """Expected number of detected but not found targets: the sum of their r."""
        return math.fsum(item.belief for item in self.potential)

    @property
    def particles(self) -> FloatArray:
        """Particles of the components that are not found, (n, d), metres."""
        parts = [item.density.particles for item in self.potential]
        return np.concatenate([np.empty((0, self.dimension)), *parts])

    @property
    def weights(self) -> FloatArray:
        """Their weights, (n,); they sum to the expected number."""
        parts = [item.belief * item.density.weights for item in self.potential]
        return np.concatenate([np.empty(0), *parts])

    def step(
        self, measurements: Sequence[AgentMeasurement], steps: int, time: float
    ) -> FilterResult:
        """Predict, correct with every robot of M_k, merge and mark."""
        members = check_measurements(measurements, steps, time, self._numbers, self.dimension)
        result = FilterResult()
        before = self.found_targets
        self._predict(time)
        for member in members:
            self._correct(member, time, result)
        self._estimate_changed()
        merged = merge(self._most_probable(result))
        self.components = [item for item in self.components if item.settled] + merged
        self.clusters = self._clusters_of(merged)
        result.clusters = list(self.clusters)
        # A target that has changed is another record.
        changed = [*map(id, before)] != [*map(id, self.found_targets)]
        result.found_changed = bool(result.newly_found) or changed
        result.expected_number = self.expected_number
        misfits = {robot: learnt.misfit(robot) for robot, learnt in sorted(self._learnt.items())}
        result.misfits |= {robot: text for robot, text in misfits.items() if text}
        return result

    def _correct(self, member: CheckedMeasurement, time: float, result: FilterResult) -> None:
        """Correct with one robot's scan (docs/filter.md, Williams 2015, TOMB/P)."""
        member = without_repeats(within_range(member, result.dropped), result.dropped)
        components, learnt = self.components, self._learnt.setdefault(member.robot, Learnt())
        # kappa: clutter per unit of measurement space at each detection; N0 / V.
        sensor = member.sensor
        expected = sensor.clutter * sensor.clutter_space(self.bounds)
        told = max(expected, self._numbers.pmb.clutter_floor)
        kappa = sensor.clutter_at(member.values, learnt.clutter_per_scan(told), self.bounds)
        unseen = self.area.expected_targets / self.area.volume
        # Errors of the robot's position, those that last and those that the scan tells.
        member = self._offsets.localise(member, components, kappa, unseen)
        error = learnt.learn_error(member, components, kappa, unseen)
        blurred = replace(member, pose_error=math.hypot(member.pose_error, error))
        # lambda_j = (N0 / V) int e pi g_j dx, by importance sampling from the detections.
        scan = make_scan(
            blurred, learnt.noise_factor(), self.exploration, self._numbers, self.generator
        )
        self._scans += 1
        seen = views(components, scan)  # p_D = int f pi dx, L_j = int f pi g_j dx
        # Association: odds r L_j / (1 - r p_D) against kappa + lambda_j.
        odds = np.zeros((len(seen), len(scan.terms)))
        for i, (item, view) in enumerate(zip(components, seen)):
            r = item.existence
            odds[i, view.gated] = r * view.likelihood / (1.0 - r * view.detected)
        other = kappa + scan.intensity
        tallies = [item.labels for item in components]
        named = associate_by_identity(member.labels, tallies, odds, other)
        missed, caused, new = associate(odds, other)
        learn_labels(member.labels, tallies, caused)
        learnt.count_found(member, components, caused, error > 0.0)
        alone = (scan.intensity <= 0.0) & ~(odds > 0.0).any(axis=0)
        count_unexplained(scan.centres[alone], self.bounds, result.dropped)
        # r = a_0 + sum a_j, f = (a_0 (1 - pi) / (1 - p_D) + sum a_j pi g_j / L_j) f / r.
        radius = self._found_radius(blurred)
        totals = caused.sum(axis=1)
        surely = (totals > 0.5).tolist()
        found = [i for i, item in enumerate(components) if item.settled]
        for i, (item, view) in enumerate(zip(components, seen)):
            moved = item.update(view, missed[i], caused[i], scan, self.generator)
            if surely[i] and not item.foreign:
                item.pose_error, item.found_radius = blurred.pose_error, radius
            if self._review(item, moved) and not is_known(i, components, totals, found):
                result.newly_found.append(self._find(item, member, time))
                found.append(i)
        # r = p_new lambda_j / (kappa + lambda_j), f = e pi g_j / int e pi g_j.
        real = np.where(named, 0.0, scan.intensity / (kappa + scan.intensity))
        self._add_born(blurred, scan, new * real, radius)
        learnt.count_clutter(float((new * (1.0 - real)).sum()))
        self.exploration.update(scan.detection, member.pose)  # e <- e (1 - pi)

    def _add_born(
        self, member: CheckedMeasurement, scan: Scan, existence: FloatArray, radius: float
    ) -> None:
        """Add a component of r = `existence` (m,) for each detection."""
        error, robot = member.pose_error, member.robot
        # A copy: e changes.
        prior = self.exploration.kernel()[0].copy(), self.exploration.area.cells
        for j, density in scan.born(existence >= LEAST_EXISTENCE, prior, self._frame):
            item = Component(float(existence[j]), density, 1.0, self._scans, error, radius, robot)
            if member.labels:
                item.labels = LabelTally.of(member.labels[j])
                # An identity belongs to one.
                if item.labels.identity in {other.labels.identity for other in self.components}:
                    item.labels.identity = ''
            self.components.append(item)

    def _review(self, item: Component, moved: bool) -> bool:
        """Withdraw a found component that hardly exists; return whether a sure one can be found."""
        numbers, reflecting = self._numbers.pmb, reflects(item.answers, self._rates)
        if item.foreign:
            item.existence = CERTAIN
        elif item.target is not None:
            if item.belief < numbers.withdrawn_probability or reflecting > SURELY_REFLECTING:
                item.target = None
        elif item.rejected is None:
            return (
                moved
                and item.belief > numbers.found_probability
                and item.hits >= LEAST_HITS
                and item.density.radius <= item.found_radius
                and bool(reflecting < MOST_REFLECTING)
            )
        return False

    def _find(self, item: Component, member: CheckedMeasurement, time: float) -> FoundTarget:
        """Mark a component as found."""
        self._last_id += 1
        self._offsets.find(member.robot, self._last_id)
        mean, covariance, by = item.density.mean, item.density.covariance, member.robot
        target = FoundTarget(self._last_id, mean, covariance, by, member.index, time)
        item.target = self._estimate(target, item)
        return item.target

    def _estimate_changed(self) -> None:
        """Estimate the found targets whose densities have changed."""
        for item in self.components:
            if item.target is not None and item.stale and not item.foreign:
                item.target = self._estimate(item.target, item)
            item.stale = False

    def _estimate(self, target: FoundTarget, item: Component) -> FoundTarget:
        """Return a target with the moments of its particles and the position error of the robot."""
        covariance = item.density.covariance.copy()
        covariance.flat[:: self.dimension + 1] += item.pose_error**2
        covariance += self._offsets.covariance_of(target.id)
        mean, label = item.density.mean.copy(), item.labels.label
        by, index, time, origin = target.robot, target.measurement, target.time, target.origin
        return FoundTarget(target.id, mean, covariance, by, index, time, origin, label)

    def _predict(self, time: float) -> None:
        """Predict the random walk since the last step; learn how often targets answer."""
        last = time if self._last_time is None else self._last_time
        self._last_time = max(time, last)
        variance = self._numbers.pmb.walk**2 * max(time - last, 0.0)
        if variance > 0.0:
            self.exploration.diffuse(variance)
            for item in self.components:
                if not item.foreign:
                    item.density.diffuse(variance, self.generator)
                    item.stale = True
        self._rates = rate_of_targets(
            [item for item in self.components if item.existence >= LEAST_CLUSTER_MASS]
        )

    def _most_probable(self, result: FilterResult) -> list[Component]:
        """Return the components that are not found and may exist, at most so many."""
        items = [item for item in self._open if item.existence >= LEAST_EXISTENCE]
        if len(items) <= MOST_POTENTIAL:
            return items
        left_out = len(items) - MOST_POTENTIAL
        least = sorted((item.existence for item in items), reverse=True)[MOST_POTENTIAL]
        result.misfits['potential targets'] = (
            f'{len(items)} potential targets, allowed are {MOST_POTENTIAL}: {left_out} that exist '
            f'with probabilities up to {least:.2g} were left out; sensors show more false '
            'detections than the filter can follow'
        )
        order = sorted(range(len(items)), key=lambda i: -items[i].existence)
        return [items[i] for i in sorted(order[:MOST_POTENTIAL])]

    def _clusters_of(self, components: Sequence[Component]) -> list[Cluster]:
        """Return what may be a target; a place that reflects weighs less."""
        clusters = []
        for item in components:
            reflecting = reflects(item.answers, self._rates)
            sure = item.existence > SURE and item.hits >= SURE_HITS
            doubtful = not (sure and reflecting < CERTAINLY_REFLECTING)
            mass = item.belief * (1.0 - reflecting if doubtful else 1.0)
            if mass >= LEAST_CLUSTER_MASS:
                density = item.density
                mean, covariance = density.mean.copy(), density.covariance.copy()
                clusters.append(Cluster(mean, covariance, density.radius, mass))
        return sorted(clusters, key=lambda cluster: -cluster.mass)

    def _found_radius(self, member: CheckedMeasurement) -> float:
        """Return T_r [m]."""
        if self._numbers.found_radius is not None:
            return self._numbers.found_radius
        error = pose_error_of(member.sensor, self._numbers, self.dimension)
        return FOUND_RADIUS_DEVIATIONS * math.sqrt(member.sensor.covariance[0, 0] + error**2)

    def review(self, number: int, statements: float) -> None:
        """Withdraw or restore a found target, given the log odds of all its reviews."""
        for item in self.components:
            if number not in {target.id for target in (item.target, item.rejected) if target}:
                continue
            item.statements = statements
            if item.belief >= WITHDRAWN and item.rejected is not None:
                item.target, item.rejected = self._estimate(item.rejected, item), None
            elif item.belief < WITHDRAWN and item.target is not None:
                item.target, item.rejected = None, item.target

    def thin(self, report: Report) -> None:
        """Update what is not found with a measurement of others without detections.

        With the probability p(x) in the zone: p_D = ∫ f p dx, r <- r (1 - p_D) / (1 - r p_D),
        f <- f (1 - p) / (1 - p_D).
        """
        for item in self._open:
            density, r = item.density, item.existence
            seen = seen_by_others(report.shape, report.weight, density.particles)
            detected = float(density.weights @ seen)
            item.existence = r * (1.0 - detected) / (1.0 - r * detected)
            if np.ptp(seen) > 0.0:
                density.thin(1.0 - seen, self.generator)
        self.clusters = self._clusters_of(self._open)

    def register(self) -> FoundTargets:
        """Return the found targets with the ids given so far."""
        return FoundTargets(self.found_targets, self._last_id)

    def adopt(self, change: Change) -> None:
        """Mark components, or new ones, as found targets.

        Those of withdrawn targets are potential ones, which only own detections find.
        """
        self._last_id = change.found.last_id
        for target in change.changed:
            same = [item for item in self.components if item.target and item.target.id == target.id]
            others = self._open
            moments = [(item.density.mean, item.density.covariance) for item in others]
            best = nearest(target, moments)
            item = same[0] if same else others[best] if best >= 0 else None
            density = Density.normal(
                target.position,
                target.covariance,
                self._numbers.pmb.particles,
                self._frame,
                self.generator,
            )
            if item is None:
                item = Component(CERTAIN, density, LEAST_HITS, -1, 0.0, math.inf)
                self.components.append(item)
            item.existence, item.density, item.target = CERTAIN, density, target
            item.pose_error = 0.0
            item.labels = LabelTally.of(target.label)
        ids = {target.id for target in change.withdrawn}
        for item in self.components:
            if item.target is not None and item.target.id in ids:
                item.target, item.hits = None, 0.0
                item.existence = self._numbers.pmb.withdrawn_probability
