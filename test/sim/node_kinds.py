"""Every type of node, with settings that it starts with, in the namespace of its robot."""

import re
from dataclasses import dataclass
from typing import Any

import yaml
from rclpy.parameter import Parameter

from maasi_drivers import drivers
from maasi_drivers.guard_node import GuardNode
from maasi_drivers.settings.driver import DriverSettings, GuardSettings
from maasi_filter.filter_node import FilterNode
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten
from maasi_planner.buildings.cuboid_planner_node import CuboidPlannerNode
from maasi_planner.buildings.settings import CuboidPlannerSettings
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planner_node import PlannerNode
from maasi_sim.run.buildings.cuboid_sim_node import CuboidSimNode
from maasi_sim.run.processes import find_executable
from maasi_sim.simulation.sim_node import SimNode, SimNodeSettings

BOUNDS = [[-0.3, 2.4], [-0.3, 2.4]]
SPACE = [[0.0, 30.0], [0.0, 30.0], [0.0, 30.0]]
BOX = {'kind': 'box', 'lower': [-0.2, -0.2], 'upper': [0.2, 0.2]}
PATIENT = {'odometry_timeout': 30.0, 'sensor_timeout': 0.0}
DRIVER = PATIENT | {
    'environment': {'bounds': BOUNDS},
    'start': [0.4, 0.3, 0.0],
    'motion': {'model': 'unicycle', 'speed': 0.2},
    'sensor': {'detection': BOX},
    'camera': {'focal_length': [120.0, 120.0]},
}
RANGING = PATIENT | {
    'environment': {'bounds': SPACE},
    'start': [5.0, 5.0, 5.0],
    'motion': {'model': 'constant_speed', 'speed': 2.0},
    'sensor': {'detection': {'kind': 'box', 'lower': [-4, -4, -6], 'upper': [4, 4, 6]}},
}
FLYING = DRIVER | {'start': [1.0, 1.0, 1.0], 'motion': {'model': 'mambo', 'tilt': 0.1}}
SEEING = FLYING | {'motion': {'model': 'constant_speed', 'speed': 2.0}}
ROBOT = {
    'candidates': {'grid': [3, 3], 'spacing': 0.5, 'corner': [0.5, 0.5]},
    'motion': {'model': 'unicycle', 'speed': 0.2},
    'sensor': {'detection': BOX, 'period': 0.5},
    'start': [0.4, 0.3, 0.0],
}
BUILDING = {
    'environment': {'bounds': [[0.0, 140.0], [0.0, 140.0], [0.0, 60.0]]},
    'start': [5.0, 5.0, 5.0],
    'objects': [[70.0, 70.0, 10.0, 20.0, 20.0, 20.0]],
}


@dataclass(frozen=True)
class Kind:
    """A type of node: class, executable, settings, namespace."""

    made: Any
    settings: Any
    namespace: str = ''

    @property
    def package(self):
        return self.made.__module__.partition('.')[0]

    @property
    def executable(self):
        return re.sub('(?<!^)(?=[A-Z])', '_', self.made.__name__).lower()

    @property
    def name(self):
        if self.executable.endswith('_driver'):
            return 'driver'
        known = {'guard_node': 'guard', 'cuboid_planner_node': 'cuboid_planner'}
        return known.get(self.executable, self.executable.removeprefix('cuboid_'))

    def parameters(self, **changes):
        model = type(self.settings)
        content = self.settings.model_dump(by_alias=True, exclude_unset=True)
        return flatten(model.model_validate(content | changes))

    def make(self, context, **changes):
        flat = self.parameters(**changes)
        return self.made(
            context=context,
            namespace=self.namespace,
            parameter_overrides=[Parameter(name, value=value) for name, value in flat.items()],
        )

    def command(self, file, namespace='', **changes):
        """Write the parameter file of a node; return its command line."""
        content = {'/**': {'ros__parameters': self.parameters(**changes)}}
        file.write_text(yaml.safe_dump(content))
        words = [str(find_executable(self.package, self.executable)), '--ros-args']
        words += ['--params-file', str(file)]
        return [*words, '-r', f'__ns:={namespace or self.namespace or "/"}']


def driver(settings):
    return DriverSettings.model_validate(settings)


KINDS = {
    'filter': Kind(
        FilterNode,
        FilterNodeSettings.model_validate(
            {
                'environment': {'bounds': BOUNDS},
                'filter': {'particles': 2000},
                'robots': {'rover': {'sensor': {'detection': BOX}}},
            }
        ),
    ),
    'planner': Kind(
        PlannerNode,
        PlannerNodeSettings.model_validate(
            {'environment': {'bounds': BOUNDS}, 'robots': {'rover': ROBOT}}
        ),
    ),
    'cuboid_planner': Kind(
        CuboidPlannerNode, CuboidPlannerSettings.model_validate(BUILDING), '/rover'
    ),
    'turtlebot': Kind(drivers.TurtlebotDriver, driver(DRIVER), '/rover'),
    'mambo': Kind(drivers.MamboDriver, driver(FLYING), '/rover'),
    'camera': Kind(drivers.CameraDriver, driver(SEEING), '/rover'),
    'ranging': Kind(drivers.RangingDriver, driver(RANGING), '/rover'),
    'mavlink': Kind(drivers.MavlinkDriver, driver(RANGING), '/rover'),
    'mavlink_camera': Kind(drivers.MavlinkCameraDriver, driver(FLYING), '/rover'),
    'guard': Kind(GuardNode, GuardSettings(), '/rover'),
    'sim': Kind(SimNode, SimNodeSettings(scenario='mambo_turtlebot')),
    'cuboid_sim': Kind(CuboidSimNode, SimNodeSettings(scenario='buildings_one')),
}
