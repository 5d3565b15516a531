"""What every motion model offers: prediction, the controller's command, and the body itself."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from maasi_filter.models.pose import Pose
from maasi_planner.obstacles import KeepOut, Obstacles, hold_back, next_point, segment_distance
from maasi_planner.settings import MotionSettings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
STEPS_LIMIT = 20_000


@dataclass
class RobotState:
    """State of a robot that every model understands.

    Parameters
    ----------
    pose : Pose
        In frame `map`.
    velocity : (3,) array
        m/s, axes of `map`.
    angular_velocity : (3,) array
        rad/s, body axes.

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
        """Return a state at rest at `position` [m, map] facing `yaw` [rad]."""
        return cls(Pose.from_yaw(position, yaw))


@dataclass
class Trajectories:
    """Predicted trajectories to W waypoints.

    Attributes
    ----------
    positions : (W, Kmax + 1, 3) array
        Metres, frame `map`, one per step, from the present state (column 0). After its own
        length a trajectory stays at its last position.
    yaws : (W, Kmax + 1) array
        Headings, radians.
    lengths : (W,) integer array
        K, steps until the waypoint is reached; 0 if the robot is there already.
    control_cost : (W,) array
        C, sum of squared inputs (000, eq. (18), (28)).
    reached : (W,) array of bool
        Whether the waypoint is reached at all.
    """

    positions: FloatArray
    yaws: FloatArray
    lengths: IntArray
    control_cost: FloatArray
    reached: NDArray[np.bool_]

    def distances(self) -> FloatArray:
        """Return the length of each trajectory in metres, (W,)."""
        moves = np.diff(self.positions, axis=1)
        return np.sqrt((moves * moves).sum(axis=2)).sum(axis=1)


class Body(ABC):
    """A robot's body under velocity commands: what the simulator steps."""

    @abstractmethod
    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """Go on for `dt` seconds.

        Parameters
        ----------
        velocity_command : (4,) array
            vx, vy, vz [m/s, body axes turned by the heading only] and yaw rate [rad/s], held
            for the whole time. Limits are applied here.
        dt : float
            Seconds.
        """

    @abstractmethod
    def robot_state(self) -> RobotState:
        """Return the state that a driver would know."""


class MotionModel(ABC):
    """A robot's controller and its prediction.

    Prediction, driver and simulator share one closed loop: `command` is what a driver sends,
    `body` is what receives it, and `predict` runs the one against the other.

    Parameters
    ----------
    settings : MotionSettings
        Limits and controller.
    obstacles : Obstacles, optional
        To get around.
    radius : float
        Of the robot, metres; obstacles are inflated by it.
    """

    def __init__(
        self,
        settings: MotionSettings,
        obstacles: Obstacles | None = None,
        radius: float = 0.0,
    ) -> None:
        self.settings = settings
        self.keep_out = KeepOut(obstacles or Obstacles.none(), radius, settings.clearance)
        self._goal: FloatArray | None = None
        self._goal_table = np.zeros(0)

    def predict(self, state: RobotState, waypoints: ArrayLike, step: float) -> Trajectories:
        """Return the trajectory to each waypoint under this controller.

        Parameters
        ----------
        state : RobotState
            Present state.
        waypoints : (W, 3) array
            Metres, frame `map`.
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
        return trimmed(out)

    @abstractmethod
    def roll_out(
        self, state: RobotState, waypoints: FloatArray, step: float, out: Trajectories
    ) -> None:
        """Run controller and body against each other to each waypoint, and fill `out`.

        Its rows are filled as far as each trajectory goes; one that does not arrive within the
        room there is gets a length that does not fit.
        """

    @abstractmethod
    def command(self, state: RobotState, waypoint: ArrayLike) -> FloatArray:
        """Return the velocity command vx, vy, vz [m/s, body], yaw rate [rad/s], shape (4,)."""

    @abstractmethod
    def body(self, state: RobotState) -> Body:
        """Return a body of this robot at `state`."""

    def arrived(self, position: ArrayLike, waypoint: ArrayLike) -> bool:
        """Return whether `position` is within the tolerance of `waypoint`, both (3,)."""
        offset = np.asarray(position, dtype=float) - np.asarray(waypoint, dtype=float)
        tolerance = self.settings.tolerance
        return float(offset @ offset) <= tolerance * tolerance

    def steps_limit(self, state: RobotState, waypoints: FloatArray, step: float) -> int:
        """Return the steps after which a waypoint counts as out of reach."""
        farthest = _farthest(waypoints, state.pose.position)
        around = 0.0
        if len(self.keep_out.circles):
            around = 2.0 * math.pi * float(self.keep_out.circles[:, 3].sum())
        seconds = 2.0 * (farthest + around) / self.settings.speed + 30.0
        return min(math.ceil(seconds / step), STEPS_LIMIT)

    def _tables(self, waypoints: FloatArray) -> FloatArray:
        """Return the way tables of all waypoints, (W, m)."""
        tables = np.zeros((len(waypoints), len(self.keep_out.vertices)))
        if tables.shape[1]:
            for index, waypoint in enumerate(waypoints):
                tables[index] = self.keep_out.to_goal(waypoint)
        return tables

    def _table(self, waypoint: FloatArray) -> FloatArray:
        """Return the way table of one waypoint, remembered until the waypoint changes."""
        if self._goal is None or not np.array_equal(self._goal, waypoint):
            self._goal = waypoint.copy()
            self._goal_table = self.keep_out.to_goal(waypoint)
        return self._goal_table


def check_waypoints(waypoints: ArrayLike) -> FloatArray:
    """Return waypoints as a (W, 3) array.

    Raises
    ------
    ValueError
        If the shape is wrong or a number is not finite.
    """
    array = np.ascontiguousarray(waypoints, dtype=float)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f'waypoints: got shape {array.shape}, allowed is (W, 3)')
    # A sum that is finite saves to look at each number.
    if not math.isfinite(array.sum()) and not np.isfinite(array).all():
        raise ValueError('waypoints: got a number that is not finite')
    return array


def check_command(velocity_command: ArrayLike) -> FloatArray:
    """Return a velocity command as a (4,) array.

    Raises
    ------
    ValueError
        If the shape is wrong or a number is not finite.
    """
    array = np.array(velocity_command, dtype=float)
    if array.shape != (4,) or not np.isfinite(array).all():
        raise ValueError(f'velocity command: got {array.tolist()}, allowed are four finite numbers')
    return array


def check_step(step: float) -> float:
    """Return a duration.

    Raises
    ------
    ValueError
        If it is not a finite number above 0.
    """
    if not (math.isfinite(step) and step > 0.0):
        raise ValueError(f'step: got {step}, allowed are finite numbers above 0 [s]')
    return float(step)


@njit(cache=True)
def _trim(
    positions: FloatArray, yaws: FloatArray, lengths: IntArray, reached: NDArray[np.bool_]
) -> int:
    """Fill what was reached, cut lengths, extend trajectories; return the longest length."""
    limit = positions.shape[1] - 1
    longest = 0
    for w in range(positions.shape[0]):
        reached[w] = lengths[w] <= limit
        lengths[w] = min(lengths[w], limit)
        longest = max(longest, lengths[w])
    for w in range(positions.shape[0]):
        last = lengths[w]
        for k in range(last + 1, longest + 1):
            for axis in range(3):
                positions[w, k, axis] = positions[w, last, axis]
            yaws[w, k] = yaws[w, last]
    return longest


def trimmed(out: Trajectories) -> Trajectories:
    """Return trajectories of equal width, each extended by its last position.

    A length that does not fit marks a waypoint that was not reached.
    """
    longest = _trim(out.positions, out.yaws, out.lengths, out.reached)
    return Trajectories(
        out.positions[:, : longest + 1],
        out.yaws[:, : longest + 1],
        out.lengths,
        out.control_cost,
        out.reached,
    )


@njit(cache=True)
def _farthest(points: FloatArray, place: FloatArray) -> float:
    """Return the largest distance of points (n, 3) from a place (3,)."""
    most = 0.0
    for i in range(points.shape[0]):
        square = 0.0
        for axis in range(3):
            square += (points[i, axis] - place[axis]) ** 2
        most = max(most, square)
    return math.sqrt(most)


@njit(cache=True)
def turn_towards(dx: float, dy: float, yaw: float, yaw_rate: float) -> float:
    """Return the yaw rate that turns the heading towards (dx, dy)."""
    turn = math.atan2(dy, dx) - yaw
    turn -= 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
    return min(max(2.0 * turn, -yaw_rate), yaw_rate)


@njit(cache=True)
def straight_command(
    dx: float,
    dy: float,
    dz: float,
    yaw: float,
    rate: float,
    speed: float,
    face_travel: bool,
    yaw_rate: float,
) -> tuple[float, float, float, float]:
    """Return the command vx, vy, vz (body axes), yaw rate towards a waypoint at (dx, dy, dz).

    The speed is `rate` times the distance, at most `speed`.
    """
    size = math.sqrt(dx * dx + dy * dy + dz * dz)
    scale = rate
    if rate * size > speed:
        scale = speed / size
    vx = scale * dx
    vy = scale * dy
    turn = 0.0
    if face_travel and dx * dx + dy * dy > 1e-6:
        turn = turn_towards(dx, dy, yaw, yaw_rate)
    if yaw == 0.0:
        return vx, vy, scale * dz, turn
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    return cos_yaw * vx + sin_yaw * vy, cos_yaw * vy - sin_yaw * vx, scale * dz, turn


@njit(cache=True)
def sideways_command(
    position: FloatArray,
    yaw: float,
    goal: FloatArray,
    rate: float,
    speed: float,
    barrier: float,
    deceleration: float,
    face_travel: bool,
    yaw_rate: float,
    circles: FloatArray,
    vertices: FloatArray,
    to_goal: FloatArray,
    clearance: float,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Write the command of a robot that can move in any direction into `out` (4,), body axes.

    The velocity is `rate` times the way left, at most `speed`, and next to obstacles what
    `deceleration` can stop; `work` (2, 3) is scratch.
    """
    if circles.shape[0] == 0:
        out[0], out[1], out[2], out[3] = straight_command(
            goal[0] - position[0],
            goal[1] - position[1],
            goal[2] - position[2],
            yaw,
            rate,
            speed,
            face_travel,
            yaw_rate,
        )
        return
    target = work[0]
    velocity = work[1]
    left = next_point(position, goal, circles, vertices, to_goal, clearance, target)
    dx = target[0] - position[0]
    dy = target[1] - position[1]
    dz = target[2] - position[2]
    size = math.sqrt(dx * dx + dy * dy + dz * dz)
    if deceleration < np.inf:
        room = np.inf
        for i in range(circles.shape[0]):
            room = min(
                room,
                segment_distance(
                    position[0],
                    position[1],
                    position[2],
                    position[0],
                    position[1],
                    position[2],
                    circles[i],
                )
                - circles[i, 3],
            )
        speed = min(speed, math.sqrt(deceleration * max(room, 0.0)) + 0.05 * speed)
    scale = 0.0
    if size > 0.0:
        scale = min(rate * left, speed) / size
    velocity[0] = scale * dx
    velocity[1] = scale * dy
    velocity[2] = scale * dz
    hold_back(position, circles, barrier, velocity)
    after = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    if after > speed:
        velocity[0] *= speed / after
        velocity[1] *= speed / after
        velocity[2] *= speed / after
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    out[0] = cos_yaw * velocity[0] + sin_yaw * velocity[1]
    out[1] = cos_yaw * velocity[1] - sin_yaw * velocity[0]
    out[2] = velocity[2]
    out[3] = 0.0
    if face_travel and dx * dx + dy * dy > 1e-6:
        out[3] = turn_towards(dx, dy, yaw, yaw_rate)
