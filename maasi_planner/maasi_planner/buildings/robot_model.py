"""A robot of 004: dynamics (1), (2), hazard of its battery (3), and rewards (11) to (14)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_planner.buildings.settings import DynamicsSettings


@dataclass(frozen=True)
class Dynamics:
    """The three independent axes of (1).

    `retained` is phi = 1 - eta; `force` [N] and `speed` [m/s] are the largest on each axis, `step`
    is dT [s].
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


@dataclass(frozen=True)
class Hazard:
    """Probability p_b that a battery fails at a step, t steps after it was charged: (3)."""

    alpha: float
    beta: float
    failures: bool = True

    def __call__(self, steps: float) -> float:
        """Return p_b(t) [1]."""
        if not self.failures:
            return 0.0
        exponent = min(max(-self.beta * (steps - self.alpha), -700.0), 700.0)
        return 1.0 / (1.0 + self.alpha * math.exp(exponent))


@dataclass(frozen=True)
class HeardPlan:
    """Plan of another robot of the previous step, as received.

    visits: tau by cuboid: steps from now until the visit; flight_steps: t_Fl, since its last
    recharge; hazard: failure hazard of its battery.
    """

    visits: Mapping[int, int]
    flight_steps: int
    hazard: Hazard


def rewards(
    number: int,
    own_steps: int,
    horizon: int,
    hazard: Hazard,
    heard: Sequence[HeardPlan],
    alpha: float,
    beta: float,
    condition: Literal['low_hazard', 'printed'],
    rng: np.random.Generator,
) -> BoolArray:
    """Draw r(n) for all cuboids, (number,): (11) to (14).

    Always takes one draw per cuboid from `rng`, so that the sequence does not depend on the plans.
    """
    draws = rng.random(number)
    result = np.ones(number, dtype=bool)
    own = hazard(own_steps + horizon)
    for n in sorted({n for plan in heard for n in plan.visits}):
        product, expected = 1.0, 0.0
        for plan in heard:
            if n in plan.visits:
                fails = plan.hazard(plan.flight_steps + plan.visits[n] - 1)  # (11)
                product *= fails
                expected += 1.0 - fails
        missed = (1.0 - own) * product  # (12)
        holds = own <= 0.5 if condition == 'low_hazard' else own > 0.5
        joins = 1.0 - 1.0 / (1.0 + alpha * math.exp(-beta * (expected - alpha))) if holds else 0.0
        result[n] = draws[n] < max(missed, joins)  # (13), (14)
    return result
