"""How much larger the noise of a robot's detections is than believed, learnt from innovations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maasi_filter.measurement_check import CheckedMeasurement

FloatArray = NDArray[np.float64]

# Detections that the belief is worth.
PRIOR_DETECTIONS = 6.0
# The factor of the variance stays within these.
LEAST_FACTOR = 0.2
MOST_FACTOR = 10.0


def squared_innovation(
    member: CheckedMeasurement, j: int, mean: FloatArray, covariance: FloatArray
) -> float:
    """Return e' (H P H' + R)^-1 e / d of detection j and a target known to (mean, covariance).

    R is the believed one. Its expectation is the variance's factor where R outweighs H P H', and
    nearer to 1 where it does not: what is learnt is too little rather than too much.

    Parameters
    ----------
    member : CheckedMeasurement
        The robot's detections.
    mean, covariance : (d,), (d, d) arrays
        Of the target before the scan, metres.
    """
    model, pose = member.sensor.measurement, member.pose
    error = model.residual(member.values[j], model.measure(mean[None], pose)[0])
    jacobian = model.jacobian(mean[None], pose)[0]
    position = covariance + member.pose_error**2 * np.eye(len(mean))
    total = jacobian @ position @ jacobian.T + member.covariances[j]
    return float(error @ np.linalg.solve(total, error)) / len(mean)


class NoiseScale:
    """Factor of the variances of each robot's detections, with a prior of mean 1.

    Attributes
    ----------
    detections, squares : dict
        By robot: expected number of detections of found targets, and the sum of their squared
        normalised innovations, each divided by the dimension.
    """

    def __init__(self) -> None:
        self.detections: dict[str, float] = {}
        self.squares: dict[str, float] = {}

    def factor(self, robot: str) -> float:
        """Return the posterior mean of a robot's factor."""
        squares = PRIOR_DETECTIONS + self.squares.get(robot, 0.0)
        mean = squares / (PRIOR_DETECTIONS + self.detections.get(robot, 0.0))
        return float(np.clip(mean, LEAST_FACTOR, MOST_FACTOR))

    def count(self, robot: str, probability: float, square: float) -> None:
        """Count a detection that a found target caused with this probability."""
        self.detections[robot] = self.detections.get(robot, 0.0) + probability
        self.squares[robot] = self.squares.get(robot, 0.0) + probability * square
