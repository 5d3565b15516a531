"""What the scans of each robot have told of it: clutter, noise, errors, and whether they fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.models.sensor import LEAST_PER_SCAN
from maasi_filter.pmb.component import Component
from maasi_filter.pmb.position_error import PositionErrors

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
