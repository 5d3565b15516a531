"""Flight over terrain: planners and controllers use heights above ground for z."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.terrain import Surface, Terrain, clearance_along, height_at
from maasi_filter.models.pose import Pose
from maasi_planner.motion.base import MotionModel, RobotState
from maasi_planner.settings import RobotModel
from maasi_planner.team import Decision

# The ground ahead is sampled this often in a cell, at most so often in all.
_PER_CELL, _SAMPLES = 4.0, 400
_AHEAD = 4.0  # how far the robot looks ahead, in times of its response


def above_ground(state: RobotState, terrain: Terrain | None) -> RobotState:
    """Return a state [m, map] with height and climb above the ground below it."""
    if terrain is None:
        return state
    position, velocity = state.pose.position.copy(), state.velocity.copy()
    position[2] -= terrain.height(position)
    velocity[2] -= float(terrain.slopes(position[None])[0] @ velocity[:2])
    return RobotState(Pose(position, state.pose.orientation), velocity, state.angular_velocity)


def on_map(positions: FloatArray, terrain: Terrain | None) -> FloatArray:
    """Return positions (n, 3) whose z are heights above ground in the map [m]."""
    if terrain is None or not len(positions):
        return positions
    raised = np.array(positions, dtype=float)
    raised[:, 2] += terrain.heights(raised)
    return raised


def decision_on_map(decision: Decision, terrain: Terrain | None) -> Decision:
    """Return a decision with all positions in the map, as messages and records have them."""
    if terrain is None:
        return decision
    robots = {
        name: replace(
            robot,
            waypoint=on_map(robot.waypoint[None], terrain)[0],
            positions=on_map(robot.positions, terrain),
            candidates=on_map(robot.candidates, terrain),
            tour=on_map(robot.tour, terrain),
        )
        for name, robot in decision.robots.items()
    }
    return replace(decision, robots=robots)


def least_height(robot: RobotModel) -> float:
    """Return the height above ground below which a robot does not fly [m]."""
    return robot.radius + robot.motion.clearance


def height_problem(area: Area, robot: RobotModel, position: ArrayLike) -> str:
    """Return why a position (3,) [m, map] is too low for a flying robot; empty: it is not."""
    if area.terrain is None or robot.motion.model == 'unicycle':
        return ''
    height = float(np.asarray(position)[2]) - area.terrain.height(position)
    if height >= least_height(robot):
        return ''
    return (
        f'.z: is {height:.2f} m above the ground, allowed is at least {least_height(robot):g} m, '
        'radius and motion.clearance'
    )


@njit(cache=True, error_model='numpy')
def _climb(surface: Surface, state: FloatArray, ahead: FloatArray, height: float) -> float:
    """Return the vertical speed with which a robot keeps a height above the ground ahead.

    state: x, y, z; ahead: direction x, y, distance, speed, and response time. The steepest
    climb that a point of the ground ahead needs, or the slowest descent.
    """
    x, y, z = state
    along_x, along_y, distance, speed, response = ahead
    step = min(surface.step[0], surface.step[1]) / _PER_CELL
    number = min(int(distance / step) + 1, _SAMPLES)
    climb = -np.inf
    for k in range(number + 1):
        s = distance * k / number
        missing = height_at(surface, x + s * along_x, y + s * along_y) + height - z
        time = max(s / speed, response) if speed > 0.0 else response
        climb = max(climb, missing / time)
    return climb


def follow_terrain(
    motion: MotionModel, terrain: Terrain, state: RobotState, goal: FloatArray, least: float
) -> FloatArray:
    """Return the command (4,) towards a goal (3,) [m, map] at its height above ground.

    The controller steers at a constant height above ground. The robot climbs early enough for the
    ground ahead, and stops before ground that is too high for it, until it is high enough.
    """
    level = np.array(goal, dtype=float)
    level[2] -= terrain.height(goal)
    command = motion.command(above_ground(state, terrain), level)
    position, yaw = state.pose.position, state.pose.yaw
    cosine, sine = math.cos(yaw), math.sin(yaw)
    velocity = np.array(
        [cosine * command[0] - sine * command[1], sine * command[0] + cosine * command[1]]
    )
    speed, top = math.hypot(*velocity), motion.settings.speed
    ahead = np.array([0.0, 0.0, 0.0, speed, 1.0 / motion.rate])
    if speed > 1e-9:
        left = math.hypot(*(goal[:2] - position[:2]))
        ahead[:2] = velocity / speed
        ahead[2] = min(left, _AHEAD * speed / motion.rate)
    climb = _climb(terrain.surface, position, ahead, float(level[2]))
    climb = min(max(climb, -top), top)
    whole = math.hypot(speed, climb)
    share = min(top / whole, 1.0) if whole > 0.0 else 1.0
    command[:2] *= share
    command[2] = share * climb
    if not _is_clear(motion, terrain, state, ahead[:2], least):
        command[:2] = 0.0
        command[2] = max(command[2], min(0.5 * top, motion.rate * float(level[2])))
    return command


def _is_clear(
    motion: MotionModel, terrain: Terrain, state: RobotState, along: FloatArray, least: float
) -> bool:
    """Return whether a robot at its height is clear of the ground until it can stop."""
    position, moving = state.pose.position, state.velocity[:2]
    for way in (along, moving / (math.hypot(*moving) or 1.0)):
        end = position.copy()
        end[:2] += way * math.hypot(*moving) / motion.rate
        if clearance_along(terrain.surface, position, end, least) < least:
            return False
    return True
