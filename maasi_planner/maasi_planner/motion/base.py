"""Interface of the motion models: prediction, controller and body."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from pydantic import BaseModel

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose
from maasi_planner.keep_out import shared_keep_out
from maasi_planner.settings import MotionSettings

STEPS_LIMIT = 20_000


@dataclass
class RobotState:
    """State of a robot in a form that every model supports.

    Parameters
    ----------
    pose : Pose
        Pose in frame `map`.
    velocity : (3,) array
        Velocity, m/s, axes of `map`.
    angular_velocity : (3,) array
        Angular velocity, rad/s, body axes.

    Raises
    ------
    ValueError
        If a number is not finite.
    """

    pose: Pose
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))
    angular_velocity: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        for name in ('velocity', 'angular_velocity'):
            value = np.array(getattr(self, name), dtype=float)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ValueError(f'{name}: got {value.tolist()}, allowed are three finite numbers')
            setattr(self, name, value)

    @classmethod
    def at_rest(cls, position: ArrayLike, yaw: float = 0.0) -> RobotState:
        """Return a state at rest at `position` [m, map] with heading `yaw` [rad]."""
        return cls(Pose.from_yaw(position, yaw))


@dataclass
class Trajectories:
    """Predicted trajectories to W waypoints.

    Attributes
    ----------
    positions : (W, Kmax + 1, 3) array
        Metres, frame `map`, one per step, from the present state (column 0). Shorter trajectories
        repeat their last position.
    yaws : (W, Kmax + 1) array
        Headings, radians.
    lengths : (W,) integer array
        K, steps until the waypoint is reached; 0 if the robot is already there.
    control_cost : (W,) array
        C, sum of squared inputs (000, eq. (18), (28)).
    reached : (W,) array of bool
        Whether the waypoint can be reached.
    """

    positions: FloatArray
    yaws: FloatArray
    lengths: IntArray
    control_cost: FloatArray
    reached: BoolArray

    def distances(self) -> FloatArray:
        """Return the length of each trajectory in metres, (W,)."""
        moves = np.diff(self.positions, axis=1)
        return np.sqrt((moves * moves).sum(axis=2)).sum(axis=1)


class Body(ABC):
    """A robot's body under velocity commands, which the simulator steps."""

    @abstractmethod
    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """Advance by `dt` seconds.

        Parameters
        ----------
        velocity_command : (4,) array
            vx, vy, vz [m/s, body axes rotated only by the heading] and yaw rate [rad/s], constant
            during `dt`. The body applies its limits.
        dt : float
            Seconds.
        """

    @abstractmethod
    def robot_state(self) -> RobotState:
        """Return the state that a driver measures."""


class MotionModel(ABC):
    """A robot's controller and its prediction.

    Prediction, driver and simulator share one closed loop: the driver sends `command`, `body`
    receives it, and `predict` runs both.

    Parameters
    ----------
    settings : MotionSettings
        Limits and controller.
    area : Area, optional
        Area of the robot; default: unlimited.
    radius : float
        Radius of the robot, metres, by which obstacles are inflated.

    Attributes
    ----------
    rate : float
        Speed per remaining distance near the waypoint [1/s].
    Settings : type or None
        Model of a plugin's own settings, of which `settings.settings` is an instance.
    """

    rate: float = 1.0
    Settings: ClassVar[type[BaseModel] | None] = None

    def __init__(
        self, settings: MotionSettings, area: Area | None = None, radius: float = 0.0
    ) -> None:
        self.settings = settings
        self.adopt_area(area, radius)

    def adopt_area(self, area: Area | None, radius: float) -> None:
        """Set the area, also while the robot moves."""
        self.keep_out = shared_keep_out(area, radius, self.settings.clearance, self.reach())
        self.table = self.keep_out.table

    def reach(self) -> float:
        """Return the distance at which an obstacle can influence the controller [m]."""
        return math.inf

    def predict(self, state: RobotState, waypoints: ArrayLike, step: float) -> Trajectories:
        """Return the trajectory to each waypoint under this controller.

        Parameters
        ----------
        state : RobotState
            Present state.
        waypoints : (W, 3) array
            Waypoints, metres, frame `map`.
        step : float
            Seconds between positions, and between commands.
        """
        goals = check_waypoints(waypoints)
        dt = check_step(step)
        limit = self.steps_limit(state, goals, dt)
        number = len(goals)
        out = Trajectories(
            np.empty((number, limit + 1, 3)),
            np.empty((number, limit + 1)),
            np.empty(number, np.int64),
            np.empty(number),
            np.zeros(number, dtype=bool),
        )
        self.roll_out(state, goals, dt, out)
        longest = _trim(out.positions, out.yaws, out.lengths, out.reached)
        out.positions = out.positions[:, : longest + 1]
        out.yaws = out.yaws[:, : longest + 1]
        return out

    def roll_out(
        self, state: RobotState, waypoints: FloatArray, step: float, out: Trajectories
    ) -> None:
        """Run controller and body to each waypoint, and fill `out`.

        Rows are filled up to the length of each trajectory. A trajectory that does not arrive gets
        a length beyond the last column, or minus the number of filled columns. Models of the suite
        override this by compiled loops; this one calls `command` and `body`, with about ten
        microseconds per step.

        Parameters
        ----------
        state : RobotState
            Present state.
        waypoints : (W, 3) array
            Waypoints [m, map].
        step : float
            Time between two columns of `out` [s].
        out : Trajectories
            Arrays to fill, without values.
        """
        limit = out.positions.shape[1] - 1
        for w, waypoint in enumerate(waypoints):
            body, now = self.body(state), state
            cost, k = 0.0, 0
            while True:
                out.positions[w, k] = now.pose.position
                out.yaws[w, k] = now.pose.yaw
                if k == limit or self.arrived(now.pose.position, waypoint):
                    break
                command = self.command(now, waypoint)
                body.step(command, step)
                now = body.robot_state()
                cost += float(command @ command)
                k += 1
            out.lengths[w] = k if self.arrived(now.pose.position, waypoint) else limit + 1
            out.control_cost[w] = cost

    @abstractmethod
    def command(self, state: RobotState, waypoint: ArrayLike) -> FloatArray:
        """Return the velocity command towards a waypoint.

        Parameters
        ----------
        state : RobotState
            Present state.
        waypoint : (3,) array
            Waypoint [m, map].

        Returns
        -------
        (4,) array
            vx, vy, vz [m/s, body axes rotated only by the heading] and yaw rate [rad/s].
        """

    @abstractmethod
    def body(self, state: RobotState) -> Body:
        """Return a body of this robot, for prediction and simulation.

        Parameters
        ----------
        state : RobotState
            Where it starts.
        """

    def arrived(self, position: ArrayLike, waypoint: ArrayLike) -> bool:
        """Return whether `position` is within the tolerance of `waypoint`, both (3,)."""
        tolerance = self.settings.tolerance
        return self.squared_distance(position, waypoint) <= tolerance * tolerance

    def squared_distance(self, position: ArrayLike, waypoint: ArrayLike) -> float:
        """Return the squared distance of two points (3,) that counts for arrival [m^2]."""
        offset = np.asarray(position, dtype=float) - np.asarray(waypoint, dtype=float)
        return float(offset @ offset)

    def braking_distance(self) -> float:
        """Return the distance from a waypoint below which the robot slows down [m]."""
        return self.settings.speed / self.rate

    def steps_limit(self, state: RobotState, waypoints: FloatArray, step: float) -> int:
        """Return the steps after which a waypoint counts as unreachable."""
        gaps = ((waypoints - state.pose.position) ** 2).sum(axis=1)
        farthest = math.sqrt(gaps.max(initial=0.0))
        around = 0.0
        if len(self.keep_out.circles):
            circles = self.keep_out.circles
            around = 2.0 * math.pi * float(circles[:, 3].sum())
            around += 2.0 * float(np.hypot(circles[:, 5], circles[:, 6]).sum())
        seconds = 2.0 * (farthest + around) / self.settings.speed + 30.0
        return min(math.ceil(seconds / step), STEPS_LIMIT)


def check_waypoint(waypoint: ArrayLike) -> FloatArray:
    """Return a waypoint as a (3,) array; ValueError if it is invalid."""
    return check_waypoints(np.asarray(waypoint, dtype=float)[None, :])[0]


def check_waypoints(waypoints: ArrayLike) -> FloatArray:
    """Return waypoints as a (W, 3) array; ValueError if one is invalid."""
    array = np.ascontiguousarray(waypoints, dtype=float)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f'waypoints: got shape {array.shape}, allowed is (W, 3)')
    # Fast path: a finite sum means that every number is finite.
    if not math.isfinite(array.sum()) and not np.isfinite(array).all():
        raise ValueError('waypoints: got a number that is not finite')
    return array


def check_command(velocity_command: ArrayLike) -> FloatArray:
    """Return a velocity command as a (4,) array; ValueError if it is invalid."""
    array = np.array(velocity_command, dtype=float)
    if array.shape != (4,) or not all(map(math.isfinite, array.tolist())):
        raise ValueError(f'velocity command: got {array.tolist()}, allowed are four finite numbers')
    return array


def check_step(step: float) -> float:
    """Return a valid duration, or raise ValueError."""
    if not (math.isfinite(step) and step > 0.0):
        raise ValueError(f'step: got {step}, allowed are finite numbers above 0 [s]')
    return float(step)


@njit(cache=True)
def _trim(positions: FloatArray, yaws: FloatArray, lengths: IntArray, reached: BoolArray) -> int:
    """Mark reached waypoints, cut lengths, extend trajectories; return the longest length."""
    limit = positions.shape[1] - 1
    for w in range(positions.shape[0]):
        reached[w] = 0 <= lengths[w] <= limit
        lengths[w] = min(lengths[w], limit) if lengths[w] >= 0 else -lengths[w] - 1
    longest = lengths.max() if lengths.size else 0
    for w in range(positions.shape[0]):
        last = lengths[w]
        for k in range(last + 1, longest + 1):
            # By elements: rows take seconds to compile.
            for axis in range(3):
                positions[w, k, axis] = positions[w, last, axis]
            yaws[w, k] = yaws[w, last]
    return longest
