"""Distances between waypoints and between predicted paths of robots."""

import math
from collections.abc import Mapping

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.motion.base import MotionModel, RobotState, Trajectories
from maasi_planner.team import CROSSED, Decision, RobotDecision, RobotView, TeamView, stay

# Most steps of braking, and the speed below which a robot stands [m/s].
_BRAKING_STEPS, _STANDS = 400, 1e-3
# Most steps by which a robot is behind or ahead of its predicted path.
_LATEST = 10


def free_of_robots(
    points: FloatArray, radius: float, standing: list[tuple[FloatArray, float]]
) -> BoolArray:
    """Return which waypoints (W, 3) keep the radii away from other robots' final positions."""
    free = np.ones(len(points), dtype=bool)
    for point, other in standing:
        reach = radius + other
        if reach > 0.0:
            offset = points - point
            free &= (offset * offset).sum(axis=1) >= reach * reach
    return free


def apart(point: FloatArray, radius: float, others: list[tuple[FloatArray, float]]) -> bool:
    """Return whether a waypoint (3,) keeps the radii away from other positions."""
    return bool(free_of_robots(point[None, :], radius, others)[0])


@njit(cache=True)
def _gaps(paths: FloatArray, other: FloatArray) -> FloatArray:
    """Return the smallest distance of each path (W, K, 3) from another (n, 3), also between steps.

    Robots stand at the ends. A goal takes effect at once or one step later.
    """
    out = np.full(paths.shape[0], np.inf)
    for w in range(paths.shape[0]):
        for late in range(2):
            dx = dy = dz = 0.0
            for k in range(max(paths.shape[1] + late, other.shape[0])):
                here = min(max(k - late, 0), paths.shape[1] - 1)
                there = min(k, other.shape[0] - 1)
                x = paths[w, here, 0] - other[there, 0]
                y = paths[w, here, 1] - other[there, 1]
                z = paths[w, here, 2] - other[there, 2]
                square = x * x + y * y + z * z
                if k > 0:
                    # Both move uniformly between steps.
                    mx, my, mz = x - dx, y - dy, z - dz
                    moved = mx * mx + my * my + mz * mz
                    along = -(dx * mx + dy * my + dz * mz)
                    if 0.0 < along < moved:
                        before = dx * dx + dy * dy + dz * dz
                        square = min(square, max(before - along * along / moved, 0.0))
                out[w] = min(out[w], square)
                dx, dy, dz = x, y, z
    return np.sqrt(out)


def from_here(path: FloatArray, position: FloatArray) -> FloatArray:
    """Return the remaining predicted path (n, 3) from a robot's actual position.

    The robot may be some steps late, as a goal takes effect after a while, or early.
    """
    first = path[:_LATEST]
    nearest = int(np.argmin(((first - position) ** 2).sum(axis=1)))
    if nearest > 0 or len(path) < 2:
        return path[nearest:]
    gap, move = math.dist(path[0], position), math.dist(path[0], path[1])
    if gap < 1e-6:
        return path
    late = min(max(round(gap / move), 1), _LATEST) if move > 0.0 else 1
    shares = np.arange(late)[:, None] / late
    return np.vstack([position + shares * (path[0] - position), path])


def _drifting(path: FloatArray, view: RobotView, step: float) -> FloatArray | None:
    """Return a path (n, 3) with the drift at its end, at most twice the tolerance, or None."""
    if len(path) < 2:
        return None
    settings, velocity = view.motion.settings, (path[-1] - path[-2]) / step
    speed = float(np.linalg.norm(velocity))
    if speed < _STANDS:
        return None
    slowing = settings.acceleration or view.motion.rate * speed
    drift = min(0.5 * speed * speed / slowing, 2.0 * settings.tolerance)
    return np.vstack([path, path[-1] + velocity * (drift / speed)])


def braking_path(motion: MotionModel, state: RobotState, step: float) -> FloatArray:
    """Return the path of a robot that is commanded to stop, (n, 3), from its present position.

    Drifts below a tenth of its tolerance are neglected.
    """
    path = [np.array(state.pose.position, dtype=float)]
    if np.linalg.norm(state.velocity) > _STANDS:
        body = motion.body(state)
        for _ in range(_BRAKING_STEPS):
            body.step(np.zeros(4), step)
            now = body.robot_state()
            path.append(np.array(now.pose.position))
            if np.linalg.norm(now.velocity) <= _STANDS:
                break
    drift = math.dist(path[0], path[-1])
    return np.array(path if drift > 0.1 * motion.settings.tolerance else path[:1])


def with_braking(motion: MotionModel, robot: RobotDecision, step: float) -> FloatArray:
    """Return the predicted path (n, 3) of a robot with the drift after its arrival."""
    path = robot.positions
    if len(path) < 2:
        return path
    state = RobotState(Pose.from_yaw(path[-1], robot.yaws[-1]), (path[-1] - path[-2]) / step)
    return np.vstack([path, braking_path(motion, state, step)[1:]])


def paths_apart(
    team: TeamView, name: str, paths: FloatArray, others: Mapping[str, FloatArray]
) -> BoolArray:
    """Return which predicted paths (W, K, 3) of a robot keep the radii away from those of others.

    others: paths (n, 3) decided at this step, by name; other robots stand or are on their remaining
    paths. Robots that are too near already must not come nearer.
    """
    view = team.robots[name]
    free = np.ones(len(paths), dtype=bool)
    for path, radius in paths_of(team, name, others):
        if view.radius + radius > 0.0:
            now = float(np.linalg.norm(view.state.pose.position - path[0]))
            reach = min(view.radius + radius, now)
            free &= _gaps(paths, np.ascontiguousarray(path, dtype=float)) >= reach - 1e-9
    return free


def crossed(team: TeamView, name: str, prediction: Trajectories, decision: Decision) -> bool:
    """Return whether other robots are in the only path of a prediction."""
    others = {key: robot.positions for key, robot in decision.robots.items()}
    return not paths_apart(team, name, prediction.positions, others)[0]


def all_apart(team: TeamView, waypoints: Mapping[str, FloatArray]) -> bool:
    """Return whether the waypoints (3,) of robots, by name, keep their radii apart."""
    taken: list[tuple[FloatArray, float]] = []
    for name, point in waypoints.items():
        radius = team.robots[name].radius
        if not apart(point, radius, taken):
            return False
        taken.append((point, radius))
    return True


def paths_of(
    team: TeamView, name: str, others: Mapping[str, FloatArray]
) -> list[tuple[FloatArray, float]]:
    """Return paths or positions of the other robots, (n, 3), and their radii."""
    paths = [(point[None, :], radius) for point, radius in team.taken]
    for other in team.names():
        robot = team.robots[other]
        if other in others:
            paths.append((others[other], robot.radius))
        elif other != name and not robot.planning:
            path = robot.remaining_path
            if path is None or len(path) < 2:
                # A robot that was commanded to stay may still drift.
                path = braking_path(robot.motion, robot.state, team.step_time)
            else:
                path = from_here(path, robot.state.pose.position)
            # It stands at its end, or drifts.
            paths.append((path, robot.radius))
            drifting = _drifting(path, robot, team.step_time)
            if drifting is not None:
                paths.append((drifting, robot.radius))
    return paths


def keep_apart(team: TeamView, decision: Decision, left: Mapping[str, FloatArray]) -> None:
    """Let robots wait whose paths come too close; the first by name has priority.

    A waiting robot brakes, which may make others wait, too, or follows the rest `left` (n, 3) of
    its present path.
    """
    paths, rest = {}, {}
    for name, robot in decision.robots.items():
        view = team.robots[name]
        if name in left:
            rest[name] = from_here(left[name], view.state.pose.position)
        else:
            rest[name] = braking_path(view.motion, view.state, team.step_time)
        going = rest[name] if robot.stays else with_braking(view.motion, robot, team.step_time)
        paths[name] = going
    changed = True
    while changed:
        changed = False
        for name in sorted(paths, reverse=True):
            others = {key: path for key, path in paths.items() if key != name}
            chosen = decision.robots[name]
            if chosen.stays or _both_apart(team, name, chosen, paths, others):
                continue
            decision.robots[name] = stay(team.robots[name], CROSSED)
            paths[name] = rest[name]
            changed = True


def _both_apart(
    team: TeamView,
    name: str,
    chosen: RobotDecision,
    paths: Mapping[str, FloatArray],
    others: Mapping[str, FloatArray],
) -> bool:
    """Return whether a robot keeps apart whether it stands or drifts at its end."""
    return all(
        paths_apart(team, name, path[None], others)[0] for path in (chosen.positions, paths[name])
    )
