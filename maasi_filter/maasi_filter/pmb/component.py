"""Bernoulli components: potential targets, whether they exist, and how often they answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray, IntArray
from maasi_filter.found_targets import SAME_TARGET, distance
from maasi_filter.pmb.births import LEAST_SUPPORT, Births
from maasi_filter.pmb.density import Density
from maasi_filter.pmb.factors import MISS, SCALE, Scan, likelihoods, log_factor
from maasi_filter.records import FoundTarget, Label
from maasi_filter.vector_math import squared_distance

# Shares of the believed pi with which a place may answer.
RATES = np.array([1.0, 0.7, 0.5, 0.35, 0.2])
# Those with which all targets may, if pi is not as believed, and their probabilities beforehand.
COMMON = RATES[:3]
PRIOR = np.array([0.9, 0.05, 0.05])
# A reflection answers at most this often, compared with a target.
MOST_OF_REFLECTION = 0.5
# Probability beforehand that a place that answers is one.
REFLECTIONS = 0.1

# By the rate of targets and that of a place: weights of what a place is.
_TARGET = (1.0 - REFLECTIONS) * np.eye(len(COMMON), len(RATES))
_RARE = MOST_OF_REFLECTION * COMMON[:, None] >= RATES
_REFLECTION = REFLECTIONS * _RARE / _RARE.sum(axis=1, keepdims=True)


@njit(cache=True, error_model='numpy')
def add_look(answers, detected, missed):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Add the log likelihood of a look with each rate to `answers` (k,).

    `detected` is p_D as it is believed, `missed` the probability that the place did not answer.
    """
    for k in range(len(RATES)):
        answers[k] += missed * math.log1p(-RATES[k] * detected)
        answers[k] += (1.0 - missed) * math.log(RATES[k])


def rate_of_targets(answers: Sequence[FloatArray], existence: Sequence[float]) -> FloatArray:
    """Return the probabilities of COMMON, from the answers of all places that may be targets."""
    if not len(answers):
        return PRIOR
    logs = np.array(answers)
    peaks = logs.max(axis=1, keepdims=True)
    fits = np.log(np.exp(logs - peaks) @ (_TARGET + _REFLECTION).T)
    sums = np.array(existence) @ fits + np.log(PRIOR)
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


@dataclass
class LabelTally:
    """What is known of the class and identity of one potential target.

    Parameters
    ----------
    identity : str
        Empty: not known.
    classes : dict
        Sum of the scores of its detections, by class.
    """

    identity: str = ''
    classes: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, label: Label) -> LabelTally:
        """Return the tally of one label."""
        tally = cls(label.identity)
        tally.add(label, 1.0)
        return tally

    def add(self, label: Label, share: float) -> None:
        """Count the class of a detection that this target caused with probability `share`.

        A score that is not known counts as 1.
        """
        if label.class_id:
            weight = share * (label.score or 1.0)
            self.classes[label.class_id] = self.classes.get(label.class_id, 0.0) + weight

    def merge(self, other: LabelTally) -> None:
        """Add what is known of the same target."""
        self.identity = self.identity or other.identity
        for name, score in other.classes.items():
            self.classes[name] = self.classes.get(name, 0.0) + score

    @property
    def label(self) -> Label:
        """The class of the largest sum, with its share of all sums, and the identity."""
        if not self.classes:
            return Label(identity=self.identity)
        # Of equal sums the first by name: the order of detections does not matter.
        best = min(self.classes, key=lambda name: (-self.classes[name], name))
        total = sum(self.classes[name] for name in sorted(self.classes))
        score = self.classes[best] / total if total > 0.0 else 0.0
        return Label(best, min(score, 1.0), self.identity)


# Gate of a detection, in standard deviations and root mean square radii.
GATE = 6.0
# Largest squared normalised distance for draws from a detection with too few particles.
SUPPORT_DISTANCE = 36.0
SUPPORT_DRAWS = 100
# Association probability above which such draws replace particles.
LEAST_DRAWN_SHARE = 0.05
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

    @property
    def foreign(self) -> bool:
        """Whether the filter of another robot found it, and provides its estimate."""
        return self.target is not None and self.target.origin != 0

    def differs(self, other: Component) -> bool:
        """Return whether their identities say that they are two targets."""
        one, two = self.labels.identity, other.labels.identity
        return bool(one and two and one != two)

    def view(self, scan: Scan, gated: IntArray, births: Births) -> View:
        """Return the likelihoods of this component in a scan, of the detections in its gate."""
        density = self.density
        probability = np.empty(len(density.weights))
        seen = np.empty((len(gated), len(probability)))
        sums = np.empty((2, len(gated)))
        detected = likelihoods(
            scan.head,
            scan.terms[gated],
            density.particles,
            density.weights,
            probability,
            seen,
            sums,
        )
        view = View(probability, detected, gated, seen, sums[0])
        for k in range(len(gated)):
            total, squares = sums[:, k]
            if not (total > 0.0 and total * total >= LEAST_SUPPORT * squares):
                self._likelihood_of_draws(view, k, births)
        return view

    def odds(self, view: View) -> FloatArray:
        """Return r L_j / (1 - r p_D) of the gated detections."""
        return self.existence * view.likelihood / (1.0 - self.existence * view.detected)

    def update(
        self,
        view: View,
        missed: float,
        caused: FloatArray,
        scan: Scan,
        births: Births,
        generator: np.random.Generator,
    ) -> bool:
        """Update with a scan, given marginal association probabilities; return whether f changed.

        a_0 = p_miss r (1 - p_D) / (1 - r p_D), a_j = p_j, r = sum a (Williams 2015, TOMB/P).
        """
        r, detected = self.existence, view.detected
        nothing = missed * r * (1.0 - detected) / (1.0 - r * detected)
        own = caused[view.gated]
        detections = float(own.sum())
        self.existence = min(nothing + detections, 1.0)
        if self.foreign or not self.existence > 0.0:
            return False
        self.hits += detections / self.existence
        add_look(self.answers, detected, nothing / self.existence)
        share = own / self.existence
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
        if drawn:
            self._restart(head, terms, view, drawn, share, births, generator)
        else:
            self.density.multiply(head, terms, logs, generator)
        most = MOST_FACTORS if self.target is None else MOST_FACTORS_FOUND
        if len(self.density.heads) > most:
            self.density.condense()
        self.stale = True
        return True

    def _likelihood_of_draws(self, view: View, k: int, births: Births) -> None:
        """Estimate a likelihood from draws of the detection, as particles are too sparse."""
        j = view.gated[k]
        total = self.density.covariance + births.covariances[j]
        if squared_distance(births.means[j] - self.density.mean, total) > SUPPORT_DISTANCE:
            return
        logs = self.density.log_at(births.particles[j, :SUPPORT_DRAWS])
        drawn = np.exp(np.minimum(logs, 600.0)) * births.volume[j, :SUPPORT_DRAWS]
        square = float(drawn @ drawn)
        if square > 0.0 and float(drawn.sum()) ** 2 > LEAST_SUPPORT * square:
            view.likelihood[k] = float(drawn.mean())
            view.drawn[k] = drawn

    def _restart(
        self,
        head: FloatArray,
        terms: FloatArray,
        view: View,
        drawn: list[int],
        share: FloatArray,
        births: Births,
        generator: np.random.Generator,
    ) -> None:
        """Draw the posterior from particles and, for some detections, from draws of these."""
        density = self.density
        others = [k for k in np.flatnonzero(share > LEAST_SHARE).tolist() if k not in drawn]
        factor = head[MISS] * (1.0 - view.probability)
        factor += (share[others] / view.likelihood[others]) @ view.seen[others]
        particles, weights = [density.particles], [density.weights * factor]
        for k in drawn:
            particles.append(births.particles[view.gated[k], :SUPPORT_DRAWS])
            weights.append(share[k] * view.drawn[k] / view.drawn[k].sum())
        density.restart(head, terms, np.concatenate(particles), np.concatenate(weights), generator)


def views(components: Sequence[Component], scan: Scan, births: Births) -> list[View]:
    """Return the likelihoods of components in a scan."""
    d = scan.origins.shape[1]
    means = np.array([item.density.mean for item in components]).reshape(-1, d)
    radii = np.array([item.density.radius for item in components])[:, None]
    apart = np.sqrt(np.square(means - scan.pose.position[:d]).sum(axis=1))[:, None]
    gates = np.abs(scan.ranges - apart) < GATE * (scan.deviations + radii)
    return [item.view(scan, gate.nonzero()[0], births) for item, gate in zip(components, gates)]


def same_place(one: Component, other: Component, distance: float) -> bool:
    """Return whether two components may be one target, within a squared normalised distance.

    Not if they were born in one scan, as a target causes at most one detection per scan, if their
    identities differ, or if their existence probabilities sum to more than one target.
    """
    if one.scan == other.scan or one.differs(other) or one.existence + other.existence > 1.0:
        return False
    offset = one.density.mean - other.density.mean
    total = one.density.covariance + other.density.covariance
    return bool(squared_distance(offset, total) < distance)


def merge(components: list[Component], distance: float) -> list[Component]:
    """Merge components of one target: the density of the heavier one, the sum of existences.

    At most one of the two is a target: the events exclude each other, so their probabilities add.
    """
    if len(components) < 2:
        return components
    means = np.array([item.density.mean for item in components])
    radii = np.array([item.density.radius for item in components])
    gaps = np.square(means[:, None] - means[None]).sum(axis=2)
    near = gaps < distance * (radii[:, None] ** 2 + radii[None] ** 2)
    order = np.argsort([-item.existence for item in components], kind='stable').tolist()
    kept: list[int] = []
    for i in order:
        item = components[i]
        for k in kept:
            if near[i, k] and same_place(components[k], item, distance):
                components[k].existence += item.existence
                components[k].labels.merge(item.labels)
                break
        else:
            kept.append(i)
    return [components[i] for i in sorted(kept)]


def can_be_found(item: Component, probability: float) -> bool:
    """Return whether a component almost surely exists, at a precisely known position."""
    return (
        item.target is None
        and item.existence > probability
        and item.hits >= LEAST_HITS
        and item.density.radius <= item.found_radius
    )


def is_known(i: int, components: Sequence[Component], caused: FloatArray) -> bool:
    """Return whether component i may be the same target as a found component.

    A target causes at most one detection per scan, so two components that together caused more than
    one are two targets.
    """
    density = components[i].density
    for f, other in enumerate(components):
        if other.target is None or components[i].differs(other):
            continue
        if caused[[i, f]].sum() > SEEN_BOTH:
            continue
        offset = density.mean - other.density.mean
        total = density.covariance + other.density.covariance
        if squared_distance(offset, total) < SAME_TARGET:
            return True
    return False


def nearest(target: FoundTarget, components: Sequence[Component]) -> Component | None:
    """Return the nearest component that is not found within the gate of a target, or None."""
    best, least = None, SAME_TARGET
    for item in components:
        if item.target is None:
            gap = distance(item.density.mean, item.density.covariance, target)
            if gap < least:
                best, least = item, gap
    return best
