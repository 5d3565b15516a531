"""What the scans of each robot have told of it: clutter, noise, errors, and whether they fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.models.sensor import LEAST_PER_SCAN
from maasi_filter.pmb.association import propagate
from maasi_filter.pmb.component import Component
from maasi_filter.pmb.factors import MOST_PROBABLE

# Deviations of the error that are compared, in deviations of the range.
LEVELS = np.array([0.0, 0.5, 1.0, 2.0, 4.0])
# Their probabilities beforehand.
PRIOR = np.array([0.96, 0.01, 0.01, 0.01, 0.01])
# Probability that the error is another one from one scan to the next.
CHANGE = 0.005
# Components below this r are not considered.
LEAST_EXISTENCE = 0.1
# Gate on the range, in deviations of the largest error and root mean square radii.
GATE = 4.0


@njit(cache=True, error_model='numpy')
def _log_sums(errors, jacobians, covariances, noise, variances, odds, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fill the log of the sum of the weights of all associations for each variance [m^2].

    `errors` (n, m, d), `jacobians` and `covariances` (n, d, d) are of n targets, `noise` (m, d, d)
    is R, `odds` (n, m) are those of a detection of density 1.
    """
    n, m, d = errors.shape
    psi = np.empty((n, m))
    missed, caused, new = np.empty(n), np.empty((n, m)), np.empty(m)
    root = np.empty((d, d))
    solved = np.empty(d)
    for k in range(len(variances)):
        for i in range(n):
            spread = covariances[i].copy()
            for a in range(d):
                spread[a, a] += variances[k]
            expected = jacobians[i] @ spread @ jacobians[i].T
            for j in range(m):
                exponent = 0.0
                for a in range(d):
                    for b in range(a + 1):
                        value = expected[a, b] + noise[j, a, b]
                        for c in range(b):
                            value -= root[a, c] * root[b, c]
                        root[a, b] = math.sqrt(max(value, 1e-30)) if a == b else value / root[b, b]
                    value = errors[i, j, a]
                    for c in range(a):
                        value -= root[a, c] * solved[c]
                    solved[a] = value / root[a, a]
                    exponent -= 0.5 * solved[a] ** 2 + math.log(root[a, a])
                psi[i, j] = odds[i, j] * math.exp(exponent) / (2.0 * math.pi) ** (0.5 * d)
        out[k] = propagate(psi, missed, caused, new)


def _near(member: CheckedMeasurement, items: Sequence[Component], reach: float) -> list[Component]:
    """Return the components whose distance from the robot is that of a detection, nearly."""
    if not (items and len(member.values)):
        return []
    means = np.array([item.density.mean for item in items])
    radii = np.array([item.density.radius for item in items])
    offsets = means - member.pose.position[: means.shape[1]]
    gaps = np.abs(np.sqrt(np.square(offsets).sum(axis=1))[:, None] - member.values[:, 0])
    near = gaps.min(axis=1) < reach + GATE * radii
    return [item for item, kept in zip(items, near.tolist()) if kept]


@dataclass
class PositionErrors:
    """Probabilities of the errors in LEVELS, for each robot."""

    probabilities: dict[str, FloatArray] = field(default_factory=dict)  # By robot: (k,)

    def learn(
        self,
        member: CheckedMeasurement,
        components: Sequence[Component],
        clutter: float,
        unseen: float,
    ) -> float:
        """Return the most probable deviation [m] after a scan, on each axis.

        `clutter` is kappa, per unit of measurement space; `unseen` N0 / V, per m^d: the largest
        intensity of undetected targets.
        """
        before = self.probabilities.get(member.robot, PRIOR)
        unit = math.sqrt(member.sensor.covariance[0, 0])
        likely = [item for item in components if item.existence >= LEAST_EXISTENCE]
        likely = _near(member, likely, GATE * unit * LEVELS[-1])
        if likely:
            logs = self._log_likelihoods(member, likely, clutter, unseen, unit)
            after = ((1.0 - CHANGE) * before + CHANGE * PRIOR) * np.exp(logs - logs.max())
            before = self.probabilities[member.robot] = after / after.sum()
        return unit * float(LEVELS[before.argmax()])

    def _log_likelihoods(
        self,
        member: CheckedMeasurement,
        likely: Sequence[Component],
        clutter: float,
        unseen: float,
        unit: float,
    ) -> FloatArray:
        """Return the log likelihood of a scan with each error, up to a constant."""
        values, pose, model = member.values, member.pose, member.sensor.measurement
        means = np.array([item.density.mean for item in likely])
        covariances = np.array([item.density.covariance for item in likely])
        errors = model.residual(values, model.measure(means, pose)[:, None])
        # |dx/dz| takes the density of undetected targets to measurement space.
        volume = np.abs(values[:, 0]) ** (values.shape[1] - 1)
        if values.shape[1] == 3:
            volume *= np.cos(values[:, 2])
        probability = np.minimum(member.sensor.detection.probability(means, pose), MOST_PROBABLE)
        detected = probability * [item.existence for item in likely]
        odds = (detected / (1.0 - detected))[:, None] / (clutter + unseen * volume)
        logs = np.empty(len(LEVELS))
        _log_sums(
            errors,
            model.jacobian(means, pose),
            covariances,
            member.covariances,
            member.pose_error**2 + np.square(unit * LEVELS),
            odds,
            logs,
        )
        return logs


# Weight of the prior of the clutter, in scans.
PRIOR_SCANS = 10.0
# Detections that the belief is worth.
PRIOR_DETECTIONS = 6.0
# The factor of the variance stays within these.
LEAST_FACTOR = 0.2
MOST_FACTOR = 10.0
# Share of the weight of earlier detections that each new one leaves.
MEMORY = 1.0 - 1.0 / 50.0
# A single outlier, such as a detection of another target, is no misfit: squares count up to this
# for each dimension.
MOST_SQUARE = 6.0
# Deviations of a standard normal number above which detections do not fit.
BOUND = 4.0
# Sums of a robot of which no detection was counted.
NOTHING = np.zeros(3)


@dataclass
class ClutterEstimate:
    """Mean number of false detections in a scan, with a gamma prior, for each robot.

    The mean of the prior is the configured rate of the sensor, at least LEAST_PER_SCAN; its weight
    is PRIOR_SCANS scans.

    Attributes
    ----------
    scans, counts : dict
        By robot: scans, and expected number of false detections in them.
    """

    scans: dict[str, int] = field(default_factory=dict)
    counts: dict[str, float] = field(default_factory=dict)

    def per_scan(self, robot: str, told: float) -> float:
        """Return the posterior mean for a robot with a configured rate of `told` per scan."""
        prior = max(told, LEAST_PER_SCAN)
        count = PRIOR_SCANS * prior + self.counts.get(robot, 0.0)
        return count / (PRIOR_SCANS + self.scans.get(robot, 0))

    def count(self, robot: str, false_detections: float) -> None:
        """Add a scan with an expected number of false detections."""
        self.scans[robot] = self.scans.get(robot, 0) + 1
        self.counts[robot] = self.counts.get(robot, 0.0) + false_detections


class Innovations(NamedTuple):
    """Detections minus what n targets lead to expect."""

    errors: FloatArray  # (n, m, d): e: metres and radians
    jacobians: FloatArray  # (n, d, d): H, at the targets
    #: (n, m, d, d): H P H' + R, of the errors; P includes the position error of the robot.
    covariances: FloatArray
    squares: FloatArray  # (n, m): Squared normalised errors


def innovations(
    member: CheckedMeasurement, means: FloatArray, covariances: FloatArray
) -> Innovations:
    """Return the innovations of all detections by targets with moments (n, d) and (n, d, d)."""
    model, pose = member.sensor.measurement, member.pose
    errors = model.residual(member.values, model.measure(means, pose)[:, None])
    jacobians = model.jacobian(means, pose)
    positions = covariances + member.pose_error**2 * np.eye(means.shape[1])
    expected = jacobians @ positions @ jacobians.swapaxes(1, 2)
    totals = expected[:, None] + member.covariances
    solved = np.linalg.solve(totals, errors[..., None])[..., 0]
    return Innovations(errors, jacobians, totals, (errors * solved).sum(axis=2))


@dataclass
class NoiseScale:
    """Factor of the variances of each robot's detections, with a prior of mean 1.

    Learnt from squared normalised innovations / d with the configured R: their mean is the factor
    if R outweighs H P H', and nearer to 1 otherwise.

    Attributes
    ----------
    detections, squares : dict
        By robot: expected number of detections of found targets, and the sum of their squared
        normalised innovations, each divided by the dimension.
    """

    detections: dict[str, float] = field(default_factory=dict)
    squares: dict[str, float] = field(default_factory=dict)

    def factor(self, robot: str) -> float:
        """Return the posterior mean of a robot's factor."""
        squares = PRIOR_DETECTIONS + self.squares.get(robot, 0.0)
        mean = squares / (PRIOR_DETECTIONS + self.detections.get(robot, 0.0))
        return float(np.clip(mean, LEAST_FACTOR, MOST_FACTOR))

    def count(self, robot: str, probability: float, square: float) -> None:
        """Count a detection that a found target caused with this probability."""
        self.detections[robot] = self.detections.get(robot, 0.0) + probability
        self.squares[robot] = self.squares.get(robot, 0.0) + probability * square


@dataclass
class Consistency:
    """Forgetting sums of the squared normalised innovations of each robot.

    Where noise, positions and stillness are as believed, a sum with weights w, divided by d sum w,
    is nearly chi-squared over its degrees of freedom, d (sum w)^2 / sum w^2.
    """

    #: By robot: sums of w e' S^-1 e, of d w, and of d w^2.
    sums: dict[str, FloatArray] = field(default_factory=dict)

    def count(self, robot: str, square: float, dimension: int) -> None:
        """Count a detection that a found target caused."""
        memory = np.array([MEMORY, MEMORY, MEMORY**2])
        new = np.array([min(square, MOST_SQUARE * dimension), dimension, dimension])
        self.sums[robot] = memory * self.sums.get(robot, NOTHING) + new

    def misfits(self) -> dict[str, str]:
        """Return a warning for each robot whose detections do not fit."""
        found = {}
        for robot, (squares, expected, weights) in sorted(self.sums.items()):
            if expected > 0.0 and _excess(squares / expected, expected**2 / weights) > BOUND:
                found[robot] = (
                    f'{robot}: detections of found targets are {math.sqrt(squares / expected):.1f} '
                    'times as far from where they are expected as the settings say: its noise or '
                    'the errors of its positions are larger, or targets do not stand still'
                )
        return found


def _excess(ratio: float, freedom: float) -> float:
    """Return chi-squared over its degrees of freedom in deviations from what is expected.

    Its cube root is nearly normal (Wilson and Hilferty 1931).
    """
    variance = 2.0 / (9.0 * freedom)
    return (ratio ** (1.0 / 3.0) - (1.0 - variance)) / math.sqrt(variance)


@dataclass
class Learnt:
    """Clutter, noise and errors of the robots, and whether they fit."""

    clutter: ClutterEstimate = field(default_factory=ClutterEstimate)
    noise: NoiseScale = field(default_factory=NoiseScale)
    errors: PositionErrors = field(default_factory=PositionErrors)
    consistency: Consistency = field(default_factory=Consistency)

    def count_found(
        self,
        member: CheckedMeasurement,
        components: Sequence[Component],
        caused: FloatArray,
        blurred: bool,
    ) -> None:
        """Count the innovations of the detections that found targets `caused` (n, m).

        If an error of the position explains the scan (`blurred`), it does not tell the noise.
        """
        own = [i for i, item in enumerate(components) if item.target and not item.foreign]
        rows = [i for i in own if caused[i].max(initial=0.0) > 0.5]
        if not rows:
            return
        d = member.values.shape[1]
        densities = [components[i].density for i in rows]
        means = np.array([density.mean for density in densities])
        covariances = np.array([density.covariance for density in densities])
        squares = innovations(member, means, covariances).squares
        for row, j in np.argwhere(caused[rows] > 0.5).tolist():
            square = float(squares[row, j])
            self.consistency.count(member.robot, square, d)
            if not blurred:
                self.noise.count(member.robot, float(caused[rows[row], j]), square / d)
