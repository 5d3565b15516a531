"""Console scripts, imported before NumPy and rclpy so that SIGINT leaves no traceback."""

import signal
import sys
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

# What the commands import at once, and only extras require.
_OF_EXTRAS = ('distributed', 'matplotlib', 'setproctitle')


def _run(target: str, ros: bool = True) -> Any:
    """Import a function, `module:name`, and return its result, the exit code."""
    # Nothing has been created yet, so there is nothing to clean up. A node, and whatever has
    # to clean up, sets its own handler in `main`.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        # To import rclpy would end the process.
        if ros and resolve_name('maasi_filter.ros.middleware:is_missing')():
            return 2
        return resolve_name(target)()
    except ModuleNotFoundError as error:
        missing = error.name or ''
        package = missing.partition('.')[0]
        if package.startswith(('ament_', 'rcl')) or package.endswith(
            ('_interfaces', '_msgs', '_srvs')
        ):
            needed = 'it needs ROS 2 Jazzy and maasi_msgs, built and sourced'
        elif package in _OF_EXTRAS:
            needed = 'it comes with an extra of the package'
        else:
            raise
        name = Path(sys.argv[0]).name
        print(f'error: {name}: no module {missing}: {needed} (docs/install.md)', file=sys.stderr)
        return 2


filter_node = partial(_run, 'maasi_filter.filter_node:main')
cuboid_planner_node = partial(_run, 'maasi_planner.buildings.cuboid_planner_node:main')
planner_node = partial(_run, 'maasi_planner.planner_node:main')
mambo_driver = partial(_run, 'maasi_drivers.drivers:mambo_driver')
turtlebot_driver = partial(_run, 'maasi_drivers.drivers:turtlebot_driver')
plugin_driver = partial(_run, 'maasi_drivers.plugin_driver:main')
ranging_driver = partial(_run, 'maasi_drivers.drivers:ranging_driver')
measurement_feed_sender = partial(_run, 'maasi_drivers.measurement_feed_sender:main', ros=False)
mavlink_driver = partial(_run, 'maasi_drivers.drivers:mavlink_driver')
mavlink_camera_driver = partial(_run, 'maasi_drivers.drivers:mavlink_camera_driver')
calibrate_sensor = partial(_run, 'maasi_drivers.calibrate_sensor:main')
mambo_onboard_driver = partial(_run, 'maasi_drivers.drivers:mambo_onboard_driver')
team_command = partial(_run, 'maasi_drivers.team_command:main')
measure_mambo = partial(_run, 'maasi_drivers.measure_mambo:main', ros=False)
guard_node = partial(_run, 'maasi_drivers.guard_node:main')
cuboid_sim_node = partial(_run, 'maasi_sim.run.buildings.cuboid_sim_node:main')
sim_node = partial(_run, 'maasi_sim.simulation.sim_node:main')
fake_mambo = partial(_run, 'maasi_sim.simulation.emulators.mambo.fake_mambo:main', ros=False)
fake_mavlink_vehicle = partial(
    _run, 'maasi_sim.simulation.emulators.mavlink.fake_mavlink_vehicle:main', ros=False
)
view_node = partial(_run, 'maasi_sim.run.view.view_node:main')
compare = partial(_run, 'maasi_sim.experiments.compare:main', ros=False)
run_scenario = partial(_run, 'maasi_sim.run.run_scenario:main', ros=False)  # it looks itself
