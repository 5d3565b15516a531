"""Compilation of what the simulation uses, before anything waits for it."""

from __future__ import annotations

from pathlib import Path

from maasi_filter.pose import Pose
from maasi_sim.robots import Equipment, SimulatedRobot
from maasi_sim.scenario import config_folder, load_scenario


def warm_up() -> None:
    """Compile, or load from the cache, all kernels of simulated robots, by playing one of each."""
    folder: Path = config_folder() / 'scenarios'
    for name in ('mambo_turtlebot_obstacles', 'ranging_pair_3d'):
        scenario = load_scenario(folder / f'{name}.yaml')
        world = scenario.world(scenario.seed)
        for robot_name in scenario.names():
            settings = scenario.robots[robot_name]
            ranging = settings.camera is None
            equipment = Equipment(
                motion=settings.motion,
                radius=settings.radius,
                camera=settings.camera,
                sensor=settings.sensor.build(robot_name, scenario.dimension) if ranging else None,
                laser=settings.laser,
                odometry=settings.odometry,
                battery=settings.battery,
            )
            start = Pose.from_yaw(settings.start, settings.yaw)
            robot = SimulatedRobot(
                robot_name, equipment, start, world, scenario.floor, scenario.seed
            )
            robot.warm_up()
            robot.step(1, scenario.step)
