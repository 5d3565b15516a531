"""Simulated robots on one clock, with the events of the scenario."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.schema import Scenario, steps_of
from maasi_sim.simulation.robots import SimulatedRobot


class SimulatedTeam:
    """Robots of a scenario on one clock, from step 0, with events applied.

    `away` are those that have left: they stand still and are silent.
    """

    def __init__(self, scenario: BaseScenario, robots: dict[str, Any]) -> None:
        self.scenario: Any = scenario
        self.robots = robots
        self.step = 0
        self.away: set[str] = set()
        self._events: dict[int, list[tuple[str, str]]] = {}
        for event in sorted(scenario.events, key=lambda event: event.at):
            # The first step at or after it; a time as close as this to a step is the step's.
            step = math.ceil(event.at / scenario.step - 1e-6)
            self._events.setdefault(step, []).append((event.robot, event.do))
        self._apply_events()

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.step * self.scenario.step

    @property
    def present(self) -> list[str]:
        """Robots that take part, in name order."""
        return [name for name in self.robots if name not in self.away]

    def advance(self) -> None:
        """Advance by one step, each robot under its last command."""
        self.step += 1
        for name, robot in self.robots.items():
            if name in self.away:
                robot.stand(self.step)
            else:
                robot.step(self.step, self.scenario.step)
        self._apply_events()

    def _apply_events(self) -> None:
        for name, change in self._events.get(self.step, []):
            (self.away.add if change == 'leave' else self.away.discard)(name)


class Simulation(SimulatedTeam):
    """The robots of a search for targets."""

    scenario: Scenario
    robots: dict[str, SimulatedRobot]

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.world = scenario.world(seed)
        robots = {
            name: SimulatedRobot(name, scenario.robots[name], self.world, scenario.floor, seed)
            for name in scenario.names()
        }
        self._image_steps = {
            name: steps_of(robot.settings.measuring_period, scenario.step)
            for name, robot in robots.items()
        }
        super().__init__(scenario, robots)

    def warm_up(self) -> None:
        """Compile, or load from the cache, what the robots use; nothing changes."""
        for robot in self.robots.values():
            robot.warm_up()

    def images_due(self, name: str) -> bool:
        """Return whether the camera, or the ranging sensor, of a robot has data at this step."""
        return name not in self.away and self.step % self._image_steps[name] == 0

    def scan_due(self, name: str) -> bool:
        """Return whether the laser scanner of a robot has data at this step."""
        laser = self.scenario.robots[name].laser
        return (
            laser is not None
            and name not in self.away
            and self.step % steps_of(1.0 / laser.rate, self.scenario.step) == 0
        )

    def scan(self, name: str) -> NDArray[np.float32]:
        """Return a laser scan (beams,) [m] that shows the other robots at its height as well."""
        robot = self.robots[name]
        height, radius = robot.state.pose.position[2], robot.settings.radius
        others = [
            other
            for key, other in self.robots.items()
            if key != name
            and abs(other.state.pose.position[2] - height) <= radius + other.settings.radius
        ]
        return robot.scan(
            self.step,
            [other.state.pose.position[:2] for other in others],
            [other.settings.radius for other in others],
        )
