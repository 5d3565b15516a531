"""How a simulated vehicle with an autopilot moves: a double integrator with limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FlightLimits:
    """
    What a vehicle and its position controller can do.

    Attributes
    ----------
    speed, climb : float
        Largest speeds, level and up or down [m/s].
    acceleration : float
        Largest [m/s^2].
    gain : float
        Speed for each metre of way left, of the position controller [1/s].
    yaw_rate : float
        Largest [rad/s].
    buoyancy : float
        Speed at which it rises without power; below 0 it falls [m/s].

    """

    speed: float = 2.0
    climb: float = 1.0
    acceleration: float = 1.0
    gain: float = 1.0
    yaw_rate: float = 1.0
    buoyancy: float = -3.0


class FlightModel:
    """
    A vehicle in its local frame, ENU, with the ground or the surface at height 0.

    Parameters
    ----------
    limits : FlightLimits
        Of the vehicle.
    submarine : bool
        Whether it is below height 0, and not above.
    position : ndarray, shape (3,)
        At the start [m].
    yaw : float
        There, from east [rad].

    """

    def __init__(self, limits: FlightLimits, submarine: bool, position: Array, yaw: float) -> None:
        self.limits = limits
        self.submarine = submarine
        self.position = np.array(position, dtype=float)
        self.velocity = np.zeros(3)
        self.yaw = yaw
        self.yaw_rate = 0.0

    @property
    def grounded(self) -> bool:
        """Whether it stands on the ground; a submarine does not."""
        return not self.submarine and bool(self.position[2] <= 0.0)

    def fly_to(self, target: Array, yaw: float | None, dt: float) -> None:
        """Go on for `dt` seconds under the position controller, to a place and a heading."""
        error = target - self.position
        left = float(np.sqrt((error * error).sum()))
        limits = self.limits
        wish = np.zeros(3)
        if left > 0.0:
            # What can be braked in time, as the autopilots' square root controllers have it.
            reach = limits.acceleration / (limits.gain * limits.gain)
            speed = (
                limits.gain * left
                if left <= reach
                else math.sqrt(2.0 * limits.acceleration * (left - 0.5 * reach))
            )
            wish = error * (speed / left)
        self.fly(wish, dt)
        self._turn(yaw, dt)

    def fly(self, velocity: Array, dt: float) -> None:
        """Go on for `dt` seconds with a wished velocity [m/s]."""
        limits = self.limits
        wish = np.array(velocity, dtype=float)
        level = math.hypot(wish[0], wish[1])
        if level > limits.speed:
            wish[:2] *= limits.speed / level
        wish[2] = min(max(wish[2], -limits.climb), limits.climb)
        self._accelerate(wish, dt)

    def drift(self, dt: float) -> None:
        """Go on for `dt` seconds without power."""
        self._accelerate(np.array([0.0, 0.0, self.limits.buoyancy]), dt)
        self.yaw_rate = 0.0

    def _accelerate(self, wish: Array, dt: float) -> None:
        change = wish - self.velocity
        size = float(np.sqrt((change * change).sum()))
        most = self.limits.acceleration * dt
        if size > most:
            change *= most / size
        before = self.velocity
        self.velocity = before + change
        self.position = self.position + 0.5 * dt * (before + self.velocity)
        beyond = self.position[2] > 0.0 if self.submarine else self.position[2] < 0.0
        if beyond:
            self.position[2] = 0.0
            self.velocity = self.velocity * (0.0 if not self.submarine else np.array([1, 1, 0]))

    def _turn(self, yaw: float | None, dt: float) -> None:
        self.yaw_rate = 0.0
        if yaw is not None:
            left = math.atan2(math.sin(yaw - self.yaw), math.cos(yaw - self.yaw))
            most = self.limits.yaw_rate * dt
            step = min(max(left, -most), most)
            self.yaw += step
            self.yaw_rate = step / dt
