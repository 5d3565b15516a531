"""A simulated sensor of range, bearing and elevation with misses, noise and clutter."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from maasi_filter.models.measurement import wrap_angle
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_sim.world.noise_streams import noise_stream

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


class RangingSensor:
    """
    A robot's ranging sensor (000, eq. (3) to (9)).

    Parameters
    ----------
    sensor : Sensor
        pi, g, R and clutter; the true ones.
    targets : ndarray, shape (n, 3) or (n, 2)
        True positions [m, map].
    seed : int
        Of the run.
    robot : str
        Name of the robot; with seed and step it keys the random numbers.
    reach : float
        Largest range of clutter [m].

    """

    def __init__(
        self, sensor: Sensor, targets: Array, seed: int, robot: str, reach: float = 0.0
    ) -> None:
        self.sensor = sensor
        self.targets = np.asarray(targets, dtype=float)
        self.seed = seed
        self.robot = robot
        self.reach = min(reach, sensor.maximum_range)
        self._spread = np.linalg.cholesky(sensor.covariance)

    def measure(
        self, pose: Pose, step: int, targets: Array | None = None
    ) -> tuple[Array, IntArray]:
        """
        Return one sweep, and which target caused each return.

        Parameters
        ----------
        pose : Pose
            True pose of the robot.
        step : int
            Discrete step.
        targets : ndarray, shape (n, 3) or (n, 2), optional
            Present positions, if the targets have moved [m, map].

        Returns
        -------
        values : ndarray, shape (m, d)
            Range [m], bearing from the map's x axis and, in 3D, elevation [rad], in random order.
        causes : ndarray of int, shape (m,)
            Index of the target; -1: clutter.
        """
        dimension = self.sensor.dimension
        generator = noise_stream(self.seed, self.robot, step, 'ranging')
        count = len(self.targets)
        # The number of draws does not depend on detections: targets do not affect each other.
        chance = generator.random(count)
        noise = generator.standard_normal((count, dimension))
        positions = (self.targets if targets is None else targets)[:, :dimension]
        values = self.sensor.measurement.measure(positions, pose)
        seen = chance < self.sensor.detection.probability(positions, pose)
        seen &= values[:, 0] <= self.sensor.maximum_range
        # Summed in a fixed order: the result must not depend on the linear algebra library.
        errors = np.zeros((count, dimension))
        for column in range(dimension):
            errors += noise[:, column, None] * self._spread[:, column]
        returns, causes = (values + errors)[seen], np.flatnonzero(seen)
        if self.sensor.clutter > 0.0 and self.reach > 0.0:
            clutter = self._clutter(generator, dimension)
            returns = np.concatenate([returns, clutter])
            causes = np.concatenate([causes, np.full(len(clutter), -1)])
        order = generator.permutation(len(returns))
        returns, causes = returns[order], causes[order]
        returns[:, 0] = np.maximum(returns[:, 0], 1e-6)
        returns[:, 1] = wrap_angle(returns[:, 1])
        if dimension == 3:
            returns[:, 2] = np.clip(returns[:, 2], -0.5 * math.pi, 0.5 * math.pi)
        return returns, causes

    def _clutter(self, generator: np.random.Generator, dimension: int) -> Array:
        """Draw false returns, uniform in range and angles."""
        low = np.array([0.0, -math.pi, -0.5 * math.pi][:dimension])
        high = np.array([self.reach, math.pi, 0.5 * math.pi][:dimension])
        count = generator.poisson(self.sensor.clutter * float(np.prod(high - low)))
        return generator.uniform(low, high, size=(count, dimension))
