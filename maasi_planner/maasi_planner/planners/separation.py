"""Distances between robots: of waypoints, and of whole predicted paths."""

import math
from collections.abc import Mapping

import numpy as np
from numba import njit

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.motion.base import MotionModel, RobotState, Trajectories
from maasi_planner.team import CROSSED, Decision, RobotDecision, RobotView, TeamView, stay

# Steps in which a robot brakes at most, and the speed below which it stands [m/s].
_BRAKING_STEPS, _STANDS = 400, 1e-3
# Steps by which a robot is behind or before its predicted path at most.
_LATEST = 10


def free_of_robots(
    points: FloatArray, radius: float, places: list[tuple[FloatArray, float]]
) -> BoolArray:
    """Return which waypoints (W, 3) keep the radii away from where others will stand."""
    free = np.ones(len(points), dtype=bool)
    for place, other in places:
        reach = radius + other
        if reach > 0.0:
            offset = points - place
            free &= (offset * offset).sum(axis=1) >= reach * reach
    return free


def apart(point: FloatArray, radius: float, others: list[tuple[FloatArray, float]]) -> bool:
    """Return whether a waypoint (3,) keeps the radii away from other places."""
    return bool(free_of_robots(point[None, :], radius, others)[0])


@njit(cache=True)
def _gaps(ways: FloatArray, other: FloatArray) -> FloatArray:
    """Return how near each of the ways (W, K, 3) comes to another (n, 3), also between steps, (W,).

    At their ends robots stand. A goal takes effect at once, or a step later.
    """
    out = np.full(ways.shape[0], np.inf)
    for w in range(ways.shape[0]):
        for late in range(2):
            dx = dy = dz = 0.0
            for k in range(max(ways.shape[1] + late, other.shape[0])):
                here = min(max(k - late, 0), ways.shape[1] - 1)
                there = min(k, other.shape[0] - 1)
                x = ways[w, here, 0] - other[there, 0]
                y = ways[w, here, 1] - other[there, 1]
                z = ways[w, here, 2] - other[there, 2]
                square = x * x + y * y + z * z
                if k > 0:
                    # Between two steps both move evenly.
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
    """Return the rest (n, 3) of a predicted path as a robot goes it from where it is now.

    It may be some steps late, as a goal takes effect after a while, or early.
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
    """Return a path (n, 3) with what a robot drifts at its end; None: it stands there.

    It is twice its tolerance at most.
    """
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
    """Return where a robot goes that is commanded to stand, (n, 3), from its present position on.

    It is its position alone where it stands, or drifts by less than a tenth of its tolerance.
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
    """Return the predicted path (n, 3) of a robot, with what it drifts after it has arrived."""
    path = robot.positions
    if len(path) < 2:
        return path
    state = RobotState(Pose.from_yaw(path[-1], robot.yaws[-1]), (path[-1] - path[-2]) / step)
    return np.vstack([path, braking_path(motion, state, step)[1:]])


def ways_apart(
    team: TeamView, name: str, ways: FloatArray, others: Mapping[str, FloatArray]
) -> BoolArray:
    """Return which predicted ways (W, K, 3) of a robot keep the radii away from those of others.

    others: ways (n, 3) of robots that have just been decided, by name; the others are where they
    stand, or on the rest of their ways. A robot that is too near already may not come nearer.
    """
    view = team.robots[name]
    free = np.ones(len(ways), dtype=bool)
    for path, radius in paths_of(team, name, others):
        if view.radius + radius > 0.0:
            now = float(np.linalg.norm(view.state.pose.position - path[0]))
            reach = min(view.radius + radius, now)
            free &= _gaps(ways, np.ascontiguousarray(path, dtype=float)) >= reach - 1e-9
    return free


def crossed(team: TeamView, name: str, prediction: Trajectories, decision: Decision) -> bool:
    """Return whether others, also those just decided, are on the only way of a prediction."""
    others = {key: robot.positions for key, robot in decision.robots.items()}
    return not ways_apart(team, name, prediction.positions, others)[0]


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
    """Return where the others go or stand, (n, 3), and their radii."""
    paths = [(place[None, :], radius) for place, radius in team.taken]
    for other in team.names():
        robot = team.robots[other]
        if other in others:
            paths.append((others[other], robot.radius))
        elif other != name and not robot.planning:
            path = robot.remaining_path
            if path is None or len(path) < 2:
                # Where it was commanded to stay it may have drifted on since.
                path = braking_path(robot.motion, robot.state, team.step_time)
            else:
                path = from_here(path, robot.state.pose.position)
            # It may stand at once where it arrives, or drift.
            paths.append((path, robot.radius))
            drifting = _drifting(path, robot, team.step_time)
            if drifting is not None:
                paths.append((drifting, robot.radius))
    return paths


def keep_apart(team: TeamView, decision: Decision, left: Mapping[str, FloatArray]) -> None:
    """Let robots wait whose ways would come too near to each other; the first by name has priority.

    A robot that waits brakes, which may make others wait, too; left: or it is still on the rest
    (n, 3) of its present path.
    """
    ways, rest = {}, {}
    for name, robot in decision.robots.items():
        view = team.robots[name]
        if name in left:
            rest[name] = from_here(left[name], view.state.pose.position)
        else:
            rest[name] = braking_path(view.motion, view.state, team.step_time)
        going = rest[name] if robot.stays else with_braking(view.motion, robot, team.step_time)
        ways[name] = going
    changed = True
    while changed:
        changed = False
        for name in sorted(ways, reverse=True):
            others = {key: way for key, way in ways.items() if key != name}
            chosen = decision.robots[name]
            if chosen.stays or _both_apart(team, name, chosen, ways, others):
                continue
            decision.robots[name] = stay(team.robots[name], CROSSED)
            ways[name] = rest[name]
            changed = True


def _both_apart(
    team: TeamView,
    name: str,
    chosen: RobotDecision,
    ways: Mapping[str, FloatArray],
    others: Mapping[str, FloatArray],
) -> bool:
    """Return whether a robot keeps apart from others if it stands at its end, and if it drifts."""
    return all(
        ways_apart(team, name, way[None], others)[0] for way in (chosen.positions, ways[name])
    )
