"""Bernoulli components: potential targets, whether they exist, and how often they answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_filter.found_targets import SAME_TARGET
from maasi_filter.geometry.vector_math import normalised, squared_distance
from maasi_filter.models.line_of_sight import HIDDEN, sight
from maasi_filter.pmb.association import MANY_PAIRS
from maasi_filter.pmb.density import Density
from maasi_filter.pmb.factors import MISS, SCALE, likelihoods, log_factor
from maasi_filter.pmb.labels import LabelTally
from maasi_filter.pmb.scan import LEAST_SUPPORT, Scan
from maasi_filter.records import FoundTarget
from maasi_filter.reports import believed

# Shares of the believed pi with which a place may answer.
RATES = np.array([1.0, 0.7, 0.5, 0.35, 0.2])
# Those with which all targets may, if pi is not as believed, and their probabilities beforehand.
COMMON = RATES[:3]
PRIOR = np.array([0.9, 0.05, 0.05])
MOST_OF_REFLECTION = 0.5  # a reflection answers at most this often, compared with a target
REFLECTIONS = 0.1  # probability beforehand that a place that answers is one
# p_D that a look tells with at most: a few misses do not make a reflection of a target.
MOST_TELLING = 0.9

# By the rate of targets and that of a place: weights of what a place is.
_TARGET = (1.0 - REFLECTIONS) * np.eye(len(COMMON), len(RATES))
_RARE = MOST_OF_REFLECTION * COMMON[:, None] >= RATES
_REFLECTION = REFLECTIONS * _RARE / _RARE.sum(axis=1, keepdims=True)


@njit(cache=True, error_model='numpy')
def add_look(answers, detected, missed):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Add the log likelihood of a look with each rate to `answers` (k,).

    `detected` is p_D as it is believed, `missed` the probability that the place did not answer.
    """
    detected = min(detected, MOST_TELLING)
    for k in range(len(RATES)):
        answers[k] += missed * math.log1p(-RATES[k] * detected)
        answers[k] += (1.0 - missed) * math.log(RATES[k])


def rate_of_targets(components: Sequence[Component]) -> FloatArray:
    """Return the probabilities of COMMON, from the answers of all places that may be targets."""
    if not components:
        return PRIOR
    logs = np.array([item.answers for item in components])
    peaks = logs.max(axis=1, keepdims=True)
    fits = np.log(np.exp(logs - peaks) @ (_TARGET + _REFLECTION).T)
    sums = np.array([item.existence for item in components]) @ fits + np.log(PRIOR)
    weights = np.exp(sums - sums.max())
    return np.asarray(weights / weights.sum())


@njit(cache=True, error_model='numpy')
def reflects(answers, rates):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the probability that a place is a reflection, from its answers and those of all."""
    peak = answers.max()
    target = 0.0
    reflection = 0.0
    for k in range(len(answers)):
        likelihood = math.exp(answers[k] - peak)
        for c in range(len(rates)):
            target += rates[c] * _TARGET[c, k] * likelihood
            reflection += rates[c] * _REFLECTION[c, k] * likelihood
    return reflection / (target + reflection)


GATE = 6.0  # gate of a detection, in standard deviations and root mean square radii
# Largest squared normalised distance for draws from a detection with too few particles.
SUPPORT_DISTANCE = 36.0
SUPPORT_DRAWS = 100
# Most pairs of a component and a detection of a large scan; the others are too far apart.
MOST_PAIRS = 12_000
LEAST_DRAWN_SHARE = 0.05  # association probability above which such draws replace particles
# Association probabilities and changes of the log density below these are neglected.
LEAST_SHARE = 1e-4
LEAST_CHANGE = 1e-3
# Number of factors above which a density is condensed to a normal one: found, or not.
MOST_FACTORS_FOUND = 60
MOST_FACTORS = 150

# Least expected number of detections of a found target: one precise detection is not enough.
LEAST_HITS = 1.5
# Expected joint detections in a scan from which two components are different targets.
SEEN_BOTH = 1.5
# Above this distance on an axis, in root mean square radii, two components are different targets.
REACH = math.sqrt(SAME_TARGET)
SAME_PLACE = 6.0  # gate on the squared normalised distance for merging components


@dataclass
class View:
    """Likelihoods of a component in one scan."""

    probability: FloatArray  # (n,): pi at its particles
    detected: float  # p_D = sum w pi
    gated: IntArray  # (g,): Detections within its gate
    seen: FloatArray  # (g, n): pi g_j at its particles
    likelihood: FloatArray  # (g,): L_j = int f pi g_j dx
    #: Weights of draws from detections with too few particles, by index in `gated`.
    drawn: dict[int, FloatArray] = field(default_factory=dict)


@dataclass
class Component:
    """A potential target."""

    existence: float  # r
    density: Density  # f
    hits: float  # Expected number of its detections, given that it exists
    scan: int  # Number of the scan it was born in
    pose_error: float  # Position error of the robot that detected it last, metres
    found_radius: float  # T_r of the sensor of that robot, metres
    robot: str = ''  # Robot whose detection it was born from; '' of a target of another filter
    target: FoundTarget | None = None  # The reported target, if it is found
    labels: LabelTally = field(default_factory=LabelTally)  # Its class and identity
    stale: bool = False  # Whether `density` has changed since `target` was estimated
    #: (k,): Log likelihood of its detections and misses since birth, with each of RATES.
    answers: FloatArray = field(default_factory=lambda: np.zeros(len(RATES)))

    #: Log odds of the reviews of persons.
    statements: float = 0.0
    rejected: FoundTarget | None = None  # The target as found, if persons rejected it

    @property
    def belief(self) -> float:
        """Probability that it is a target, with the reviews of persons."""
        return believed(self.existence, self.statements)

    @property
    def settled(self) -> bool:
        """Whether it was found, and persons may have rejected it."""
        return self.target is not None or self.rejected is not None

    @property
    def foreign(self) -> bool:
        """Whether the filter of another robot found it, and provides its estimate."""
        return self.target is not None and self.target.origin != 0

    def differs(self, other: Component) -> bool:
        """Return whether their identities say that they are two targets."""
        one, two = self.labels.identity, other.labels.identity
        return bool(one and two and one != two)

    def view(self, scan: Scan, gated: IntArray) -> View:
        """Return the likelihoods of this component in a scan, of the detections in its gate."""
        density = self.density
        probability = np.empty(len(density.weights))
        seen, sums = np.empty((len(gated), len(probability))), np.empty((2, len(gated)))
        terms = scan.terms[gated]
        detected = likelihoods(
            scan.head, terms, density.particles, density.weights, probability, seen, sums
        )
        if scan.terrain is not None:
            # Particles that the ground hides are hardly detected.
            weights = density.weights
            factor = sight(density.particles, scan.pose, scan.terrain, HIDDEN, probability)
            probability *= factor
            seen *= factor
            detected = float(weights @ probability)
            sums = np.stack([seen @ weights, np.square(seen) @ np.square(weights)])
        view = View(probability, detected, gated, seen, sums[0])
        for k, j in enumerate(gated.tolist()):
            total, squares = sums[:, k]
            if not (total > 0.0 and total * total >= LEAST_SUPPORT * squares):
                self._draw_likelihood(view, k, j, scan)
        return view

    def _draw_likelihood(self, view: View, k: int, j: int, scan: Scan) -> None:
        """Estimate a likelihood from draws of the detection, as particles are too sparse."""
        total = self.density.covariance + scan.covariances[j]
        if squared_distance(scan.means[j] - self.density.mean, total) > SUPPORT_DISTANCE:
            return
        logs = self.density.log_at(scan.draws[j, :SUPPORT_DRAWS])
        drawn = np.exp(np.minimum(logs, 600.0)) * scan.volume[j, :SUPPORT_DRAWS]
        square = float(drawn @ drawn)
        if square > 0.0 and float(drawn.sum()) ** 2 > LEAST_SUPPORT * square:
            view.likelihood[k] = float(drawn.mean())
            view.drawn[k] = drawn

    def update(
        self,
        view: View,
        missed: float,
        caused: FloatArray,
        scan: Scan,
        generator: np.random.Generator,
    ) -> bool:
        """Update with a scan, given marginal association probabilities; return whether f changed.

        a_0 = p_miss r (1 - p_D) / (1 - r p_D), a_j = p_j, r = sum a (Williams 2015, TOMB/P),
        f = (a_0 (1 - pi) / (1 - p_D) + sum a_j pi g_j / L_j) f / r.
        """
        r, detected, density = self.existence, view.detected, self.density
        nothing = missed * r * (1.0 - detected) / (1.0 - r * detected)
        causes = caused[view.gated]
        detections = sum(causes.tolist())
        self.existence = min(nothing + detections, 1.0)
        if self.foreign or not self.existence > 0.0:
            return False
        self.hits += detections / self.existence
        add_look(self.answers, detected, nothing / self.existence)
        share = causes / self.existence
        taken = (share > LEAST_SHARE).nonzero()[0]
        head = scan.head.copy()
        head[MISS] = nothing / ((1.0 - detected) * self.existence)
        scale = share[taken] / view.likelihood[taken]
        logs = np.empty(len(view.probability))
        spread = log_factor(head[MISS], view.probability, scale, view.seen[taken], logs)
        if not len(taken) and spread <= LEAST_CHANGE:
            return False
        terms = scan.terms[view.gated[taken]]
        terms[:, SCALE] += np.log(scale)
        drawn = [k for k in view.drawn if share[k] > LEAST_DRAWN_SHARE]
        if not drawn:
            density.multiply(head, terms, logs, generator)
        else:
            # Draw the posterior from particles and, for some detections, from draws of these.
            others = [k for k in taken.tolist() if k not in drawn]
            factor = head[MISS] * (1.0 - view.probability)
            factor += (share[others] / view.likelihood[others]) @ view.seen[others]
            particles, weights = [density.particles], [density.weights * factor]
            for k in drawn:
                particles.append(scan.draws[view.gated[k], :SUPPORT_DRAWS])
                weights.append(share[k] * view.drawn[k] / view.drawn[k].sum())
            draws, total = np.concatenate(particles), np.concatenate(weights)
            density.restart(head, terms, draws, total, generator)
        if len(density.heads) > (MOST_FACTORS if self.target is None else MOST_FACTORS_FOUND):
            density.condense()
        self.stale = True
        return True


def moments(components: Sequence[Component]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return means (n, d), covariances (n, d, d) and root mean square radii (n,), metres."""
    densities = [item.density for item in components]
    return (
        np.array([density.mean for density in densities]),
        np.array([density.covariance for density in densities]),
        np.array([density.radius for density in densities]),
    )


def views(components: Sequence[Component], scan: Scan) -> list[View]:
    """Return the likelihoods of components in a scan."""
    if not components:
        return []
    means, _, radii = moments(components)
    apart = np.sqrt(np.square(means - scan.pose.position[: means.shape[1]]).sum(axis=1))
    gates = np.abs(scan.ranges - apart[:, None]) < GATE * (scan.deviations + radii[:, None])
    if gates.size > MANY_PAIRS:
        gates = _nearest_pairs(gates, components, scan)
    return [item.view(scan, gate.nonzero()[0]) for item, gate in zip(components, gates)]


@njit(cache=True, error_model='numpy')
def gaps_of(gates, means, covariances, others, spreads):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Return the squared normalised distances of pairs (n, m), inf where `gates` has none."""
    out = np.full(gates.shape, np.inf)
    for i in range(gates.shape[0]):
        for j in range(gates.shape[1]):
            if gates[i, j]:
                total = covariances[i] + spreads[j]
                out[i, j] = normalised(others[j] - means[i], total)[0]
    return out


def _nearest_pairs(gates: BoolArray, components: Sequence[Component], scan: Scan) -> BoolArray:
    """Return the pairs (n, m) of a large scan that are near enough, and not too many of them."""
    means, covariances, _ = moments(components)
    gaps = gaps_of(gates, means, covariances, scan.means, scan.covariances)
    near = gaps < SUPPORT_DISTANCE
    if np.count_nonzero(near) > MOST_PAIRS:
        near = gaps <= np.partition(gaps[near], MOST_PAIRS)[MOST_PAIRS]
    return np.asarray(near)


def gap(one: Component, other: Component) -> float:
    """Return the squared normalised distance of two components."""
    offset = one.density.mean - other.density.mean
    return squared_distance(offset, one.density.covariance + other.density.covariance)


def merge(components: list[Component]) -> list[Component]:
    """Merge components of one target: the density of the heavier one, the sum of existences.

    At most one of the two is a target: the events exclude each other, so their probabilities add.
    Densities too broad to be found overlap by chance: they count as independent.
    They are two targets if they were born in one scan, as a target causes at most one detection per
    scan, if their identities differ, or if their probabilities sum to more than one target.
    """
    if len(components) < 2:
        return components
    means, _, radii = moments(components)
    gaps = np.square(means[:, None] - means[None]).sum(axis=2)
    near = gaps < SAME_PLACE * (radii[:, None] ** 2 + radii[None] ** 2)
    # No pairs of one scan, and of more than one target: existences only grow.
    existence, born = (
        np.array([getattr(item, name) for item in components]) for name in ('existence', 'scan')
    )
    near &= (born[:, None] != born) & (existence[:, None] + existence <= 1.0)
    kept: list[int] = []
    order = np.argsort([-item.existence for item in components], kind='stable')
    near, still = near[np.ix_(order, order)], np.zeros(len(order), np.bool_)
    for place, i in enumerate(order.tolist()):
        item = components[i]
        still[place] = True
        for other in (
            components[order[k]] for k in np.flatnonzero(near[place, :place] & still[:place])
        ):
            two = item.scan == other.scan or item.differs(other)
            two |= other.existence + item.existence > 1.0
            if not two and gap(other, item) < SAME_PLACE:
                broad = max(one.density.radius - one.found_radius for one in (item, other)) > 0.0
                other.existence += item.existence * (1.0 - other.existence if broad else 1.0)
                other.labels.merge(item.labels)
                still[place] = False
                break
        else:
            kept.append(i)
    return [components[i] for i in sorted(kept)]


def is_known(
    i: int, components: Sequence[Component], totals: FloatArray, found: Sequence[int]
) -> bool:
    """Return whether component i may be one of those found: together, one detection in each scan.

    totals (n,): the expected number of detections that each caused in this one.
    """
    item, rows = components[i], np.array(found, np.int64)
    for f in rows[totals[i] + totals[rows] <= SEEN_BOTH].tolist():
        other = components[f]
        reach = REACH * (item.density.radius + other.density.radius)
        if (
            abs(item.density.mean[0] - other.density.mean[0]) <= reach
            and other.settled
            and not item.differs(other)
            and gap(item, other) < SAME_TARGET
        ):
            return True
    return False
