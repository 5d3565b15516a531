"""Dynamics of a mass point: 004, (1) and (2)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_planner.buildings.settings import DynamicsSettings


class Dynamics:
    """The three independent axes of (1), sampled every `step` seconds.

    `retained` is phi = 1 - eta, `weight` is u_g (3,) [N], and `deceleration` (2, 3) is the largest
    loss of speed per step beyond air resistance, upwards and downwards [m/s].
    """

    def __init__(self, settings: DynamicsSettings | None = None, step: float = 1.0) -> None:
        settings = settings or DynamicsSettings()
        self.mass = settings.mass
        self.retained = 1.0 - settings.resistance
        self.force = settings.force
        self.speed = settings.speed
        self.step = step
        self.weight = np.array([0.0, 0.0, settings.mass * settings.gravity])
        self.deceleration = (
            step / self.mass * np.stack([self.force + self.weight, self.force - self.weight])
        )

    def next(
        self, position: ArrayLike, velocity: ArrayLike, control: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Return position [m] and velocity [m/s] after a step under a force (3,) [N]: (1)."""
        speed = np.asarray(velocity, dtype=float)
        push = np.asarray(control, dtype=float) - self.weight
        return (
            np.asarray(position, dtype=float) + self.step * speed,
            self.retained * speed + self.step / self.mass * push,
        )

    def fly(
        self,
        position: FloatArray,
        velocity: FloatArray,
        controls: Sequence[FloatArray] | FloatArray,
        steps: int,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return positions and velocities (steps + 1, 3), and forces: given ones, then braking."""
        positions, velocities, used = [position], [velocity], []
        for k in range(steps):
            brakes = k >= len(controls)
            used.append(self.control_for(velocities[-1], np.zeros(3)) if brakes else controls[k])
            point, speed = self.next(positions[-1], velocities[-1], used[-1])
            positions.append(point)
            velocities.append(speed)
        return np.array(positions), np.array(velocities), np.array(used)

    def control_for(self, velocity: ArrayLike, wanted: ArrayLike) -> FloatArray:
        """Return the feasible force (3,) [N] for the velocity closest to the wanted one."""
        change = np.asarray(wanted, dtype=float) - self.retained * np.asarray(velocity, dtype=float)
        return np.clip(self.mass / self.step * change + self.weight, -self.force, self.force)

    def braking_steps(self) -> int:
        """Return the largest number of steps until the robot is at rest on all axes."""
        speed, steps = np.full((2, 3), self.speed), 0
        while (speed > 0.0).any():
            speed = self.retained * speed - self.deceleration
            steps += 1
        return steps

    def rolling_distances(self, steps: int) -> FloatArray:
        """Return the distance [m] after each step of braking from 1 m/s by air resistance."""
        return self.step * np.cumsum(self.retained ** np.arange(steps))

    def distance_reductions(self, steps: int) -> FloatArray:
        """Return the reduction of these distances by full force, up and down, (2, 3, steps)."""
        lost = np.zeros((2, 3))
        distances = np.zeros((2, 3, steps))
        for j in range(1, steps):
            lost = self.retained * lost + self.deceleration
            distances[:, :, j] = distances[:, :, j - 1] + self.step * lost
        return distances
