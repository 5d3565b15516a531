"""The schema of scenario files."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from maasi_drivers.settings.driver import DRIVERS, DrivenRobot
from maasi_filter.arrays import FloatArray
from maasi_filter.models.sensor import Sensor
from maasi_filter.settings import (
    FilterSettings,
    NoiseSettings,
    NotNegative,
    Positive,
    SensorSettings,
    Settings,
    Vector2,
    Vector3,
)
from maasi_planner.node_settings import PlannedRobotSettings, PlannerNodeSettings
from maasi_planner.settings import AnyPlanner, MotionSettings
from maasi_planner.settings import planner_settings as default_planner
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.simulation.emulators.mavlink.autopilot_settings import AutopilotSettings
from maasi_sim.simulation.floor import RenderSettings
from maasi_sim.simulation.odometry import OdometrySettings
from maasi_sim.simulation.sensors import LaserSettings
from maasi_sim.simulation.world import TargetSettings, World


class SimulatedSettings(Settings):
    """True parameters of a robot, where they differ from its other settings.

    The sensor's part is for ranging sensors; a camera has its own true settings.
    """

    noise: NoiseSettings | None = Field(
        None, description="True noise of its sensor; none: the sensor's"
    )
    noise_factor: float = Field(
        1.0, gt=0.0, le=1000.0, description='Factor on the true deviations [1]'
    )
    probability_factor: float = Field(
        1.0,
        ge=0.0,
        le=100.0,
        description='Factor on the true probability of detection, which is at most 1 [1]',
    )
    clutter_per_scan: float | None = Field(
        None,
        ge=0.0,
        le=1e4,
        description='True mean number of false detections in a scan; none: as in the sensor [1]',
    )
    clutter_in: Literal['measurements', 'area'] | None = Field(
        None,
        description='Where they are uniform, with `clutter_per_scan`: in range and angles, or in '
        'the area; none: as in the sensor',
    )
    odometry: OdometrySettings | None = Field(
        None,
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
            sensor.clutter_in = self.clutter_in or sensor.clutter_in
            if sensor.clutter_in == 'area':
                space = float(size.prod())
            sensor.clutter = self.clutter_per_scan / space
        return sensor


class BatterySettings(Settings):
    """A robot's battery."""

    capacity: Positive = Field(7200.0, description='Energy of a full battery [J]')
    charge: float = Field(1.0, ge=0.0, le=1.0, description='Charge at the start, 0 to 1')
    idle_power: NotNegative = Field(2.0, description='Drain at rest or hovering [W]')
    charging_time: Positive = Field(
        1800.0, description='Time of a full charge at a charger, or of a change of batteries [s]'
    )
    charging_power: float | None = Field(
        None,
        ge=0.0,
        description='Power at a charger, in place of charging_time; 0: it cannot be charged [W]',
    )
    motion_power: NotNegative = Field(
        4.0, description='Drain for each metre per second on top of it [W/(m/s)]'
    )

    @property
    def power_at_charger(self) -> float:
        """Power with which it is charged [W]; 0: it cannot be."""
        if self.charging_power is not None:
            return self.charging_power
        return self.capacity / self.charging_time

    @property
    def chargeable(self) -> bool:
        """Whether a charger charges it."""
        return self.power_at_charger > 0.0


class WeatherSettings(Settings):
    """What disturbs all robots of the simulation, and no filter or planner knows."""

    wind: Vector2 = Field(
        [0.0, 0.0],
        description='Steady velocity of the air, which carries flying robots [m/s, map]; their '
        '`motion.speed` is that through the air, and what they use is by that speed',
    )


class RobotSettings(DrivenRobot, PlannedRobotSettings):
    """One robot: its type's settings with the scenario's own on top."""

    type: str = Field(description='Name of the type: a file in config/robots')
    description: str = Field('', description='What it is, in words')
    driver: Annotated[str, DRIVERS, AfterValidator(DRIVERS.check_known)] = Field(
        description='Executable of maasi_drivers that drives it, or module:Class of your own'
    )
    guard: bool | None = Field(
        None,
        description='Whether a guard stops it when its driver dies or hangs; none: where it is '
        'reached by topics, as another link has a time limit of its own',
    )
    body: Literal['simulated', 'external'] = Field(
        'simulated',
        description='With link topics: whether the sim moves it, or another program, as Gazebo, '
        'that publishes its odometry and the time (/clock)',
    )
    link: Literal['topics', 'mambo_wifi', 'mavlink'] = Field(
        'topics', description='How its driver reaches it; the other end is simulated'
    )
    autopilot: AutopilotSettings = Field(
        default_factory=AutopilotSettings,
        description='With link mavlink: its autopilot, simulated; or external: another program',
    )
    start: Vector3 = Field(description='Position at the start, x y z [m, map]')
    motion: MotionSettings = Field(description='How it moves')
    sensor: SensorSettings = Field(description='Its sensor, as assumed by the filter')
    laser: LaserSettings | None = Field(None, description='Its laser scanner, if any')
    odometry: OdometrySettings = Field(
        default_factory=OdometrySettings, description='Errors of its simulated odometry'
    )
    battery: BatterySettings = Field(
        default_factory=BatterySettings, description='Its battery, simulated'
    )
    simulated: SimulatedSettings = Field(
        default_factory=SimulatedSettings,
        description='True parameters in the simulation, where they differ from those assumed',
    )

    @property
    def external(self) -> bool:
        """Whether another program than the sim moves it."""
        if self.link == 'mavlink':
            return self.autopilot.external
        return self.body == 'external'

    @property
    def measuring_period(self) -> float:
        """Of its camera, or of its ranging sensor [s]."""
        return self.sensor.period if self.camera is None else 1.0 / self.camera.rate

    @property
    def flies(self) -> bool:
        """Whether it starts in the air: not on the ground, and not under water."""
        return self.motion.model != 'unicycle' and self.start[2] > 0.0

    @property
    def takes_off(self) -> bool:
        """Whether it is simulated, and takes off when its driver's service `arm` is called."""
        return self.link != 'topics' and not self.external


class ScoringSettings(Settings):
    """How found targets are compared with the truth."""

    radius: float | None = Field(
        None,
        gt=0.0,
        description='Distance within which a found target is true; none: 3 T_z, at most half the '
        'smallest distance of two targets [m]',
    )
    order: float = Field(2.0, ge=1.0, description='p of GOSPA [1]')


class Scenario(BaseScenario):
    """A scenario file of a search for targets, all layers merged."""

    targets: TargetSettings = Field(description='The truth, for the simulation and the report')
    robots: dict[str, RobotSettings] = Field(min_length=1, description='Robots by name')
    filter: FilterSettings = Field(default_factory=FilterSettings, description='Search filter')
    planner: AnyPlanner = Field(default_factory=default_planner, description='Planner')
    floor: RenderSettings = Field(
        default_factory=lambda: RenderSettings.model_validate({}),
        description='Images of simulated cameras',
    )
    simulated: WeatherSettings = Field(
        default_factory=WeatherSettings, description='What disturbs robots in the simulation'
    )
    scoring: ScoringSettings = Field(default_factory=ScoringSettings, description='Scores')

    def namespaces(self) -> dict[str, list[str]]:
        """Return the robots that share filter and planner by namespace; all together have ''."""
        if self.planner.coordination == 'independent':
            return {name: [name] for name in self.names()}
        return {'': self.names()}

    def check_pace(self, lockstep: bool, rate: float | None) -> None:
        """See `BaseScenario.check_pace`."""
        if not lockstep and rate in (None, 1.0):
            return
        asked = 'lockstep' if lockstep else f'rate {rate:g}'
        for name in self.names():
            robot = self.robots[name]
            if robot.link != 'topics':
                raise ScenarioError(
                    f'robots.{name}.link: read {robot.link!r}, which runs in real time, and '
                    f'{asked}; allowed is topics, or rate 1 without lockstep'
                )
            if robot.body == 'external':
                raise ScenarioError(
                    f"robots.{name}.body: read 'external', and {asked}; allowed is simulated, or "
                    'neither --lockstep nor --rate: the time is that of /clock'
                )

    @property
    def external_clock(self) -> bool:
        """Whether the time is that of the program that moves a robot."""
        return any(robot.body == 'external' for robot in self.robots.values())

    def removal_distance(self) -> float:
        """Return T_z [m]: the filter's, or four deviations of the coarsest range without."""
        distance = self.filter.resolved().removal_distance
        if distance is not None:
            return distance
        return 4.0 * max(
            float(robot.sensor.noise.deviations(self.dimension)[0])
            for robot in self.robots.values()
        )

    def world(self, seed: int) -> World:
        """Return the true world of a run."""
        return World.from_settings(self.environment, self.targets, seed, self.step)


def planner_settings(
    scenario: Scenario, names: Sequence[str], common: Mapping[str, Any]
) -> PlannerNodeSettings:
    """Return the settings of the planner of some robots; the others plan for themselves.

    `common` are settings that all nodes share.
    """
    return PlannerNodeSettings.model_validate(
        {
            **common,
            'environment': scenario.environment,
            'planner': scenario.planner,
            # As the filter has it.
            'exploration_spacing': scenario.filter.exploration_spacing,
            'robots': {name: PlannedRobotSettings.part_of(scenario.robots[name]) for name in names},
            'others': {
                name: {'radius': robot.radius, 'start': robot.start}
                for name, robot in scenario.robots.items()
                if name not in names
            },
        }
    )


def steps_of(time: float, step: float) -> int:
    """Return how many steps a time takes, at least one."""
    return max(1, math.floor(time / step + 0.5))
