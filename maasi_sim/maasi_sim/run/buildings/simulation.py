"""Simulated robots that search buildings (paper 004), and their clock."""

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.models.pose import Pose
from maasi_planner.buildings.dynamics import Dynamics
from maasi_planner.buildings.preplanning import CoveragePlan
from maasi_planner.motion import RobotState
from maasi_planner.motion.base import check_command
from maasi_sim.run.buildings.scenario import CuboidScenario
from maasi_sim.simulation.odometry import OdometryModel, OdometryReading
from maasi_sim.simulation.robots import Battery, SimulatedTeam


class SearchingRobot:
    """A mass point under a force per step, paper 004 eq. (1); without one it brakes and hovers."""

    camera = ranging = laser = None

    def __init__(
        self, name: str, scenario: CuboidScenario, mission: CoveragePlan, seed: int
    ) -> None:
        settings = scenario.robots[name]
        self.name = name
        self.collisions = 0
        self.settings = settings
        self.battery = Battery(settings.battery)
        self._mission = mission
        self._dynamics = Dynamics(settings.dynamics, scenario.step)
        start = Pose.from_yaw(settings.start, settings.yaw)
        self.state = RobotState(start, np.zeros(3))
        self._command = np.zeros(4)
        self._odometry = OdometryModel(settings.odometry, start, seed, name)
        self.odometry: OdometryReading = self._odometry.step(self.state, 0)

    def command(self, velocity: ArrayLike) -> None:
        """Set the velocity (4,) for the next step [m/s, rad/s]."""
        self._command = check_command(velocity)

    def step(self, step: int, dt: float) -> None:
        """Advance by `dt` seconds to the discrete step `step` (from 1)."""
        pose = self.state.pose
        control = self._dynamics.control_for(
            self.state.velocity, pose.rotation() @ self._command[:3]
        )
        self._command = np.zeros(4)
        place, velocity = self._dynamics.next(pose.position, self.state.velocity, control)
        self.state = RobotState(Pose(place, pose.orientation), velocity)
        self.collisions += self._mission.path_hits(pose.position, place)
        self.battery.drain(float(np.linalg.norm(velocity)), dt)
        self.odometry = self._odometry.step(self.state, step)

    def stand(self, step: int) -> None:
        """Stand still until the discrete step `step`, ignoring the last command."""
        self._command = np.zeros(4)
        self.state = RobotState(self.state.pose, np.zeros(3))
        self.odometry = self._odometry.step(self.state, step)


class CuboidSimulation(SimulatedTeam):
    """The robots of a search of buildings."""

    scenario: CuboidScenario
    robots: dict[str, SearchingRobot]

    def __init__(self, scenario: CuboidScenario, seed: int) -> None:
        self.world = scenario.world(seed)
        self.mission = scenario.mission()
        robots = {
            name: SearchingRobot(name, scenario, self.mission, seed) for name in scenario.names()
        }
        super().__init__(scenario, robots)

    def warm_up(self) -> None:
        """Do nothing: nothing is compiled."""

    def images_due(self, name: str) -> bool:
        """Return false: planners take the snapshots."""
        return False
