"""Path of a robot to a charger, past other robots."""

import math
from collections.abc import Mapping

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_planner.planners.separation import apart, paths_apart, paths_of
from maasi_planner.team import (
    CROSSED,
    TAKEN,
    Decision,
    RobotDecision,
    TeamView,
    single_choice,
    stay,
)

# Rotations of half a path to either side, by angles [rad]: (6, 3, 2).
_ASIDE = np.array(
    [
        0.5 * np.array([[math.cos(t), -math.sin(t)], [math.sin(t), math.cos(t)], [0.0, 0.0]])
        for t in (0.5, -0.5, 1.0, -1.0, 1.5, -1.5)
    ]
)


def go_home(team: TeamView, name: str, decision: Decision, reason: str) -> RobotDecision:
    """Send a robot to a charger past other robots; it waits if all are taken."""
    view, endurance = team.robots[name], team.robots[name].endurance
    assert endurance is not None
    here, keep_out = view.state.pose.position, view.motion.keep_out
    others = {key: robot.positions for key, robot in decision.robots.items() if key != name}
    standing = [(path[-1], radius) for path, radius in paths_of(team, name, others)]
    chargers = endurance.chargers_within(here)
    free = [charger for charger in chargers if apart(charger, view.radius, standing)]
    charger = (free or chargers)[0]
    prediction = view.motion.predict(view.state, charger[None, :], team.step_time)
    if not free:
        return _wait_near(team, name, charger, others, f'{reason}; {TAKEN}')
    if paths_apart(team, name, prediction.positions, others)[0]:
        return single_choice(charger[None, :], prediction, 0, reason)
    # Past their final positions, or to the side until they have passed.
    aside = here + _ASIDE @ (charger - here)[:2]
    moved = [keep_out.moved_out(here, point) for point in aside]
    inside = [point for point in moved if point is not None and team.area.inside(point[None, :])[0]]
    goals = np.array([keep_out.past(here, charger, standing), *inside])
    prediction = view.motion.predict(view.state, goals, team.step_time)
    usable = paths_apart(team, name, prediction.positions, others) & prediction.reached
    return single_choice(goals, prediction, int(np.argmax(usable)), reason)


def free_charger(team: TeamView, name: str, decision: Decision, reason: str) -> RobotDecision:
    """Send a robot away from its charger for another one."""
    view, endurance = team.robots[name], team.robots[name].endurance
    assert endurance is not None
    others = {key: robot.positions for key, robot in decision.robots.items() if key != name}
    charger = endurance.chargers_within(view.state.pose.position)[0]
    return _wait_near(team, name, charger, others, reason, leaves=True)


def _wait_near(
    team: TeamView,
    name: str,
    charger: FloatArray,
    others: Mapping[str, FloatArray],
    reason: str,
    leaves: bool = False,
) -> RobotDecision:
    """Send a robot near a charger, where it waits; if it is near, it stays unless it `leaves`."""
    view = team.robots[name]
    here, motion = view.state.pose.position, view.motion
    standing = [(path[-1], radius) for path, radius in paths_of(team, name, others)]
    # Far enough that the robot at the charger can leave it.
    reach = 3.0 * (view.radius + max(radius for _, radius in standing))
    reach += 2.0 * motion.settings.tolerance
    if math.dist(here, charger) <= 1.25 * reach and not leaves:
        return stay(view, f'waits: {TAKEN}')
    turns = np.linspace(0.0, 2.0 * math.pi, 8, endpoint=False)
    turns += math.atan2(here[1] - charger[1], here[0] - charger[0])
    ring = charger + reach * np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=1)
    free = [
        bool(team.area.inside(point[None, :])[0] and motion.keep_out.is_free(point))
        and apart(point, view.radius, standing)
        for point in ring
    ]
    if not any(free):
        return stay(view, f'waits: {TAKEN}')
    goals = ring[free]
    prediction = motion.predict(view.state, goals, team.step_time)
    usable = paths_apart(team, name, prediction.positions, others) & prediction.reached
    if not usable.any():
        return stay(view, CROSSED)
    return single_choice(goals, prediction, int(np.argmax(usable)), reason)
