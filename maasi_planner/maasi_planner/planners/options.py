"""Candidates of robots that are reachable, apart from others, and affordable."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_filter.records import Cluster
from maasi_planner.motion.base import Trajectories
from maasi_planner.planners.separation import crossed, free_of_robots, paths_apart
from maasi_planner.team import (
    BLOCKED,
    CROSSED,
    SAVES_BATTERY,
    Decision,
    RobotView,
    TeamView,
    UsableCandidates,
    stay,
)


def usable_candidates(
    team: TeamView, name: str, extra: FloatArray | None = None
) -> tuple[FloatArray, str]:
    """Return a robot's candidates moved out of obstacles, and a text about dropped ones."""
    view = team.robots[name]
    points = np.asarray(view.candidates, dtype=float).reshape(-1, 3)
    dropped: list[str] = []
    inside = team.area.inside(points)
    if not inside.all():
        finite = np.isfinite(points).all(axis=1)
        for wrong, reason in ((~finite, 'not finite'), (finite & ~inside, 'outside the area')):
            if wrong.any():
                dropped.append(f'{np.count_nonzero(wrong)} {reason}')
        points = points[inside]
    number = len(points)
    if extra is not None and len(extra):
        points = np.vstack([points, extra[team.area.inside(extra)]])
    if len(view.motion.keep_out):
        here = view.state.pose.position
        moved = [view.motion.keep_out.moved_out(here, point) for point in points]
        lost = sum(point is None for point in moved[:number])
        if lost:
            dropped.append(f'{lost} in obstacles')
        points = np.array([point for point in moved if point is not None]).reshape(-1, 3)
        # They move towards the robot, which may be outside.
        points = points[team.area.inside(points)]
    return points, ', '.join(dropped)


def waiting_places(team: TeamView) -> list[tuple[FloatArray, float]]:
    """Return final positions (3,) [m, map] and radii [m] of the robots that do not plan.

    Parameters
    ----------
    team : TeamView
        The team at this step.

    Returns
    -------
    list of (3,) array and float
        For `options_of`; append the waypoint and radius of each robot that was decided.
    """
    standing = list(team.taken)
    for name in team.names():
        view = team.robots[name]
        if not view.planning:
            standing.append((view.destination, view.radius))
    return standing


def options_of(
    team: TeamView,
    name: str,
    standing: list[tuple[FloatArray, float]],
    extra: FloatArray | None = None,
) -> UsableCandidates | str:
    """Return the candidates of a robot, or why it has to stay.

    Parameters
    ----------
    team : TeamView
        The team at this step.
    name : str
        A robot that plans.
    standing : list of (3,) array and float
        Final positions [m, map] and radii [m] of the robots that have their waypoints.
    extra : (n, 3) array, optional
        Further candidates [m, map].

    Returns
    -------
    UsableCandidates or str
        The candidates, or the reason.
    """
    view = team.robots[name]
    if not len(view.candidates) and (extra is None or not len(extra)):
        return 'it has no candidates'
    points, dropped = usable_candidates(team, name, extra)
    if not len(points):
        return f'no candidate is usable ({dropped})'
    prediction = view.motion.predict(view.state, points, team.step_time)
    free = free_of_robots(points, view.radius, standing)
    allowed = prediction.reached & free & (prediction.lengths > 0)
    if allowed.any():
        allowed &= paths_apart(team, name, prediction.positions, {})
        if not allowed.any():
            return BLOCKED[0]
        allowed = affordable(team, name, prediction, allowed)
        if not allowed.any():
            return SAVES_BATTERY
        return UsableCandidates(points, prediction, allowed)
    if not free.any():
        return BLOCKED[1]
    if (prediction.lengths == 0).any():
        return 'it is already at its only candidate'
    return 'no candidate can be reached'


def usable_options(
    team: TeamView,
    decision: Decision,
    extra: Callable[[str], FloatArray | None] = lambda _: None,
    kept: Callable[[str, Trajectories], Trajectories] = lambda _, exact: exact,
) -> dict[str, UsableCandidates]:
    """Return the candidates of the robots that have some; `decision` lets the others stay."""
    standing = waiting_places(team)
    options = {}
    for name in team.planning():
        found = options_of(team, name, standing, extra(name))
        if isinstance(found, str):
            decision.robots[name] = stay(team.robots[name], f'stays: {found}')
        else:
            options[name] = replace(found, prediction=kept(name, found.prediction))
    return options


def centres_of(team: TeamView, view: RobotView, clusters: Sequence[Cluster]) -> FloatArray:
    """Return the centres of clusters as waypoints (n, 3); in 2D at the robot's height."""
    centres = np.zeros((len(clusters), 3))
    centres[:, 2] = view.height
    for row, cluster in zip(centres, clusters):
        row[: team.dimension] = cluster.position[: team.dimension]
    return centres


def affordable(
    team: TeamView, name: str, prediction: Trajectories, allowed: BoolArray
) -> BoolArray:
    """Return which of the allowed paths leave a robot enough battery to get home, (W,)."""
    endurance = team.robots[name].endurance
    if endurance is None:
        return allowed
    return allowed & endurance.affords(prediction, team.step_time)


def held_back(team: TeamView, name: str, prediction: Trajectories, decision: Decision) -> str:
    """Return why a robot must not follow the only path of a prediction now, or an empty text."""
    if crossed(team, name, prediction, decision):
        return CROSSED
    if not affordable(team, name, prediction, prediction.reached)[0]:
        return f'stays: {SAVES_BATTERY}'
    return ''
