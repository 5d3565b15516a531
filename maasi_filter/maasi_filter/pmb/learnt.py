"""What the scans of a robot have told: clutter, noise, errors of its position, and misfits."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.vector_math import normalised
from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.pmb.association import MANY_PAIRS, propagate
from maasi_filter.pmb.component import Component, moments
from maasi_filter.pmb.factors import MOST_PROBABLE

PRIOR_SCANS = 10.0  # weight of the prior of the clutter, in scans
PRIOR_DETECTIONS = 6.0  # detections that the belief in the noise is worth
# The factor of the variance stays within these.
LEAST_FACTOR = 0.2
MOST_FACTOR = 10.0
# Deviations of the error of positions that are compared, in deviations of the range.
LEVELS = np.array([0.0, 0.5, 1.0, 2.0, 4.0])
PRIOR = np.array([0.96, 0.01, 0.01, 0.01, 0.01])  # their probabilities beforehand
CHANGE = 0.005  # probability that the error is another one from one scan to the next
LEAST_EXISTENCE = 0.1  # components below this r are not considered
LEARNING_PAIRS = 10_000  # pairs with detections that the error of a large scan is learnt from
GATE = 4.0  # gate on the range, in deviations of the largest error and root mean square radii
# Share of the weight of earlier detections that each new one leaves.
MEMORY = 1.0 - 1.0 / 50.0
FADING = np.array([MEMORY, MEMORY, MEMORY**2])
# A single outlier, such as a detection of another target, is no misfit: squares count up to this
# for each dimension.
MOST_SQUARE = 6.0
BOUND = 4.0  # deviations of a standard normal number above which detections do not fit


@njit(cache=True, error_model='numpy')
def _log_sums(errors, jacobians, covariances, noise, variances, odds, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Fill the log of the sum of the weights of all associations for each variance [m^2]."""
    n, m, d = errors.shape
    psi = np.empty((n, m))
    missed, caused, new = np.empty(n), np.empty((n, m)), np.empty(m)
    for k in range(len(variances)):
        for i in range(n):
            spread = covariances[i] + variances[k] * np.eye(d)
            expected = jacobians[i] @ spread @ jacobians[i].T
            for j in range(m):
                square, log_root = normalised(errors[i, j], expected + noise[j])
                density = math.exp(-0.5 * square - log_root) / (2.0 * math.pi) ** (0.5 * d)
                psi[i, j] = odds[i, j] * density
        out[k] = propagate(psi, missed, caused, new)


def likely(components: Sequence[Component]) -> list[Component]:
    """Return those that may well be targets."""
    return [item for item in components if item.existence >= LEAST_EXISTENCE]


def odds_of_detection(
    member: CheckedMeasurement, components: Sequence[Component], means: FloatArray
) -> FloatArray:
    """Return r p_D / (1 - r p_D) of components (n,), with pi at their means for p_D."""
    probability = member.sensor.detection.probability(means, member.pose)
    detected = np.minimum(probability, MOST_PROBABLE) * [item.existence for item in components]
    return np.asarray(detected / (1.0 - detected))


def innovations(
    member: CheckedMeasurement, means: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return detections minus what targets of moments (n, d) and (n, d, d) lead to expect.

    These are errors e (n, m, d), Jacobians H (n, d, d), covariances S = H P H' + R (n, m, d, d),
    with the position error of the robot in P, and squares e' S^-1 e (n, m).
    """
    model, pose = member.sensor.measurement, member.pose
    errors = model.residual(member.values, model.measure(means, pose)[:, None])
    jacobians = model.jacobian(means, pose)
    positions = covariances + member.pose_error**2 * np.eye(means.shape[1])
    expected = jacobians @ positions @ jacobians.swapaxes(1, 2)
    totals = expected[:, None] + member.covariances
    solved = np.linalg.solve(totals, errors[..., None])[..., 0]
    return errors, jacobians, totals, (errors * solved).sum(axis=2)


@dataclass
class Learnt:
    """What the scans of one robot have told."""

    scans: int = 0
    clutter: float = 0.0  # Expected number of false detections in them
    detections: float = 0.0  # Expected number of those that found targets caused
    squares: float = 0.0  # Sum of their squared normalised innovations, divided by d
    #: (k,): Probabilities of the errors of positions in LEVELS.
    errors: FloatArray = field(default_factory=lambda: PRIOR)
    #: Of innovations, with weights w that fade: sums of w e' S^-1 e, of d w, and of d w^2.
    fit: FloatArray = field(default_factory=lambda: np.zeros(3))

    def clutter_per_scan(self, told: float) -> float:
        """Return the mean false detections in a scan, with a prior of `told` worth PRIOR_SCANS."""
        return (PRIOR_SCANS * told + self.clutter) / (PRIOR_SCANS + self.scans)

    def count_clutter(self, false_detections: float) -> None:
        """Add a scan with an expected number of false detections."""
        self.scans += 1
        self.clutter += false_detections

    def noise_factor(self) -> float:
        """Return the factor of the variances of detections, with a prior of mean 1.

        The mean of squared normalised innovations / d with the configured R is the factor if R
        outweighs H P H', and nearer to 1 otherwise.
        """
        mean = (PRIOR_DETECTIONS + self.squares) / (PRIOR_DETECTIONS + self.detections)
        return min(max(mean, LEAST_FACTOR), MOST_FACTOR)

    def count_found(
        self,
        member: CheckedMeasurement,
        components: Sequence[Component],
        caused: FloatArray,
        blurred: bool,
    ) -> None:
        """Count innovations of detections `caused` (n, m), unless a position error blurs them."""
        rows = np.flatnonzero((caused > 0.5).any(axis=1)).tolist()
        rows = [i for i in rows if components[i].target and not components[i].foreign]
        if rows:
            means, covariances, _ = moments([components[i] for i in rows])
            for i, mean, covariance in zip(rows, means, covariances):
                taken = caused[i] > 0.5
                squares = innovations(member.only(taken), mean[None], covariance[None])[3]
                for square, share in zip(squares[0].tolist(), caused[i, taken].tolist()):
                    self.count_innovation(square, len(mean), 0.0 if blurred else share)

    def count_innovation(self, square: float, d: int, probability: float) -> None:
        """Count a squared innovation; for the noise with a probability that it tells of that."""
        self.fit = FADING * self.fit + np.array([min(square, MOST_SQUARE * d), d, d])
        self.detections += probability
        self.squares += probability * (square / d)

    def learn_error(
        self,
        member: CheckedMeasurement,
        components: Sequence[Component],
        clutter: FloatArray,
        unseen: float,
    ) -> float:
        """Return the most probable deviation [m] of the position after a scan, on each axis.

        `clutter` (m,) is kappa, per unit of measurement space; `unseen` is N0 / V, per m^d, the
        largest intensity of undetected targets.
        """
        unit = math.sqrt(member.sensor.covariance[0, 0])
        items = likely(components)
        if items and len(member.values):
            # Of the others no detection is in reach.
            means, _, radii = moments(items)
            apart = np.sqrt(np.square(means - member.pose.position[: means.shape[1]]).sum(axis=1))
            gaps = np.abs(apart[:, None] - member.values[:, 0]).min(axis=1)
            near = gaps < GATE * unit * LEVELS[-1] + GATE * radii
            items = [item for item, kept in zip(items, near.tolist()) if kept]
            # In a large scan those that are most certain tell enough.
            most = LEARNING_PAIRS // len(member.values)
            if len(items) > max(1, most) and len(items) * len(member.values) > MANY_PAIRS:
                items.sort(key=lambda item: -item.existence)
                items = items[: max(1, most)]
        if items and len(member.values):
            logs = _log_likelihoods(member, items, clutter, unseen, unit)
            after = ((1.0 - CHANGE) * self.errors + CHANGE * PRIOR) * np.exp(logs - logs.max())
            self.errors = after / after.sum()
        return unit * float(LEVELS[self.errors.argmax()])

    def misfit(self, robot: str) -> str:
        """Return a warning if the detections of a robot do not fit, or ''.

        Where noise, positions and stillness are as believed, a sum with weights w, divided by
        d sum w, is nearly chi-squared over its degrees of freedom, d (sum w)^2 / sum w^2.
        """
        squares, expected, weights = self.fit.tolist()
        if expected <= 0.0 or excess(squares / expected, expected**2 / weights) <= BOUND:
            return ''
        return (
            f'{robot}: detections of found targets are {math.sqrt(squares / expected):.1f} '
            'times as far from where they are expected as the settings say: its noise or '
            'the errors of its positions are larger, or targets do not stand still'
        )


def _log_likelihoods(
    member: CheckedMeasurement,
    items: Sequence[Component],
    clutter: FloatArray,
    unseen: float,
    unit: float,
) -> FloatArray:
    """Return the log likelihood of a scan with each of LEVELS, in `unit`, up to a constant."""
    values, pose, model = member.values, member.pose, member.sensor.measurement
    means, covariances, _ = moments(items)
    errors = model.residual(values, model.measure(means, pose)[:, None])
    # |dx/dz| takes the density of undetected targets to measurement space.
    volume = np.abs(values[:, 0]) ** (values.shape[1] - 1)
    if values.shape[1] == 3:
        volume *= np.cos(values[:, 2])
    odds = odds_of_detection(member, items, means)[:, None] / (clutter + unseen * volume)
    variances = member.pose_error**2 + np.square(unit * LEVELS)
    logs = np.empty(len(LEVELS))
    jacobians = model.jacobian(means, pose)
    _log_sums(errors, jacobians, covariances, member.covariances, variances, odds, logs)
    return logs


def excess(ratio: float, freedom: float) -> float:
    """Return chi-squared in deviations from what is expected (Wilson and Hilferty 1931)."""
    variance = 2.0 / (9.0 * freedom)
    return (ratio ** (1.0 / 3.0) - (1.0 - variance)) / math.sqrt(variance)
