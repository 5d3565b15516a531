"""What nodes need at their start, done once before they are forked from a process."""

from __future__ import annotations

import gc
import importlib
import inspect
from collections.abc import Callable
from importlib.metadata import distribution
from typing import Any

import maasi_filter
import maasi_planner
from maasi_drivers.vision.marker_detector import warm_up as warm_up_drivers
from maasi_planner.settings import PLANNERS
from maasi_sim.buildings.scenario import warm_up_buildings
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.world.simulation import simulated_robot

# What most nodes exchange; importing messages starts no threads.
_MESSAGES = (
    'diagnostic_msgs',
    'lifecycle_msgs',
    'maasi_msgs',
    'nav_msgs',
    'rcl_interfaces',
    'rosgraph_msgs',
    'sensor_msgs',
    'tf2_msgs',
    'visualization_msgs',
)
_PACKAGES = ('maasi_filter', 'maasi_planner', 'maasi_drivers', 'maasi_sim')


def warm_up() -> None:
    """Compile, or load from the cache, all kernels of simulations."""
    _play_robots()
    warm_up_buildings()


def warm_up_search() -> None:
    """Compile, or load from the cache, the kernels of searches for targets."""
    maasi_filter.warm_up()
    maasi_planner.warm_up()
    warm_up_drivers()
    _play_robots()


def _play_robots() -> None:
    """Play one simulated robot of each kind."""
    for name in ('mambo_turtlebot_obstacles', 'ranging_pair_3d'):
        scenario = load_scenario(name)
        world = scenario.world(scenario.seed)
        for robot_name in scenario.names():
            robot = simulated_robot(robot_name, scenario, world, scenario.seed)
            robot.warm_up()
            robot.step(1, scenario.step)


def prepare_copies() -> None:
    """Do once what every node would do at its start, for copies of this process."""
    for package in _MESSAGES:
        importlib.import_module(f'{package}.msg')
    # Messages import it at their first use.
    importlib.import_module('rosidl_generator_py')
    # Searches of all installed packages and of all modules, which a node needs for its parameters
    # and for its first log message.
    PLANNERS.names()
    inspect.getmodule(inspect.currentframe())
    # Exclude what exists now from garbage collection: forked processes share its memory.
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
