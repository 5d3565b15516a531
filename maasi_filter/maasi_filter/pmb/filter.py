"""Poisson multi-Bernoulli filter for static targets, or targets in a slow random walk.

Undetected targets are a Poisson process of intensity (N0 / V) e(x); each detection that may
originate from one of them creates a Bernoulli component (Williams 2015, TOMB/P). The equations are
in `docs/filter.md`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.found_targets import FoundTargets
from maasi_filter.measurement_check import (
    CheckedMeasurement,
    check_measurements,
    count_unexplained,
    pose_error_of,
    within_range,
    without_repeats,
)
from maasi_filter.models.detection import BoxDetection
from maasi_filter.pmb.association import (
    Marginals,
    associate,
    associate_by_identity,
    learn_labels,
    new_label,
)
from maasi_filter.pmb.births import Births, born, draw_births
from maasi_filter.pmb.component import (
    LEAST_HITS,
    PRIOR,
    RATES,
    Component,
    LabelTally,
    View,
    can_be_found,
    is_known,
    merge,
    nearest,
    rate_of_targets,
    reflects,
    views,
)
from maasi_filter.pmb.density import Density
from maasi_filter.pmb.factors import Scan, make_scan
from maasi_filter.pmb.learnt import Learnt
from maasi_filter.pmb.offsets import Offsets
from maasi_filter.records import AgentMeasurement, Cluster, FilterResult, FoundTarget
from maasi_filter.search_filter import FilterBase
from maasi_filter.settings import FilterSettings

LEAST_EXISTENCE = 1e-4
# Least existence probability of a cluster that is published.
LEAST_CLUSTER_MASS = 0.1
# Default of T_r, in standard deviations of the range.
FOUND_RADIUS_DEVIATIONS = 2.0
# Probability of being a reflection below which a target can be found, and above which a found one
# is withdrawn.
MOST_REFLECTING = 0.3
SURELY_REFLECTING = 0.5
# Gate on the squared normalised distance for merging components.
SAME_PLACE = 6.0
# Existence probability of targets that other filters found.
CERTAIN = 0.999


class PmbFilter(FilterBase):
    """Poisson multi-Bernoulli filter for a set M_k of measuring robots.

    Settings that are None are derived from the measuring sensor. `components` are the potential
    targets, including found ones; everything else is as of `SearchFilter`.
    """

    method = 'pmb'
    saved: ClassVar[dict[str, Any]] = {
        'components': list[Component],
        '_learnt': Learnt,
        '_offsets': Offsets,
        '_scans': int,
        '_last_id': int,
        '_last_time': float | None,
    }

    def __init__(
        self, settings: FilterSettings, bounds: ArrayLike, generator: np.random.Generator
    ) -> None:
        super().__init__(settings, bounds, generator)
        self._numbers = settings.resolved()
        self._expected_targets = self._numbers.expected_targets
        self.components: list[Component] = []
        self._learnt = Learnt()
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
    def expected_number(self) -> float:
        """Expected number of detected but not found targets: the sum of their r."""
        return math.fsum(item.existence for item in self.components if item.target is None)

    @property
    def particles(self) -> FloatArray:
        """Particles of the components that are not found, (n, d), metres."""
        parts = [item.density.particles for item in self.components if item.target is None]
        return np.concatenate([np.empty((0, self.dimension)), *parts])

    @property
    def weights(self) -> FloatArray:
        """Their weights, (n,); they sum to the expected number."""
        parts = [
            item.existence * item.density.weights for item in self.components if item.target is None
        ]
        return np.concatenate([np.empty(0), *parts])

    # One step.

    def step(
        self, measurements: Sequence[AgentMeasurement], steps: int, time: float
    ) -> FilterResult:
        """Predict, correct with every robot of M_k, merge and mark."""
        members = check_measurements(measurements, steps, time, self._numbers, self.dimension)
        dropped: dict[str, int] = {}
        newly_found: list[FoundTarget] = []
        changed = self._predict(time)
        self._rates = self._rate_of_targets()
        for member in members:
            changed |= self._correct(member, newly_found, dropped, time)
        self._estimate_found()
        self._reduce()
        self._cluster()
        return FilterResult(
            clusters=list(self.clusters),
            newly_found=newly_found,
            found_changed=changed,
            expected_number=self.expected_number,
            dropped=dropped,
            misfits=self._learnt.consistency.misfits(),
        )

    def _correct(
        self,
        member: CheckedMeasurement,
        newly_found: list[FoundTarget],
        dropped: dict[str, int],
        time: float,
    ) -> bool:
        """Correct with one robot's scan; return whether what is found changed."""
        member = without_repeats(within_range(member, dropped), dropped)
        space = member.sensor.measurement_space(self.bounds)
        # kappa: clutter per unit of measurement space.
        kappa = self._learnt.clutter.per_scan(member.robot, member.sensor.clutter * space) / space
        believed = self._localised(member, kappa)
        member = self._blurred(believed, kappa)
        scan = self._scan(member)
        self._scans += 1
        # lambda_j = (N0 / V) int e pi g_j dx, by importance sampling from the detections.
        number = self._numbers.pmb.particles
        births = draw_births(scan, self.exploration, self._expected_targets, number, self.generator)
        # p_D = int f pi dx, L_j = int f pi g_j dx.
        seen = views(self.components, scan, births)
        # Association: odds r L_j / (1 - r p_D) against kappa + lambda_j.
        odds = np.zeros((len(seen), len(scan.terms)))
        for i, (item, view) in enumerate(zip(self.components, seen)):
            odds[i, view.gated] = item.odds(view)
        other = kappa + births.intensity
        named = associate_by_identity(member.labels, self.components, odds, other)
        marginals = associate(odds, other)
        learn_labels(member.labels, self.components, marginals.caused)
        blurred = member.pose_error > believed.pose_error
        self._learnt.count_found(believed, self.components, marginals.caused, blurred)
        alone = (births.intensity <= 0.0) & ~(odds > 0.0).any(axis=0)
        count_unexplained(scan.centres[alone], self.bounds, dropped)
        changed = self._offsets.active and bool(self.own_found_targets())
        changed |= self._update(member, scan, births, seen, marginals, newly_found, time)
        # r = p_new lambda_j / (kappa + lambda_j).
        real = np.where(named, 0.0, births.intensity / (kappa + births.intensity))
        self._add_born(member, scan, births, marginals.new * real)
        self._learnt.clutter.count(member.robot, float((marginals.new * (1.0 - real)).sum()))
        # e <- e (1 - pi).
        self.exploration.update(scan.detection, member.pose)
        return changed

    def _add_born(
        self, member: CheckedMeasurement, scan: Scan, births: Births, existence: FloatArray
    ) -> None:
        """Add components of r = `existence` (m,) and f = e pi g_j / int e pi g_j."""
        likely, e = existence >= LEAST_EXISTENCE, self.exploration.kernel()[0]
        error, radius = member.pose_error, self._found_radius(member)
        for j, density in born(scan, births, likely, e, self._frame):
            item = Component(
                float(existence[j]), density, 1.0, self._scans, error, radius, member.robot
            )
            item.labels = new_label(member.labels, j, self.components)
            self.components.append(item)

    def _update(
        self,
        member: CheckedMeasurement,
        scan: Scan,
        births: Births,
        seen: Sequence[View],
        marginals: Marginals,
        newly_found: list[FoundTarget],
        time: float,
    ) -> bool:
        """Update all components, mark and withdraw; return whether what is found changed."""
        changed = False
        radius = self._found_radius(member)
        detected = (marginals.caused.sum(axis=1) > 0.5).tolist()
        for i, (item, view) in enumerate(zip(self.components, seen)):
            caused = marginals.caused[i]
            # r = a_0 + sum a_j, f = (a_0 (1 - pi) / (1 - p_D) + sum a_j pi g_j / L_j) f / r.
            moved = item.update(view, marginals.missed[i], caused, scan, births, self.generator)
            if detected[i] and not item.foreign:
                item.pose_error, item.found_radius = member.pose_error, radius
            if item.target is not None:
                changed |= self._keep_or_withdraw(item, moved)
            elif (
                moved
                and can_be_found(item, self._numbers.pmb.found_probability)
                and reflects(item.answers, self._rates) < MOST_REFLECTING
                and not is_known(i, self.components, marginals.caused)
            ):
                newly_found.append(self._find(item, member, time))
                changed = True
        return changed

    def _localised(self, member: CheckedMeasurement, kappa: float) -> CheckedMeasurement:
        """Return a scan at the robot's estimated pose, and move found targets with their errors."""
        if not self._offsets.active:
            return member
        self._offsets.keep({target.id for target in self.own_found_targets()})
        density = self._expected_targets / self.exploration.volume
        member = self._offsets.localise(member, self.components, kappa, density)
        for item in self.components:
            item.stale = True
        return member

    def _blurred(self, member: CheckedMeasurement, kappa: float) -> CheckedMeasurement:
        """Return a scan with the error of the robot's position that its fit tells of."""
        density = self._expected_targets / self.exploration.volume
        error = self._learnt.errors.learn(member, self.components, kappa, density)
        return replace(member, pose_error=math.hypot(member.pose_error, error))

    def _scan(self, member: CheckedMeasurement) -> Scan:
        """Return a member's detections for the kernels, with the noise that was learnt."""
        detection = member.sensor.detection
        if isinstance(detection, BoxDetection):
            # The position error of the robot blurs the edge of a box-shaped field of view.
            detection = detection.softened(2.0 * member.pose_error)
        return make_scan(member, self._learnt.noise.factor(member.robot), detection)

    def _find(self, item: Component, member: CheckedMeasurement, time: float) -> FoundTarget:
        """Mark a component as found."""
        d = self.dimension
        nowhere = np.zeros(d), np.zeros((d, d))
        self._last_id += 1
        target = FoundTarget(self._last_id, *nowhere, member.robot, member.index, time)
        if self._offsets.active:
            self._offsets.find(member.robot, target.id)
        item.target = self._estimate(target, item)
        return item.target

    def _keep_or_withdraw(self, item: Component, moved: bool) -> bool:
        """Withdraw a found component that hardly exists; return whether its target changed."""
        if item.foreign:
            item.existence = CERTAIN
            return False
        reflecting = reflects(item.answers, self._rates) > SURELY_REFLECTING
        if reflecting or item.existence < self._numbers.pmb.withdrawn_probability:
            item.target = None
            return True
        return moved

    def _rate_of_targets(self) -> FloatArray:
        """Return how often targets answer, of what pi says, from all that probably exist."""
        items = [item for item in self.components if item.existence >= LEAST_CLUSTER_MASS]
        return rate_of_targets([item.answers for item in items], [item.existence for item in items])

    def _estimate(self, target: FoundTarget, item: Component) -> FoundTarget:
        """Return a target with the moments of its particles and the position error of the robot."""
        covariance = item.density.covariance.copy()
        covariance.flat[:: self.dimension + 1] += item.pose_error**2
        if self._offsets.active:
            covariance += self._offsets.covariance_of(target.id)
        return FoundTarget(
            target.id,
            item.density.mean.copy(),
            covariance,
            target.robot,
            target.measurement,
            target.time,
            label=item.labels.label,
        )

    def _estimate_found(self) -> None:
        """Estimate the found targets whose densities have changed in this step."""
        for item in self.components:
            if item.target is not None and item.stale and not item.foreign:
                item.target = self._estimate(item.target, item)
            item.stale = False

    def _predict(self, time: float) -> bool:
        """Predict the random walk since the last step; return whether a found target changed."""
        walk = self._numbers.pmb.walk
        last = time if self._last_time is None else self._last_time
        self._last_time = max(time, last)
        variance = walk**2 * max(time - last, 0.0)
        if variance == 0.0:
            return False
        self.exploration.diffuse(variance)
        for item in self.components:
            if item.foreign:
                continue
            item.density.diffuse(variance, self.generator)
            item.stale = True
        return any(item.target is not None and item.stale for item in self.components)

    def _reduce(self) -> None:
        """Prune components with low existence probability, and merge those of one target."""
        found = [item for item in self.components if item.target is not None]
        others = [
            item
            for item in self.components
            if item.target is None and item.existence >= LEAST_EXISTENCE
        ]
        self.components = found + merge(others, SAME_PLACE)

    def _cluster(self) -> None:
        """Publish what may be a target that is not found; a place that reflects weighs less."""
        clusters = []
        for item in self.components:
            if item.target is not None or item.existence < LEAST_CLUSTER_MASS:
                continue
            mass = item.existence * (1.0 - reflects(item.answers, self._rates))
            if mass >= LEAST_CLUSTER_MASS:
                density = item.density
                mean, covariance = density.mean.copy(), density.covariance.copy()
                clusters.append(Cluster(mean, covariance, density.radius, mass))
        self.clusters = sorted(clusters, key=lambda cluster: -cluster.mass)

    def _found_radius(self, member: CheckedMeasurement) -> float:
        """Return T_r [m]."""
        if self._numbers.found_radius is not None:
            return self._numbers.found_radius
        error = pose_error_of(member.sensor, self._numbers, self.dimension)
        return FOUND_RADIUS_DEVIATIONS * math.sqrt(member.sensor.covariance[0, 0] + error**2)

    def register(self) -> FoundTargets:
        """Return the found targets with the ids given so far."""
        return FoundTargets(self.found_targets, self._last_id)

    def place(self, found: FoundTargets, changed: Sequence[FoundTarget]) -> None:
        """Mark components, or new ones, as found targets."""
        self._last_id = found.last_id
        for target in changed:
            same = [item for item in self.components if item.target and item.target.id == target.id]
            item = same[0] if same else nearest(target, self.components)
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

    def check(self) -> None:
        """Refuse a loaded state whose components are not usable."""
        for item in self.components:
            item.density.restore(self._frame, self.exploration.kernel()[0].shape)
            if not 0.0 <= item.existence <= 1.0 or item.answers.shape != (len(RATES),):
                raise ValueError(
                    f'component: got existence {item.existence} and {len(item.answers)} answers, '
                    f'allowed are 0 to 1 and {len(RATES)}'
                )
