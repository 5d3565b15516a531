"""Detours around robots that stand in a path, such as those that charge or are done."""

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_planner.motion.base import Trajectories
from maasi_planner.planners.options import affordable
from maasi_planner.planners.separation import crossed, free_of_robots
from maasi_planner.team import Decision, TeamView

PASSES = 'goes around robots that stand in its path'


def others_move(team: TeamView, name: str, decision: Decision) -> bool:
    """Return whether another robot moves, or has just received a waypoint."""
    return any(not robot.stays for robot in decision.robots.values()) or any(
        not view.planning and view.underway for other, view in team.robots.items() if other != name
    )


def past_standing(
    team: TeamView, name: str, waypoint: FloatArray, decision: Decision
) -> tuple[FloatArray, Trajectories] | None:
    """Return the next point (1, 3) past other robots to a waypoint and its prediction, or None."""
    view = team.robots[name]
    here, motion = view.state.pose.position, view.motion
    positions = list(team.taken) + [
        (np.array(other.state.pose.position), other.radius)
        for key, other in team.robots.items()
        if key != name
    ]
    if not free_of_robots(waypoint[None], view.radius, positions)[0]:
        return None
    point = motion.keep_out.past(here, waypoint, positions)[None]
    prediction = motion.predict(view.state, point, team.step_time)
    usable = prediction.reached & (prediction.lengths > 0) & team.area.inside(point)
    if not usable[0] or crossed(team, name, prediction, decision):
        return None
    return (point, prediction) if affordable(team, name, prediction, usable)[0] else None
