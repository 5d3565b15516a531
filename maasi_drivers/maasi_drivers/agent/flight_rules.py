"""Rules for flying robots: take-off permission, landing at a charger, geofence. Without ROS."""

import math

import numpy as np

from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.settings.vehicles import FlightSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.operating_volume import OperatingVolume
from maasi_planner.motion import MotionModel
from maasi_planner.settings import RobotModel
from maasi_planner.terrain_frame import least_height

UNTIL_ARM = (
    'until the service arm is called'  # reason in `state` while a vehicle waits for permission
)


class ArmPermission:
    """Permission for one take-off per call of the service; times: steady clock [s]."""

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._end = -math.inf

    def ask(self, now: float, problem: str) -> str:
        """Grant it if there is no problem, else end it; return the problem."""
        self._end = -math.inf if problem else now + self.timeout
        return problem

    def end(self) -> None:
        """End it, for example after a take-off."""
        self._end = -math.inf

    def holds(self, now: float) -> bool:
        """Return whether permission is granted."""
        return now < self._end

    def expired(self, now: float) -> bool:
        """Return whether permission has just expired."""
        over = -math.inf < self._end <= now
        if over:
            self.end()
        return over


# At a charger the charge rises at least by this in the time before the vehicle lands [1].
_RISE = 0.005


class HomeLanding:
    """Lands a vehicle at a charger if its charge does not rise; times: steady clock [s]."""

    def __init__(self, settings: DriverSettings, timeout: float) -> None:
        self._chargers = np.array(settings.chargers or [settings.start])
        self._reach = 2.0 * settings.motion.tolerance + settings.radius
        self._timeout = timeout
        # Whether it has had a goal since take-off.
        self._sent = False
        self._since = self._least = math.inf

    def on_new_goal(self) -> None:
        """Note a goal."""
        self._sent = True
        self._since, self._least = math.inf, math.inf

    def check(self, position: FloatArray, charge: float, now: float) -> str:
        """Return why a vehicle without a goal lands, or nothing; an unknown charge is negative."""
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
        return f'battery not charging at home ({100.0 * charge:.0f} %)'


_HEIGHT = 1.0  # default margin of the geofence below and above the heights of start and ground [m]


def flight_volume(area: Area, robot: RobotModel, flight: FlightSettings) -> OperatingVolume:
    """Return the volume where a robot may fly.

    Default: the bounds extended by the radius, in 2D from 1 m below the lower to 1 m above the
    higher of ground and start. A robot that starts above the ground is not sent below it. Over
    terrain, which are heights above ground, not below radius and clearance; and higher by the
    terrain's range of heights, as it climbs before it is over a hill.
    """
    if flight.geofence is not None:
        return OperatingVolume(area, robot.radius, np.array(flight.geofence))
    ground, start, radius = flight.ground, robot.start[2], robot.radius
    limits = np.zeros((3, 2))
    limits[2] = min(ground, start) - _HEIGHT, max(ground, start) + _HEIGHT
    limits[: area.dimension] = area.bounds + np.array([-radius, radius])
    if start > ground:
        limits[2, 0] = max(limits[2, 0], ground)
    if area.terrain is not None:
        limits[2, 0] = max(limits[2, 0], ground + least_height(robot))
        limits[2, 1] += area.terrain.surface.highest - area.terrain.surface.lowest
    return OperatingVolume(area, radius, limits)


def free_length(
    motion: MotionModel, position: FloatArray, direction: FloatArray, longest: float
) -> float:
    """Return the length of a straight path, at most `longest` [m], that is clear of all zones."""
    keep_out = motion.keep_out
    if not len(keep_out) or longest <= 0.0:
        return longest
    # No zone is thinner, as the robot's radius surrounds it.
    step = longest / math.ceil(longest / max(keep_out.radius, 0.1))
    free = 0.0
    while free < longest - 1e-6 and keep_out.is_free(position + (free + step) * direction):
        free += step
    return free
