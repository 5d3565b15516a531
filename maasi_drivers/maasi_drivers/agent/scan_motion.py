"""A ground robot's laser scan in the map, and obstacle avoidance by a dynamic window. No ROS."""

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.settings.driver import ScanSettings
from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_planner.guidance import head_for
from maasi_planner.motion import RobotState, Unicycle
from maasi_planner.motion.base import check_waypoint
from maasi_planner.motion.unicycle import window_command
from maasi_planner.obstacles import all_felt, is_clear
from maasi_planner.settings import MotionSettings

_CELL = 0.03  # cell size within which points count as one [m]
_HEADINGS = 72  # number of headings to try where the straight path is blocked
_STEADINESS = 0.3  # cost of a heading change relative to that of a detour [1/rad]
_SKIN = 1e-3  # below this distance the robot touches the point but may leave it [m]


def scan_points(
    ranges: ArrayLike,
    angles: tuple[float, float],
    limits: tuple[float, float],
    seconds_per_beam: float,
    placed: StampedPose,
    mount: ArrayLike,
) -> FloatArray:
    """Return the end points of a scan's beams, (n, 2) in the map [m]."""
    distances = np.asarray(ranges, dtype=float)
    names = ('angle_min', 'angle_increment', 'range_min', 'range_max', 'time_increment')
    for name, value in zip(names, (*angles, *limits, seconds_per_beam), strict=True):
        if not math.isfinite(value):
            raise ValueError(f'{name}: read {value}, allowed are finite numbers')
    if not len(distances):
        raise ValueError('ranges: read none, allowed is at least one')
    beams = np.flatnonzero(
        np.isfinite(distances) & (distances >= limits[0]) & (distances <= limits[1])
    )
    x, y, turned = (float(value) for value in np.asarray(mount, dtype=float))
    times = seconds_per_beam * beams
    heading = placed.pose.yaw + placed.angular_velocity[2] * times
    cosine, sine = np.cos(heading), np.sin(heading)
    bearing = heading + turned + angles[0] + angles[1] * beams
    hit = distances[beams]
    origin, velocity = placed.pose.position, placed.velocity
    return np.stack(
        [
            origin[0] + velocity[0] * times + cosine * x - sine * y + hit * np.cos(bearing),
            origin[1] + velocity[1] * times + sine * x + cosine * y + hit * np.sin(bearing),
        ],
        axis=1,
    )


@njit(cache=True)
def _is_free(x: float, y: float, heading: float, reach: float, circles: FloatArray) -> bool:
    end_x = x + reach * math.cos(heading)
    end_y = y + reach * math.sin(heading)
    return is_clear((x, y, 0.0), (end_x, end_y, 0.0), all_felt(circles), 0.0, False)


@njit(cache=True)
def path_around(
    x: float,
    y: float,
    target_x: float,
    target_y: float,
    circles: FloatArray,
    reach: float,
    before: float,
) -> tuple[float, float, float]:
    """Return a free point towards the target, at most `reach` away [m], and its heading.

    Prefers headings near the straight path and the last choice; returns the target itself if
    the straight path is free or no heading is.
    """
    dx = target_x - x
    dy = target_y - y
    away = math.hypot(dx, dy)
    straight = math.atan2(dy, dx)
    for part in (1.0, 0.5):
        if _is_free(x, y, straight, part * min(away, reach), circles):
            return target_x, target_y, straight
        # Other headings over the full distance, even if the target is closer.
        look = part * reach
        best = np.inf
        chosen = np.nan
        for i in range(1, _HEADINGS):
            turn = 2.0 * math.pi * i / _HEADINGS
            if turn > math.pi:
                turn -= 2.0 * math.pi
            heading = straight + turn
            cost = abs(turn)
            if before == before:
                change = heading - before
                change -= 2.0 * math.pi * math.floor((change + math.pi) / (2.0 * math.pi))
                cost += _STEADINESS * abs(change)
            if cost < best and _is_free(x, y, heading, look, circles):
                best = cost
                chosen = heading
        if best < np.inf:
            return x + look * math.cos(chosen), y + look * math.sin(chosen), chosen
    return target_x, target_y, np.nan


class ScanUnicycle(Unicycle):
    """Plans around known obstacles and avoids those that the scanner sees."""

    def __init__(
        self, settings: MotionSettings, area: Area, radius: float, scan: ScanSettings
    ) -> None:
        super().__init__(settings, area, radius)
        self.scan = scan
        self.points = np.zeros((0, 2))
        self._heading = math.nan

    def see(self, points: ArrayLike) -> None:
        """Replace the scan points (n, 2) in the map [m]."""
        array = np.asarray(points, dtype=float).reshape(-1, 2)
        _, first = np.unique(np.floor(array / _CELL), axis=0, return_index=True)
        self.points = array[np.sort(first)]

    def command(self, state: RobotState, waypoint: ArrayLike) -> FloatArray:
        """See `MotionModel.command`."""
        here = self._to_array(state)
        x, y = here[:2].tolist()
        away = np.hypot(self.points[:, 0] - x, self.points[:, 1] - y)
        near = away <= self.scan.reach + self.keep_out.radius
        if not near.any():
            self._heading = math.nan
            return super().command(state, waypoint)
        goal = tuple(check_waypoint(waypoint).tolist())
        here_at, around = (x, y, goal[2]), self.keep_out.around
        target, left, _, _ = head_for(here_at, goal, self.table(goal), around, -1)
        seen = np.zeros((int(near.sum()), 7))
        seen[:, :2] = self.points[near]
        seen[:, 3] = np.minimum(
            self.keep_out.radius + 0.5 * self.keep_out.clearance, away[near] - _SKIN
        )
        circles = np.concatenate([self.keep_out.circles, seen])
        target_x, target_y, self._heading = path_around(
            x, y, target[0], target[1], circles, self.scan.reach, self._heading
        )
        target, clearance = (target_x, target_y, 0.0), self.keep_out.clearance
        forward, turn = window_command(
            here, target, left, self.steering, all_felt(circles), clearance
        )
        return np.array([forward, 0.0, 0.0, turn])
