"""How a vehicle moves under the position controller of its autopilot."""

import math
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.arrays import FloatArray

# Speed for each metre that remains, of the position controller [1/s]; largest yaw rate [rad/s].
_GAIN, _YAW_RATE = 1.0, 1.0
_FALL, _BUOYANCY = -3.0, 0.1  # speed without power: a submarine rises [m/s]


@dataclass(eq=False)
class FlightModel:
    """A vehicle in its local frame, ENU, above a surface at height 0 [m, m/s, m/s^2]."""

    position: FloatArray
    yaw: float = 0.0
    submarine: bool = False
    speed: float = 2.0
    acceleration: float = 1.0
    climb: float = 1.0
    yaw_rate: float = 0.0
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def grounded(self) -> bool:
        """Whether it stands on the ground; a submarine does not."""
        return not self.submarine and bool(self.position[2] <= 0.0)

    def fly_to(self, target: FloatArray, yaw: float | None, dt: float) -> None:
        """Go on for `dt` seconds under the position controller, to a place and a heading."""
        error = target - self.position
        left = float(np.linalg.norm(error))
        # What can be braked in time, as the autopilots' square root controllers have it.
        reach = self.acceleration / _GAIN**2
        beyond = math.sqrt(2.0 * self.acceleration * max(left - 0.5 * reach, 0.0))
        speed = _GAIN * left if left <= reach else beyond
        self.fly(error * (speed / left if left else 0.0), dt)
        self.turn(yaw, dt)

    def turn(self, yaw: float | None, dt: float) -> None:
        """Turn towards a heading for `dt` seconds; without one it keeps its own."""
        self.yaw_rate = 0.0
        if yaw is not None:
            turn = math.atan2(math.sin(yaw - self.yaw), math.cos(yaw - self.yaw))
            self.yaw_rate = min(max(turn / dt, -_YAW_RATE), _YAW_RATE)
            self.yaw += self.yaw_rate * dt

    def fly(self, velocity: FloatArray, dt: float) -> None:
        """Go on for `dt` seconds with a wished velocity [m/s]."""
        wish = np.array(velocity, dtype=float)
        wish[:2] *= min(1.0, self.speed / max(math.hypot(wish[0], wish[1]), 1e-9))
        wish[2] = min(max(wish[2], -self.climb), self.climb)
        self._accelerate(wish, dt)

    def drift(self, dt: float) -> None:
        """Go on for `dt` seconds without power."""
        self._accelerate(np.array([0.0, 0.0, _BUOYANCY if self.submarine else _FALL]), dt)
        self.yaw_rate = 0.0

    def _accelerate(self, wish: FloatArray, dt: float) -> None:
        change = wish - self.velocity
        change *= min(1.0, self.acceleration * dt / max(float(np.linalg.norm(change)), 1e-9))
        before = self.velocity
        self.velocity = before + change
        self.position = self.position + 0.5 * dt * (before + self.velocity)
        if self.position[2] > 0.0 if self.submarine else self.position[2] < 0.0:
            self.position[2] = 0.0
            self.velocity = self.velocity * ([1.0, 1.0, 0.0] if self.submarine else 0.0)
