"""How much larger the noise of a robot's detections is than believed, learnt from innovations."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.measurement_check import CheckedMeasurement

# Detections that the belief is worth.
PRIOR_DETECTIONS = 6.0
# The factor of the variance stays within these.
LEAST_FACTOR = 0.2
MOST_FACTOR = 10.0


class Innovations(NamedTuple):
    """Detections minus what n targets lead to expect.

    Parameters
    ----------
    errors : (n, m, d) array
        e: metres and radians.
    jacobians : (n, d, d) array
        H, at the targets.
    covariances : (n, m, d, d) array
        H P H' + R, of the errors; P includes the position error of the robot.
    squares : (n, m) array
        Squared normalised errors.
    """

    errors: FloatArray
    jacobians: FloatArray
    covariances: FloatArray
    squares: FloatArray


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
