"""Work that all nodes need at their start, done once in the process that forks them."""

import importlib
import inspect
from pathlib import Path

import numpy as np

from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.marker_detector import MarkerDetector
from maasi_planner.settings import PLANNERS
from maasi_sim.compiling import compiling_said
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.simulation.robots import Simulation

# Messages of all nodes; importing them starts no threads.
_MESSAGES = ('diagnostic', 'geometry', 'lifecycle', 'maasi', 'nav', 'sensor', 'visualization')
_SERVICES = ('lifecycle_msgs.srv', 'maasi_msgs.action', 'rcl_interfaces.srv', 'std_srvs.srv')


def warm_up() -> None:
    """Compile, or load from the cache, the kernels of simulations."""
    _simulate('mambo_turtlebot_obstacles', 'ranging_pair_3d')
    # Missions with their own scenarios: without messages, which may not be built yet.
    for path in sorted(Path(__file__).parent.glob('*/scenario.py')):
        importlib.import_module(f'{__package__}.{path.parent.name}.scenario').warm_up()


def _simulate(*names: str) -> None:
    MarkerDetector(CameraSettings()).segment(np.zeros((120, 160, 3), np.uint8))
    for name in names:
        simulation = Simulation(load_scenario(name), 1)
        simulation.warm_up()
        simulation.advance()


def prepare_nodes() -> None:
    """Do in advance what each forked node would do at its start."""
    with compiling_said():
        _simulate('mambo_turtlebot')
    for name in (*(f'{name}_msgs.msg' for name in _MESSAGES), *_SERVICES):
        importlib.import_module(name)
    importlib.import_module('rosidl_generator_py')  # messages import it at their first use
    # Searches of packages and modules, needed for parameters and the first log message.
    PLANNERS.names()
    inspect.getmodule(inspect.currentframe())
