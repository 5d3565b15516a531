"""Parrot Mambo: linear model of 12 states under a discrete LQR (000, section 5.1).

The set-point of the LQR leads the position by a limited distance. Then position drops out of the
feedback, u = -K_v (velocity - v) - K_a angles - K_w rates, with v = (K_p / K_v) lead: a velocity
command and a set-point at limited distance are the same thing. So the controller here turns a
waypoint into the velocity command that a driver publishes, and the body flies any such command.

Frames: `map` is ENU, body axes are forward, left, up; roll and pitch are right-handed about
them, so that pitch > 0 accelerates forward and roll > 0 to the right.

The obstacle term of 001, eq. (14) and (15), for a robot that flies velocity commands.

The paper subtracts k_obs from the input whenever an obstacle is nearer than d_l. With
u = K_v (v - velocity) - ... that equals a change of the velocity command by k_obs / K_v,
so it needs no access to the torques. As printed the term has no direction; `away` gives it the
direction from the obstacle to the robot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.motion.base import (
    Body,
    RobotState,
    SteeredMotion,
    Trajectories,
    TrajectoryArrays,
    add_position,
    check_command,
    check_step,
)
from maasi_planner.motion.mambo_dynamics import (
    ENTRIES,
    GRAVITY,
    K_Q,
    K_VX,
    SPEED,
    TILT,
    YAW_RATE,
    closed_loop,
    control_periods,
    lqr_gains,
    mambo_parameters,
    mambo_step,
)
from maasi_planner.motion.steering import Steering, Surroundings, sideways_command
from maasi_planner.obstacles import Obstacles
from maasi_planner.settings import MotionSettings

KINDS = ('none', 'printed', 'away')
PRINTED = 1


class ObstacleTerm(NamedTuple):
    """Obstacle term of a robot.

    kind: index in KINDS: none; the same k_obs off every input; k_obs along the way out; distance,
    gain: d_l [m] and k_obs [N m and N]; circles (n, 5): obstacles: x, y, z, radius, 1 for a sphere;
    the nearest surface counts.
    """

    kind: int
    distance: float
    gain: float
    circles: FloatArray


@njit(cache=True)
def add_obstacle_term(
    position: FloatArray,
    yaw: float,
    term: ObstacleTerm,
    parameters: FloatArray,
    command: FloatArray,
) -> None:
    """Add the term to `command` (4,) in place."""
    circles = term.circles
    gain = term.gain
    nearest = np.inf
    nx = 0.0
    ny = 0.0
    nz = 0.0
    for i in range(circles.shape[0]):
        ox = position[0] - circles[i, 0]
        oy = position[1] - circles[i, 1]
        oz = (position[2] - circles[i, 2]) if circles[i, 4] > 0.5 else 0.0
        size = math.sqrt(ox * ox + oy * oy + oz * oz)
        if size - circles[i, 3] < nearest:
            nearest = size - circles[i, 3]
            size = max(size, 1e-9)
            nx = ox / size
            ny = oy / size
            nz = oz / size
    if nearest >= term.distance:
        return
    if term.kind == PRINTED:
        command[0] -= gain / parameters[0]
        # A roll torque of -k_obs tips the robot to its left: the roll gain has the other sign.
        command[1] -= gain / parameters[3]
        command[2] -= gain / parameters[6]
        command[3] -= gain / parameters[7]
        return
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    command[0] += gain / abs(parameters[0]) * (cos_yaw * nx + sin_yaw * ny)
    command[1] += gain / abs(parameters[3]) * (cos_yaw * ny - sin_yaw * nx)
    command[2] += gain / abs(parameters[6]) * nz


@njit(cache=True)
def _roll_out(
    start: FloatArray,
    waypoints: FloatArray,
    tables: FloatArray,
    steering: Steering,
    around: Surroundings,
    term: ObstacleTerm,
    parameters: FloatArray,
    periods: int,
    h: float,
    out: TrajectoryArrays,
) -> None:
    work = np.zeros((2, 3))
    command = np.zeros(4)
    state = np.zeros(12)
    table = closed_loop(parameters, periods, h)
    limit = out.positions.shape[1] - 1
    for w in range(waypoints.shape[0]):
        state[:] = start
        goal = waypoints[w]
        length = limit + 1
        cost = 0.0
        for k in range(limit + 1):
            add_position(out, w, k, state[0], state[1], state[2], state[5])
            gap = math.sqrt(
                (state[0] - goal[0]) ** 2 + (state[1] - goal[1]) ** 2 + (state[2] - goal[2]) ** 2
            )
            if gap <= steering.tolerance:
                length = k
                break
            sideways_command(state, state[5], goal, tables[w], steering, around, work, command)
            if term.kind > 0:
                add_obstacle_term(state, state[5], term, parameters, command)
            cost += mambo_step(state, command, parameters, table, periods, h)
        out.lengths[w] = length
        out.control_cost[w] = cost


class MamboBody(Body):
    """The 12-state linear Mambo, its attitude and velocity loops at 200 Hz, and its limits.

    Speed, acceleration and tilt stay within the settings: commands are cut to a speed that the
    loop's overshoot cannot carry beyond `speed`, and the tilt asked for to the smaller of `tilt`
    and what `acceleration` allows; the tilt follows it without overshoot.

    state (12,): position [m, map], roll pitch yaw [rad], velocity [m/s, map], angular velocity
    [rad/s].
    """

    def __init__(self, settings: MotionSettings, state: RobotState) -> None:
        self.settings = settings
        self.parameters = mambo_parameters(settings)
        self.state = twelve_states(state)
        self._periods = (0, 0.0)
        self._table = np.zeros((3, ENTRIES))

    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """See `Body.step`."""
        periods, h = control_periods(check_step(dt))
        if (periods, h) != self._periods:
            self._periods = (periods, h)
            self._table = closed_loop(self.parameters, periods, h)
        mambo_step(
            self.state, check_command(velocity_command), self.parameters, self._table, periods, h
        )

    def robot_state(self) -> RobotState:
        """See `Body.robot_state`."""
        return RobotState(pose_of(self.state), self.state[6:9].copy(), self.state[9:12].copy())


def pose_of(state: FloatArray) -> Pose:
    """Return the pose of a (12,) state."""
    half = 0.5 * state[3:6]
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return Pose(
        state[:3].copy(),
        np.array(
            [
                cr * cp * cy + sr * sp * sy,
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
            ]
        ),
    )


def twelve_states(state: RobotState) -> FloatArray:
    """Return the (12,) state of a robot state."""
    w, x, y, z = state.pose.orientation
    out = np.zeros(12)
    out[:3] = state.pose.position
    out[3] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    out[4] = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    out[5] = state.pose.yaw
    out[6:9] = state.velocity
    out[9:12] = state.angular_velocity
    return out


class Mambo(SteeredMotion):
    """Controller and prediction of `MamboBody`."""

    def __init__(
        self, settings: MotionSettings, obstacles: Obstacles | None = None, radius: float = 0.0
    ) -> None:
        super().__init__(settings, obstacles, radius)
        self.parameters = mambo_parameters(settings)
        gains = lqr_gains(settings)
        own = min(
            gains['pitch'][0] / gains['pitch'][1],
            gains['roll'][0] / gains['roll'][1],
            gains['height'][0] / gains['height'][1],
        )
        slowing = GRAVITY * self.parameters[TILT] / settings.speed
        self.rate = float(min(settings.approach_rate or own, slowing))
        natural = math.sqrt(GRAVITY * self.parameters[K_VX] / self.parameters[K_Q])
        self.barrier = float(min(0.18 * natural, 0.5 * slowing))
        self.steering = Steering(
            self.rate,
            float(self.parameters[SPEED]),
            self.barrier,
            math.inf,
            settings.heading == 'travel',
            float(self.parameters[YAW_RATE]),
            settings.tolerance,
        )
        self._term = ObstacleTerm(
            KINDS.index(settings.obstacle_term),
            settings.obstacle_distance,
            settings.obstacle_gain,
            self.keep_out.circles,
        )
        if self._term.kind:
            # The term takes the place of ways around obstacles.
            self.surroundings = self.surroundings._replace(circles=np.zeros((0, 5)))

    def roll_out(
        self, state: RobotState, waypoints: FloatArray, step: float, out: Trajectories
    ) -> None:
        """See `MotionModel.roll_out`."""
        periods, h = control_periods(step)
        _roll_out(
            twelve_states(state),
            waypoints,
            self._tables(waypoints),
            self.steering,
            self.surroundings,
            self._term,
            self.parameters,
            periods,
            h,
            out.arrays(),
        )

    def command(self, state: RobotState, waypoint: ArrayLike) -> FloatArray:
        """See `MotionModel.command`: the LQR's set-point as a velocity command."""
        out = super().command(state, waypoint)
        if self._term.kind:
            position = np.array(state.pose.position)
            add_obstacle_term(position, state.pose.yaw, self._term, self.parameters, out)
        return out

    def body(self, state: RobotState) -> MamboBody:
        """See `MotionModel.body`."""
        return MamboBody(self.settings, state)
