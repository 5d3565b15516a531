"""Which parts of the environment no candidate waypoint lets a robot see."""

from typing import Any

import numpy as np

from maasi_filter.area import Area
from maasi_filter.environment import EnvironmentSettings
from maasi_planner.candidates import CandidateSet, Viewer, half_view, unseen_parts
from maasi_planner.settings import CandidateSettings
from maasi_sim.scenario.schema import RobotSettings, Scenario

_FAR = 1e9  # farther than any way between two waypoints [m]
_MOST_CANDIDATES = 400  # of a grid that is chosen for a robot without candidates


def robot_candidates(robot: RobotSettings, environment: EnvironmentSettings) -> CandidateSet:
    """Return a robot's candidate waypoints; in 2D at the height of its start."""
    return CandidateSet(robot.candidates, Area(environment), height=robot.start[2])


def never_seen(scenario: Scenario) -> str:
    """Return a warning about parts that can never be seen from the candidates, or ''."""
    if any(robot.candidates.ring is not None for robot in scenario.robots.values()):
        return ''  # candidates that move with the robot can reach every place
    area = Area(scenario.environment)
    margin = scenario.targets.margin if scenario.targets.positions is None else 0.0
    # What is seen from the waypoints need not be checked on the paths between them.
    standing = [_viewer(scenario, name, _FAR) for name in scenario.names()]
    steady = [viewer for viewer in standing if viewer.yaw is not None]
    if steady and not unseen_parts(area, steady, margin):
        return ''
    moving = [
        _viewer(scenario, name, robot.motion.speed * max(robot.sensor.period, scenario.step))
        for name, robot in scenario.robots.items()
    ]
    return unseen_parts(area, moving, margin).describe()


def covering_grid(
    name: str, robot: RobotSettings, environment: EnvironmentSettings
) -> dict[str, Any]:
    """Return a grid of candidates over the bounds from which a robot sees everything.

    Its spacing is at most the width of what the sensor sees; where that takes too many waypoints,
    it is a coarser grid, and `never_seen` warns.
    """
    area = Area(environment)
    bounds = area.bounds
    sides = bounds[:, 1] - bounds[:, 0]
    sensor = robot.sensor.build(name, environment.dimension)
    start = np.array(robot.start)
    width = min(2.0 * half_view(sensor), float(sides.max()))
    while np.ceil(sides / width).prod() > _MOST_CANDIDATES:
        width *= 1.1
    first: dict[str, Any] = {}
    while True:
        numbers = np.ceil(sides / width - 1e-9).astype(int)
        if first and numbers.prod() > _MOST_CANDIDATES:
            # A finer grid would be too large; `never_seen` reports what stays unseen.
            return first
        spacing = sides / numbers
        grid = {
            'grid': numbers.tolist(),
            'spacing': spacing.tolist(),
            'corner': (bounds[:, 0] + 0.5 * spacing).tolist(),
        }
        candidates = CandidateSet(CandidateSettings.model_validate(grid), area, robot.start[2])
        yaw = robot.yaw if robot.motion.heading == 'keep' else None
        if not unseen_parts(area, [Viewer(candidates.at(start), start, sensor, _FAR, yaw)]):
            return grid
        first = first or grid
        width *= 0.8


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
