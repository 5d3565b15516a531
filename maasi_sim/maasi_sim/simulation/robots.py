"""Simulated robots: a body under velocity commands, with battery, odometry and sensors.

A team of them has one clock and the events of the scenario.
"""

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_drivers.agent.sensor_reading import Sweep
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.terrain import Terrain
from maasi_filter.models.pose import Pose
from maasi_filter.records import UNLABELLED
from maasi_planner.motion import Body, RobotState, make_motion
from maasi_planner.motion.base import check_command
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.schema import BatterySettings, RobotSettings, Scenario, steps_of
from maasi_sim.simulation.camera import CameraRenderer
from maasi_sim.simulation.floor import RenderSettings, scene_of
from maasi_sim.simulation.odometry import OdometryModel, OdometryReading
from maasi_sim.simulation.sensors import LaserScanner, RangingSensor
from maasi_sim.simulation.world import World


class Battery:
    """A battery, drained by idling and moving."""

    def __init__(self, settings: BatterySettings) -> None:
        self.settings = settings
        self.charge = settings.charge

    @property
    def empty(self) -> bool:
        """Whether no charge is left."""
        return self.charge <= 0.0

    def drain(self, speed: float, dt: float) -> None:
        """Drain the battery by `dt` seconds at a speed [m/s]."""
        power = self.settings.idle_power + self.settings.motion_power * speed
        self.charge = max(self.charge - power * dt / self.settings.capacity, 0.0)

    def charging(self, dt: float) -> None:
        """Charge it for `dt` seconds."""
        self.charge = min(
            self.charge + self.settings.power_at_charger * dt / self.settings.capacity, 1.0
        )


class Leader(Protocol):
    """Moves a robot instead of its simulated body."""

    @property
    def state(self) -> RobotState:
        """True state, in the map."""


class SimulatedRobot:
    """A simulated robot; its name keys its noise.

    A command holds until the next one, as without a watchdog. A robot stops before obstacles;
    with an empty battery it stops or sinks to the floor.
    """

    def __init__(
        self, name: str, settings: RobotSettings, world: World, floor: RenderSettings, seed: int
    ) -> None:
        self.name, self.settings, self.world = name, settings, world
        self.collisions = 0
        start = Pose.from_yaw(world.area.above_ground(settings.start), settings.yaw)
        self._motion = make_motion(settings.motion)
        self._body: Body = self._motion.body(RobotState(start))
        self.state = self._body.robot_state()
        if self._hits(self.state.pose.position):
            raise ValueError(
                f'{name}: got start {start.position.tolist()}, allowed are positions at least its '
                f'radius ({settings.radius} m) from every obstacle'
            )
        self._command = np.zeros(4)
        self._flies = settings.flies
        self._resting = False
        self._terrain = world.area.terrain
        #: Wind (3,) [m/s, map], which carries a flying robot.
        self.wind = np.zeros(3)
        self.battery = Battery(settings.battery)
        self._chargers = _chargers(settings)
        self._at_charger = 2.0 * settings.motion.tolerance + settings.radius
        odometry = settings.simulated.odometry or settings.odometry
        self._odometry = OdometryModel(odometry, start, seed, name, settings.odometry)
        self.odometry: OdometryReading = self._odometry.step(self.state, 0)
        self._leader: Leader | None = None
        self.camera: CameraRenderer | None = None
        self.ranging: RangingSensor | None = None
        if settings.camera is not None:
            camera, shapes = Camera.from_settings(settings.camera), scene_of(world, floor, seed)
            self.camera = CameraRenderer(camera, floor, shapes, seed, name, world.area.terrain)
        else:
            sensor = settings.simulated.sensor(settings.sensor, name, world.bounds)
            targets = world.targets_3d_at(0)
            self.ranging = RangingSensor(
                sensor, targets, seed, name, world.bounds, world.area.terrain
            )
        self.laser: LaserScanner | None = None
        if settings.laser is not None:
            self.laser = LaserScanner(settings.laser, world.area, seed, name)

    def command(self, velocity: ArrayLike) -> None:
        """Set the velocity command (4,), which holds until the next one.

        vx, vy, vz [m/s, axes turned by the heading], yaw rate [rad/s].
        """
        self._command = check_command(velocity)

    def follow(self, leader: Leader) -> None:
        """Take the state from `leader` from now on."""
        self._leader = leader
        self.state = leader.state

    def step(self, step: int, dt: float) -> None:
        """Advance by `dt` seconds to the discrete step `step`, from 1."""
        if self._leader is not None:
            was_clear = not self._hits(self.state.pose.position)
            self.state = self._leader.state
            self.collisions += was_clear and self._hits(self.state.pose.position)
            self.odometry = self._odometry.step(self.state, step)
            return
        command = self._command
        if self.battery.empty:
            command = np.array([0.0, 0.0, -0.3 if self._flies else 0.0, 0.0])
        before = self.state
        if not self._resting:
            self._move(command, dt)
            position = self.state.pose.position
            if self._hits(position):
                self.collisions += 1
                self._halt(before.pose)
            elif self._flies and self.battery.empty and position[2] <= self._ground(position):
                landed = np.array([position[0], position[1], self._ground(position)])
                self._halt(Pose(landed, before.pose.orientation))
                self._resting = True
            elif self._terrain is not None:
                self._stay_on(self._terrain, before)
        velocity = self.state.velocity
        speed = float(np.sqrt((velocity * velocity).sum()))
        # In 2D a charger on the ground charges a drone above it, as the planner assumes.
        offsets = (self._chargers - self.state.pose.position)[:, : self.world.area.dimension]
        gaps = np.linalg.norm(offsets, axis=1)
        if speed < 0.1 and gaps.min(initial=math.inf) < self._at_charger:
            self.battery.charging(dt)
        elif self._carried:
            self.battery.drain(float(np.linalg.norm(velocity - self.wind)), dt)
        else:
            self.battery.drain(speed, dt)
        self.odometry = self._odometry.step(self.state, step)

    def stand(self, step: int) -> None:
        """Stand still until the discrete step `step`, ignoring the last command."""
        if self._leader is not None:
            self.step(step, 0.0)
            return
        self._command = np.zeros(4)
        if self.state.velocity.any() or self.state.angular_velocity.any():
            self._halt(self.state.pose)
        self.odometry = self._odometry.step(self.state, step)

    def image(self, step: int, time: float) -> NDArray[np.uint8]:
        """Return the camera image, (h, w, 3) uint8 in R, G, B."""
        assert self.camera is not None, 'no camera'
        state = self.state
        return self.camera.render(state.pose, step, time, state.velocity, state.angular_velocity)

    def scan(
        self, step: int, centres: ArrayLike = (), radii: ArrayLike = ()
    ) -> NDArray[np.float32]:
        """Return a laser scan (beams,) [m]; `centres` (n, 2) and `radii` (n,) of other robots."""
        assert self.laser is not None, 'no laser scanner'
        return self.laser.scan(self.state.pose, step, centres, radii)

    def sweep(self, step: int) -> Sweep:
        """Return a sweep of the ranging sensor."""
        assert self.ranging is not None, 'no ranging sensor'
        world = self.world
        values, causes = self.ranging.measure(self.state.pose, step, world.targets_3d_at(step))
        if not world.labels:
            return Sweep(values)
        return Sweep(
            values, tuple(UNLABELLED if i < 0 else world.labels[i] for i in causes.tolist())
        )

    def warm_up(self) -> None:
        """Compile, or load from the cache, the kernels of this robot."""
        self._motion.body(self.state).step(np.zeros(4), 0.05)
        if self.camera is not None:
            self.image(0, 0.0)
        if self.laser is not None:
            self.scan(0)
        if self.ranging is not None:
            self.sweep(0)

    @property
    def _carried(self) -> bool:
        return self._flies and not self._resting and bool(self.wind.any())

    def _move(self, command: FloatArray, dt: float) -> None:
        """Move the body by a command, in the air that the wind moves.

        The body follows the commanded ground velocity within its air speed; gusts and wind
        shear are not simulated.
        """
        if not self._carried:
            self._body.step(command, dt)
            self.state = self._body.robot_state()
            return
        ground, yaw = self.state, self.state.pose.yaw
        body = self._motion.body(
            RobotState(ground.pose, ground.velocity - self.wind, ground.angular_velocity)
        )
        x, y = self.wind[:2]
        along = [math.cos(yaw) * x + math.sin(yaw) * y, math.cos(yaw) * y - math.sin(yaw) * x]
        body.step(command - np.array([*along, self.wind[2], 0.0]), dt)
        after = body.robot_state()
        pose = Pose(after.pose.position + self.wind * dt, after.pose.orientation)
        self.state = RobotState(pose, after.velocity + self.wind, after.angular_velocity)
        self._body = self._motion.body(self.state)

    def _ground(self, position: FloatArray) -> float:
        return 0.0 if self._terrain is None else self._terrain.height(position)

    def _stay_on(self, terrain: Terrain, before: RobotState) -> None:
        """Move a robot on the ground to its height; stop a flying one that hits the ground."""
        position = self.state.pose.position
        if self._flies:
            if position[2] >= terrain.height(position):
                return
            self.collisions += 1
            self._halt(before.pose)
            return
        above = np.array([position[0], position[1], self.settings.start[2]])
        pose = Pose(self.world.area.above_ground(above), self.state.pose.orientation)
        self.state = RobotState(pose, self.state.velocity, self.state.angular_velocity)

    def _halt(self, pose: Pose) -> None:
        self._body = self._motion.body(RobotState(Pose.from_yaw(pose.position, pose.yaw)))
        self.state = self._body.robot_state()

    def _hits(self, position: FloatArray) -> bool:
        distances = self.world.area.distances(position)
        return bool(len(distances) and distances.min() < self.settings.radius)


def _chargers(settings: RobotSettings) -> FloatArray:
    """Return the chargers of a robot, (n, 3): empty if it cannot be charged or has no endurance.

    With `charging_power`, a robot without endurance is charged at its start, too.
    """
    given = settings.battery.charging_power is not None
    if not settings.battery.chargeable or not (settings.endurance or given):
        return np.zeros((0, 3))
    named = settings.endurance.chargers if settings.endurance else []
    return np.array(named or [settings.start])


class SimulatedTeam:
    """Robots of a scenario on one clock, from step 0, with events applied.

    `away`: robots that have left; they stand still and are silent.
    """

    def __init__(self, scenario: BaseScenario, robots: dict[str, Any]) -> None:
        self.scenario: Any = scenario
        self.robots = robots
        self.step = 0
        self.away: set[str] = set()
        self._events: dict[int, list[tuple[str, str]]] = {}
        for event in sorted(scenario.events, key=lambda event: event.at):
            # The first step at or after it; times this close to a step belong to it.
            step = math.ceil(event.at / scenario.step - 1e-6)
            self._events.setdefault(step, []).append((event.robot, event.do))
        self._apply_events()

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.step * self.scenario.step

    @property
    def present(self) -> list[str]:
        """Present robots in name order."""
        return [name for name in self.robots if name not in self.away]

    def advance(self) -> None:
        """Advance by one step, each robot by its last command."""
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
        for robot in robots.values():
            robot.wind[:2] = scenario.simulated.wind
        self._image_steps = {
            name: steps_of(robot.settings.measuring_period, scenario.step)
            for name, robot in robots.items()
        }
        super().__init__(scenario, robots)

    def warm_up(self) -> None:
        """Compile, or load from the cache, the kernels of the robots."""
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
        """Return a laser scan (beams,) [m] with the other robots at its height."""
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
