"""Compilation of what the nodes use, before anything waits for it."""

from __future__ import annotations

import gc
from collections.abc import Callable
from importlib.metadata import distribution
from typing import Any

import maasi_filter
import maasi_planner
from maasi_drivers.warm_up import warm_up as warm_up_drivers
from maasi_sim.buildings.scenario import load_cuboid_scenario, mission_of
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.world.simulation import simulated_robot

_PACKAGES = ('maasi_filter', 'maasi_planner', 'maasi_drivers', 'maasi_sim')


def warm_up() -> None:
    """Compile, or load from the cache, all kernels of simulated robots, by playing one of each."""
    for name in ('mambo_turtlebot_obstacles', 'ranging_pair_3d'):
        scenario = load_scenario(name)
        world = scenario.world(scenario.seed)
        for robot_name in scenario.names():
            robot = simulated_robot(robot_name, scenario, world, scenario.seed)
            robot.warm_up()
            robot.step(1, scenario.step)
    mission_of(load_cuboid_scenario('buildings_four')).run(1)


def warm_up_all() -> None:
    """Compile, or load from the cache, the kernels of all packages."""
    maasi_filter.warm_up()
    maasi_planner.warm_up()
    warm_up_drivers()
    warm_up()
    # What is there now stays: copies of this process share it.
    gc.collect()
    gc.freeze()


def main_of(package: str, executable: str) -> Callable[[], Any] | None:
    """Return what runs an executable of this suite, or None for one of another package.

    The node itself is imported when it is called: rclpy starts threads, and a process with several
    threads must not be forked.
    """
    if package not in _PACKAGES:
        return None
    scripts = distribution(package).entry_points
    (script,) = scripts.select(group='console_scripts', name=executable)
    main: Callable[[], Any] = script.load()
    return main
