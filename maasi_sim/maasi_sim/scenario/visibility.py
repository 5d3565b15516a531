"""Which parts of the environment no candidate waypoint lets a robot see."""

from __future__ import annotations

import numpy as np

from maasi_filter.settings import (
    EnvironmentSettings,
)
from maasi_planner.candidates import CandidateSet, Viewer, unseen_parts
from maasi_sim.scenario.schema import RobotSettings, Scenario

# Farther than any way between two waypoints [m].
_FAR = 1e9


def robot_candidates(robot: RobotSettings, environment: EnvironmentSettings) -> CandidateSet:
    """Return a robot's candidate waypoints; in 2D at the height of its start."""
    return CandidateSet(robot.candidates, environment.array(), height=robot.start[2])


def never_seen(scenario: Scenario) -> str:
    """Return a warning about parts that can never be seen from the candidates, or ''."""
    if any(robot.candidates.ring is not None for robot in scenario.robots.values()):
        # Waypoints that move with the robot lead anywhere.
        return ''
    bounds = scenario.environment.array()
    margin = scenario.targets.margin if scenario.targets.positions is None else 0.0
    # What is seen from the waypoints need not be checked on the paths between them.
    standing = {name: _viewer(scenario, name, _FAR) for name in scenario.names()}
    steady = {name: viewer for name, viewer in standing.items() if viewer.yaw is not None}
    if steady and not unseen_parts(bounds, steady, margin):
        return ''
    moving = {
        name: _viewer(scenario, name, robot.motion.speed * max(robot.sensor.period, scenario.step))
        for name, robot in scenario.robots.items()
    }
    return unseen_parts(bounds, moving, margin).describe()


def _viewer(scenario: Scenario, name: str, spacing: float) -> Viewer:
    robot = scenario.robots[name]
    start = np.array(robot.start)
    return Viewer(
        candidates=robot_candidates(robot, scenario.environment).at(start),
        start=start,
        sensor=robot.sensor.build(name, scenario.dimension),
        spacing=spacing,
        yaw=robot.yaw if robot.motion.heading == 'keep' else None,
    )
