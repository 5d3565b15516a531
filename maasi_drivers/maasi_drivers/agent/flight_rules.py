"""What a flying robot may do: take off when permitted, and fly inside a geofence. Without ROS."""

import math

import numpy as np

from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.settings.vehicles import FlightSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.operating_volume import OperatingVolume
from maasi_planner.settings import RobotModel

UNTIL_ARM = 'until the service arm is called'  # reason in `state` while a vehicle waits for it


class ArmPermission:
    """Whether a vehicle may take off: one take-off for each call of the service.

    Times are of the steady clock [s].
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._end = -math.inf

    def ask(self, now: float, problem: str) -> str:
        """Give it where there is no problem, else end it; return the problem."""
        self._end = -math.inf if problem else now + self.timeout
        return problem

    def end(self) -> None:
        """End it, as after a take-off."""
        self._end = -math.inf

    def holds(self, now: float) -> bool:
        """Return whether there is one."""
        return now < self._end

    def expired(self, now: float) -> bool:
        """Return whether one has just expired."""
        over = -math.inf < self._end <= now
        if over:
            self.end()
        return over


# At a charger its charge rises at least by this in the time after which it lands otherwise [1].
_RISE = 0.005


class HomeLanding:
    """Whether a vehicle that was sent to a charger lands there, as its charge does not rise.

    Times are of the steady clock [s].
    """

    def __init__(self, settings: DriverSettings, timeout: float) -> None:
        self._chargers = np.array(settings.chargers or [settings.start])
        self._reach = 2.0 * settings.motion.tolerance + settings.radius
        self._timeout = timeout
        # Whether it had a goal: after a take-off it waits for one.
        self._sent = False
        self._since = self._least = math.inf

    def leave(self) -> None:
        """Note a goal."""
        self._sent = True
        self._since, self._least = math.inf, math.inf

    def judge(self, position: FloatArray, charge: float, now: float) -> str:
        """Return why a vehicle without a goal lands, or nothing; an unknown charge is below 0."""
        gaps = np.linalg.norm(self._chargers[:, :2] - position[:2], axis=1)
        if not (self._sent and self._timeout and charge >= 0.0 and gaps.min() <= self._reach):
            self._since = self._least = math.inf
            return ''
        if self._since == math.inf or charge >= self._least + _RISE:
            self._since, self._least = now, charge
        self._least = min(self._least, charge)
        if now - self._since < self._timeout:
            return ''
        self._sent = False
        return f'as its charge, {charge:.2f}, does not rise at home'


_HEIGHT = 1.0  # between the heights of start and ground and the geofence, where none is given [m]


def flight_volume(area: Area, robot: RobotModel, flight: FlightSettings) -> OperatingVolume:
    """Return where a robot may fly.

    Without a geofence the limits are the bounds with the radius; in the plane from 1 m below the
    lower to 1 m above the higher one of ground and start. What starts above the ground is not sent
    below it.
    """
    if flight.geofence is not None:
        return OperatingVolume(area, robot.radius, np.array(flight.geofence))
    ground, start, radius = flight.ground, robot.start[2], robot.radius
    limits = np.zeros((3, 2))
    limits[2] = min(ground, start) - _HEIGHT, max(ground, start) + _HEIGHT
    limits[: area.dimension] = area.bounds + np.array([-radius, radius])
    if start > ground:
        limits[2, 0] = max(limits[2, 0], ground)
    return OperatingVolume(area, radius, limits)
