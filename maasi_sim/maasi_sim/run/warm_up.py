"""What nodes need at their start, done once in the process that they are forked from."""

from __future__ import annotations

import importlib
import inspect

import numpy as np

import maasi_filter
import maasi_planner
from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_planner.settings import PLANNERS
from maasi_sim.run.buildings.scenario import load_cuboid_scenario, mission_of
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.simulation.simulated_world import Simulation

# Messages of all nodes that take longest to import; importing them starts no threads.
_MESSAGES = ('maasi_msgs', 'rcl_interfaces', 'sensor_msgs', 'visualization_msgs')


def warm_up() -> None:
    """Compile, or load from the cache, the kernels of simulations."""
    _simulate()
    mission_of(load_cuboid_scenario('buildings_four')).run(1)


def _simulate() -> None:
    """Simulate one step of robots of each kind, and look for markers."""
    MarkerDetector(CameraSettings()).segment(np.zeros((120, 160, 3), np.uint8))
    for name in ('mambo_turtlebot_obstacles', 'ranging_pair_3d'):
        simulation = Simulation(load_scenario(name), 1)
        simulation.warm_up()
        simulation.advance()


def prepare_nodes() -> None:
    """Do once what nodes would do at their start, for nodes that are forked from here.

    Kernels are those of searches for targets: in a search of buildings each node loads its own.
    """
    maasi_filter.warm_up()
    maasi_planner.warm_up()
    _simulate()
    for package in _MESSAGES:
        importlib.import_module(f'{package}.msg')
    # Messages import it at their first use.
    importlib.import_module('rosidl_generator_py')
    # Searches of all installed packages and of all modules, which a node needs for its parameters
    # and for its first log message.
    PLANNERS.names()
    inspect.getmodule(inspect.currentframe())
