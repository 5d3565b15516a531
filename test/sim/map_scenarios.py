"""Scenarios in which a ground robot searches the maps of `made_maps`, or others of their kind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import shapely

from maasi_filter.geometry.occupancy_map import read_map

PERFECT = {'position_noise': 0.0, 'heading_noise': 0.0, 'velocity_noise': 0.0}


def room_scenario(map_file: Path) -> dict[str, Any]:
    """Return a search of a room of 5 m by a robot of the size of a TurtleBot3 Burger."""
    return _scenario(
        map_file,
        bounds=[[-3.0, 3.0], [-2.6, 2.6]],
        start=[-2.0, -0.5, 0.0],
        targets=[[-1.6, 0.4], [0.5, 0.6], [1.7, -0.3], [0.6, -1.7]],
        robot={
            'radius': 0.11,
            'motion': {'speed': 0.2, 'acceleration': 0.5, 'yaw_rate': 1.8, 'yaw_acceleration': 4.0},
            'candidates': {'grid': [18, 18], 'spacing': [0.33, 0.28], 'corner': [-2.8, -2.4]},
        },
        view=0.6,
        tolerance=0.05,
        time=600.0,
    )


def hall_scenario(map_file: Path) -> dict[str, Any]:
    """Return a search of a hall of 30 m x 50 m by a robot of the size of a TurtleBot3 Waffle."""
    return _scenario(
        map_file,
        bounds=[[-15.0, 15.0], [-25.0, 25.0]],
        start=[0.0, 2.5, 0.0],
        targets=[[-13.0, -20.0], [-5.0, -14.0], [1.0, -23.5], [12.0, -10.0], [-13.0, 10.0]],
        robot={
            'radius': 0.22,
            'motion': {'speed': 1.0, 'acceleration': 0.8, 'yaw_rate': 1.6, 'yaw_acceleration': 3.0},
            'candidates': {'grid': [9, 15], 'spacing': [3.3, 3.3], 'corner': [-13.2, -23.1]},
        },
        view=3.0,
        tolerance=0.15,
        time=1500.0,
    )


def _scenario(
    map_file: Path,
    *,
    bounds: list[list[float]],
    start: list[float],
    targets: list[list[float]],
    robot: dict[str, Any],
    view: float,
    tolerance: float,
    time: float,
) -> dict[str, Any]:
    robot['motion'] |= {'tolerance': tolerance, 'clearance': 0.08}
    sensor = {
        'period': 1.0,
        'detection': {'kind': 'box', 'probability': 0.9, 'lower': [-view] * 2, 'upper': [view] * 2},
        'noise': {'range': 0.02, 'bearing': 0.01, 'as': 'deviation', 'angles': 'radians'},
    }
    return {
        'version': 1,
        'environment': {'bounds': bounds, 'obstacles': [str(map_file)], 'expected_targets': 4.0},
        'step': 0.2,
        'targets': {'positions': targets},
        'robots': {
            'rover': {
                'type': 'rover',
                'start': start,
                'odometry': PERFECT,
                'sensor': sensor,
                **robot,
            }
        },
        'filter': {'method': 'pmb'},
        'stop': 'planner_done',
        'limits': {'time': time},
    }


class Watched:
    """True positions of a search's robots, and how near they came to what a map shows as solid."""

    def __init__(self, running: Any) -> None:
        self.positions: dict[str, list[np.ndarray]] = {
            name: [] for name in running.simulation.robots
        }
        advance = running.simulation.advance

        def watched() -> None:
            advance()
            for name, robot in running.simulation.robots.items():
                self.positions[name].append(np.array(robot.state.pose.position))

        running.simulation.advance = watched

    def nearest(self, name: str, map_file: Path) -> float:
        """Return how near the middle of a robot came to an occupied cell [m]."""
        solid = read_map(str(map_file))
        return float(
            shapely.distance(solid, shapely.points(np.array(self.positions[name])[:, :2])).min()
        )
