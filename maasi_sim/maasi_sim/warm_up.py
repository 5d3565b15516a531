"""Compilation of what the simulation uses, before anything waits for it."""

from __future__ import annotations

from maasi_sim.scenario import load_scenario
from maasi_sim.simulation import simulated_robot


def warm_up() -> None:
    """Compile, or load from the cache, all kernels of simulated robots, by playing one of each."""
    for name in ('mambo_turtlebot_obstacles', 'ranging_pair_3d'):
        scenario = load_scenario(name)
        world = scenario.world(scenario.seed)
        for robot_name in scenario.names():
            robot = simulated_robot(robot_name, scenario, world, scenario.seed)
            robot.warm_up()
            robot.step(1, scenario.step)
