"""Simulated robots: a body under velocity commands, with battery, odometry and sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from maasi_drivers.agent.sensor_reading import Sweep
from maasi_drivers.settings.camera import CameraSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import UNLABELLED
from maasi_filter.settings import NoiseSettings, SensorSettings, Settings
from maasi_planner.motion import Body, RobotState, make_motion
from maasi_planner.motion.base import check_command
from maasi_planner.settings import MotionSettings
from maasi_sim.simulation.camera import CameraRenderer
from maasi_sim.simulation.floor import RenderSettings, scene_of
from maasi_sim.simulation.odometry import OdometryModel, OdometryReading, OdometrySettings
from maasi_sim.simulation.sensors import LaserScanner, LaserSettings, RangingSensor
from maasi_sim.simulation.world import World


class SimulatedSettings(Settings):
    """True parameters of a robot, where they differ from its other settings.

    The sensor's part is for ranging sensors; a camera has its own true settings.
    """

    noise: NoiseSettings | None = Field(
        default=None, description="True noise of its sensor; none: the sensor's"
    )
    noise_factor: float = Field(
        default=1.0, gt=0.0, le=1000.0, description='Factor on the true deviations [1]'
    )
    probability_factor: float = Field(
        default=1.0,
        ge=0.0,
        le=100.0,
        description='Factor on the true probability of detection, which is at most 1 [1]',
    )
    clutter_per_scan: float | None = Field(
        default=None,
        ge=0.0,
        le=1e4,
        description='True mean number of false detections in a scan; none: as in the sensor [1]',
    )
    odometry: OdometrySettings | None = Field(
        default=None,
        description='True noise, drift and offset of its odometry, while the covariance it reports '
        'is that of `odometry`; none: they are the same',
    )

    def sensor(self, believed: SensorSettings, name: str, bounds: FloatArray) -> Sensor:
        """Return the true ranging sensor; its clutter is within the diagonal of the bounds."""
        dimension = len(bounds)
        noise = self.noise or believed.noise
        probability = min(believed.detection.probability * self.probability_factor, 1.0)
        detection = believed.detection.model_copy(update={'probability': probability})
        true = believed.model_copy(update={'noise': noise, 'detection': detection})
        sensor = true.build(name, dimension)
        sensor.covariance = sensor.covariance * self.noise_factor**2
        if self.clutter_per_scan is not None:
            size = bounds[:, 1] - bounds[:, 0]
            reach = min(math.sqrt(float((size * size).sum())), sensor.maximum_range)
            space = reach * 2.0 * math.pi * (math.pi if dimension == 3 else 1.0)
            sensor.clutter = self.clutter_per_scan / space
        return sensor


class BatterySettings(Settings):
    """A robot's battery."""

    capacity: float = Field(default=7200.0, gt=0.0, description='Energy of a full battery [J]')
    charge: float = Field(default=1.0, ge=0.0, le=1.0, description='Charge at the start, 0 to 1')
    idle_power: float = Field(default=2.0, ge=0.0, description='Drain at rest or hovering [W]')
    motion_power: float = Field(
        default=4.0, ge=0.0, description='Drain for each metre per second on top of it [W/(m/s)]'
    )


class Battery:
    """A battery that idling and moving drain."""

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


@dataclass(frozen=True)
class Equipment:
    """Body and sensors of a simulated robot.

    `radius` is that of a circle around it that hits obstacles [m]; `odometry` is what its odometry
    reports of its errors, `true_odometry` what they are, if different.
    """

    motion: MotionSettings
    radius: float
    camera: CameraSettings | None
    sensor: Sensor | None
    laser: LaserSettings | None
    odometry: OdometrySettings
    battery: BatterySettings
    true_odometry: OdometrySettings | None = None


class Leader(Protocol):
    """Moves a robot instead of its simulated body."""

    @property
    def state(self) -> RobotState:
        """True state, in the map."""


class SimulatedRobot:
    """A simulated robot; its name keys its noise.

    A command holds until the next one, as on a robot without a watchdog. A robot stops before it
    hits an obstacle; with an empty battery it stops, or sinks to the floor.
    """

    def __init__(
        self,
        name: str,
        equipment: Equipment,
        start: Pose,
        world: World,
        floor: RenderSettings,
        seed: int,
    ) -> None:
        self.name = name
        self.equipment = equipment
        self.world = world
        self.collisions = 0
        self._motion = make_motion(equipment.motion)
        self._body: Body = self._motion.body(RobotState(start))
        self.state = self._body.robot_state()
        if self._hits(self.state.pose.position):
            raise ValueError(
                f'{name}: got start {start.position.tolist()}, allowed is a place at least its '
                f'radius ({equipment.radius} m) from every obstacle'
            )
        self._command = np.zeros(4)
        self._flies = equipment.motion.model != 'unicycle' and start.position[2] > 0.0
        self._resting = False
        self.battery = Battery(equipment.battery)
        self._odometry = OdometryModel(
            equipment.true_odometry or equipment.odometry, start, seed, name, equipment.odometry
        )
        self.odometry: OdometryReading = self._odometry.step(self.state, 0)
        self._leader: Leader | None = None
        self.camera: CameraRenderer | None = None
        if equipment.camera is not None:
            self.camera = CameraRenderer(
                Camera.from_settings(equipment.camera),
                floor,
                scene_of(world, floor, seed),
                seed,
                name,
            )
        self.laser: LaserScanner | None = None
        if equipment.laser is not None:
            obstacles = world.obstacles
            self.laser = LaserScanner(
                equipment.laser, world.bounds, obstacles.centres, obstacles.radii, seed, name
            )
        self.ranging: RangingSensor | None = None
        if equipment.sensor is not None:
            size = world.bounds[:, 1] - world.bounds[:, 0]
            reach = float(np.sqrt((size * size).sum()))
            self.ranging = RangingSensor(
                equipment.sensor, world.targets_3d_at(0), seed, name, reach
            )

    def command(self, velocity: ArrayLike) -> None:
        """Set the velocity command (4,), which holds until the next one.

        vx, vy, vz [m/s, axes turned by the heading], yaw rate [rad/s].
        """
        self._command = check_command(velocity)

    def follow(self, leader: Leader) -> None:
        """Take the state from `leader` from now on, instead of simulating the body."""
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
            self._body.step(command, dt)
            self.state = self._body.robot_state()
            position = self.state.pose.position
            if self._hits(position):
                self.collisions += 1
                self._halt(before.pose)
            elif self._flies and self.battery.empty and position[2] <= 0.0:
                self._halt(Pose(np.array([position[0], position[1], 0.0]), before.pose.orientation))
                self._resting = True
        velocity = self.state.velocity
        self.battery.drain(float(np.sqrt((velocity * velocity).sum())), dt)
        self.odometry = self._odometry.step(self.state, step)

    def stand(self, step: int) -> None:
        """Stand still until the discrete step `step`; the last command is void."""
        if self._leader is not None:
            self.step(step, 0.0)
            return
        self._command = np.zeros(4)
        if self.state.velocity.any() or self.state.angular_velocity.any():
            self._halt(self.state.pose)
        self.odometry = self._odometry.step(self.state, step)

    def image(self, step: int, time: float) -> NDArray[np.uint8]:
        """Return what the camera sees now, (h, w, 3) uint8 in R, G, B."""
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
        """Compile, or load from the cache, what this robot uses; nothing changes."""
        self._motion.body(self.state).step(np.zeros(4), 0.05)
        if self.camera is not None:
            self.image(0, 0.0)
        if self.laser is not None:
            self.scan(0)
        if self.ranging is not None:
            self.sweep(0)

    def _halt(self, pose: Pose) -> None:
        self._body = self._motion.body(RobotState(Pose.from_yaw(pose.position, pose.yaw)))
        self.state = self._body.robot_state()

    def _hits(self, position: FloatArray) -> bool:
        distances = self.world.obstacles.distances(position)
        return bool(len(distances) and distances.min() < self.equipment.radius)
