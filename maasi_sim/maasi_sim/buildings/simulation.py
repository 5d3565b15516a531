"""Robots that search buildings, on one clock, and their link of limited range (004)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_planner.buildings import CoveragePlan, Dynamics
from maasi_planner.motion import Body, RobotState
from maasi_planner.motion.base import check_command
from maasi_planner.settings import MotionSettings
from maasi_sim.buildings.mission import within_range
from maasi_sim.buildings.scenario import CuboidScenario
from maasi_sim.world.odometry import OdometryModel, OdometryReading
from maasi_sim.world.robots import Battery, Equipment
from maasi_sim.world.simulation import SimulatedTeam


class MassPointBody(Body):
    """A mass point under bounded forces, 004, (1): the force that reaches a commanded velocity."""

    def __init__(self, dynamics: Dynamics, pose: Pose, velocity: ArrayLike) -> None:
        self._dynamics = dynamics
        self._orientation = pose.orientation
        self._position = pose.position
        self._velocity = np.array(velocity, dtype=float)

    def step(self, velocity_command: ArrayLike, dt: float) -> None:
        """See `Body.step`; `dt` is that of the dynamics."""
        if abs(dt - self._dynamics.step) > 1e-9:
            raise ValueError(f'dt: got {dt} s, allowed is {self._dynamics.step} s')
        pose = Pose(self._position, self._orientation)
        wanted = pose.rotation() @ check_command(velocity_command)[:3]
        control = self._dynamics.control_for(self._velocity, wanted)
        self._position, self._velocity = self._dynamics.next(
            self._position, self._velocity, control
        )

    def robot_state(self) -> RobotState:
        """See `Body.robot_state`."""
        return RobotState(Pose(self._position, self._orientation), self._velocity)


class SearchingRobot:
    """A simulated robot that searches buildings.

    A command holds for one step. Without one it brakes and hovers, as autopilots do.
    """

    camera = ranging = laser = None

    def __init__(
        self, name: str, scenario: CuboidScenario, mission: CoveragePlan, seed: int
    ) -> None:
        settings = scenario.robots[name]
        self.name = name
        self.collisions = 0
        self.equipment = Equipment(
            motion=MotionSettings(),
            radius=0.0,
            camera=None,
            sensor=None,
            laser=None,
            odometry=settings.odometry,
            battery=settings.battery,
        )
        self.battery = Battery(settings.battery)
        self._mission = mission
        self._dynamics = Dynamics.from_settings(settings.dynamics, scenario.step)
        start = Pose.from_yaw(settings.start, settings.yaw)
        self._body = MassPointBody(self._dynamics, start, np.zeros(3))
        self.state = self._body.robot_state()
        self._command: FloatArray | None = None
        self._odometry = OdometryModel(settings.odometry, start, seed, name)
        self.odometry: OdometryReading = self._odometry.step(self.state, 0)

    def command(self, velocity: ArrayLike) -> None:
        """Set the velocity (4,) for the next step [m/s, rad/s]."""
        self._command = check_command(velocity)

    def step(self, step: int, dt: float) -> None:
        """Advance by `dt` seconds to the discrete step `step`, from 1."""
        before = self.state
        command, self._command = self._command, None
        self._body.step(np.zeros(4) if command is None else command, dt)
        self.state = self._body.robot_state()
        if self._mission.way_hits(before.pose.position, self.state.pose.position):
            self.collisions += 1
        self.battery.drain(float(np.linalg.norm(self.state.velocity)), dt)
        self.odometry = self._odometry.step(self.state, step)

    def stand(self, step: int) -> None:
        """Stand still until the discrete step `step`; the last command is void."""
        self._command = None
        self._body = MassPointBody(self._dynamics, self.state.pose, np.zeros(3))
        self.state = self._body.robot_state()
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
        """Do nothing: there is nothing to compile."""

    def images_due(self, name: str) -> bool:
        """Return false: snapshots are taken by the planners."""
        return False

    def scan_due(self, name: str) -> bool:
        """Return false: there is no laser scanner."""
        return False

    def heard_by(self, senders: list[str]) -> dict[str, list[str]]:
        """Return the senders within C_R of each sender (III-B)."""
        places = {name: self.robots[name].state.pose.position for name in senders}
        return within_range(places, self.scenario.planner.communication_range)
