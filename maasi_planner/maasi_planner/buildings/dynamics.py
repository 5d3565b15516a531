"""Mass point with air resistance under bounded forces: 004, (1), (2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_planner.buildings.settings import DynamicsSettings


@dataclass(frozen=True)
class Dynamics:
    """The three independent axes of (1).

    Parameters
    ----------
    mass : float
        m [kg].
    retained : float
        phi = 1 - eta, share of the velocity that remains after a step [1].
    force : float
        Largest force on each axis [N].
    speed : float
        Largest speed on each axis [m/s].
    gravity : float
        g [m/s^2].
    step : float
        Sampling interval dT [s].

    Raises
    ------
    ValueError
        If a number is out of its range, or the robot cannot lift its own weight.
    """

    mass: float = 3.35
    retained: float = 0.8
    force: float = 35.0
    speed: float = 15.0
    gravity: float = 9.81
    step: float = 1.0

    def __post_init__(self) -> None:
        for name in ('mass', 'force', 'speed', 'step'):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f'{name}: got {value}, allowed are numbers above 0')
        if not 0.0 < self.retained <= 1.0:
            raise ValueError(f'retained: got {self.retained}, allowed is above 0 to 1')
        if not (np.isfinite(self.gravity) and self.gravity >= 0.0):
            raise ValueError(f'gravity: got {self.gravity}, allowed are numbers from 0')
        if self.mass * self.gravity >= self.force:
            raise ValueError(
                f'force: got {self.force} N, which cannot lift the weight of the robot, '
                f'{self.mass:g} kg x {self.gravity:g} m/s^2 = {self.mass * self.gravity:.2f} N; '
                'allowed is more than that'
            )

    @classmethod
    def from_settings(cls, settings: DynamicsSettings, step: float) -> Dynamics:
        """Return the dynamics of settings, sampled every `step` seconds."""
        return cls(
            settings.mass,
            1.0 - settings.resistance,
            settings.force,
            settings.speed,
            settings.gravity,
            step,
        )

    @property
    def weight(self) -> FloatArray:
        """u_g, (3,) [N]."""
        return np.array([0.0, 0.0, self.mass * self.gravity])

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

    def control_for(self, velocity: ArrayLike, wanted: ArrayLike) -> FloatArray:
        """Return the force (3,) [N] within its bounds that gets closest to a wanted velocity."""
        change = np.asarray(wanted, dtype=float) - self.retained * np.asarray(velocity, dtype=float)
        return np.clip(self.mass / self.step * change + self.weight, -self.force, self.force)

    def braking(self, velocity: ArrayLike) -> FloatArray:
        """Return the force (3,) [N] that stops the robot as fast as its bounds allow."""
        return self.control_for(velocity, np.zeros(3))

    def deceleration(self, axis: int) -> tuple[float, float]:
        """Return the largest deceleration per step beyond air resistance: up, down [m/s]."""
        weight = float(self.weight[axis])
        return (
            self.step / self.mass * (self.force + weight),
            self.step / self.mass * (self.force - weight),
        )

    def braking_steps(self) -> int:
        """Return the largest number of steps until the robot is at rest on all axes."""
        most = 0
        for axis in range(3):
            for loss in self.deceleration(axis):
                speed, steps = self.speed, 0
                while speed > 0.0:
                    speed = self.retained * speed - loss
                    steps += 1
                most = max(most, steps)
        return most
