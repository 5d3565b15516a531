"""The schema of scenario files."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from maasi_drivers.settings.driver import DRIVERS, PLATFORM_LINKS, DrivenRobot
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
    """True parameters of a robot, if they differ from its other settings.

    Sensor parameters are for ranging sensors; a camera has its own true settings.
    """

    noise: NoiseSettings | None = Field(
        None, description="True noise of its sensor; default: the sensor's"
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
        description='True mean number of false detections per scan; default: as in the sensor [1]',
    )
    clutter_in: Literal['measurements', 'area'] | None = Field(
        None,
        description='Distribution of false detections, with `clutter_per_scan`: uniform in range '
        'and angles or in the area; default: as in the sensor',
    )
    odometry: OdometrySettings | None = Field(
        None,
        description='True noise, drift and offset of its odometry, while it reports the '
        'covariance of `odometry`; default: as in `odometry`',
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
    idle_power: NotNegative = Field(2.0, description='Power at rest or hovering [W]')
    charging_time: Positive = Field(
        1800.0, description='Duration of a full charge or a battery change [s]'
    )
    charging_power: float | None = Field(
        None,
        ge=0.0,
        description='Charging power, instead of charging_time; 0 disables charging [W]',
    )
    motion_power: NotNegative = Field(
        4.0, description='Additional power per metre per second [W/(m/s)]'
    )

    @property
    def power_at_charger(self) -> float:
        """Charging power [W]; 0: it cannot be charged."""
        if self.charging_power is not None:
            return self.charging_power
        return self.capacity / self.charging_time

    @property
    def chargeable(self) -> bool:
        """Whether a charger can charge it."""
        return self.power_at_charger > 0.0


class WeatherSettings(Settings):
    """Disturbances of all robots in the simulation, unknown to filters and planners."""

    wind: Vector2 = Field(
        [0.0, 0.0],
        description='Steady wind, which carries flying robots [m/s, map]; `motion.speed` and power '
        'refer to their speed through the air',
    )


class RobotSettings(DrivenRobot, PlannedRobotSettings):
    """A robot: the settings of its type, overridden by the scenario's."""

    type: str = Field(description='Name of the type: a file in config/robots')
    description: str = Field('', description='Text that describes the robot')
    driver: Annotated[str, DRIVERS, AfterValidator(DRIVERS.check_known)] = Field(
        description='Its driver: an executable of maasi_drivers, or your own module:Class'
    )
    guard: bool | None = Field(
        None,
        description='Whether a guard stops it when its driver dies or hangs; default: with link '
        'topics, as other links have their own timeout',
    )
    body: Literal['simulated', 'external'] = Field(
        'simulated',
        description='With link topics: simulated, or external: moved by another program such as '
        'Gazebo, which publishes its odometry and /clock',
    )
    measurements: Literal['simulated', 'external'] = Field(
        'simulated',
        description='Images of its camera, or ranges of its sensor: simulated, or external: '
        'published by another program; in a file also camera: external or sensor: external',
    )
    link: Literal['topics', 'mambo_wifi', 'mavlink', 'crazyswarm2', 'aerostack2'] = Field(
        'topics',
        description='Connection of its driver; the robot side is simulated, with crazyswarm2 and '
        'aerostack2 another program',
    )
    autopilot: AutopilotSettings = Field(
        default_factory=AutopilotSettings,
        description='With link mavlink: its simulated autopilot; or external: another program',
    )
    start: Vector3 = Field(
        description='Position at the start, x y z; over terrain z is above the ground [m, map]'
    )
    motion: MotionSettings = Field(description='Motion of the robot')
    sensor: SensorSettings = Field(description='Its sensor, as assumed by the filter')
    laser: LaserSettings | None = Field(None, description='Its laser scanner, if any')
    odometry: OdometrySettings = Field(
        default_factory=OdometrySettings, description='Errors of its simulated odometry'
    )
    battery: BatterySettings = Field(
        default_factory=BatterySettings, description='Its simulated battery'
    )
    simulated: SimulatedSettings = Field(
        default_factory=SimulatedSettings,
        description='True parameters in the simulation, if they differ from the assumed ones',
    )

    @property
    def external(self) -> bool:
        """Whether another program than the sim moves it."""
        if self.link == 'mavlink':
            return self.autopilot.external
        return self.body == 'external' or self.link in PLATFORM_LINKS

    @property
    def measuring_period(self) -> float:
        """Measuring period of its camera or ranging sensor [s]."""
        return self.sensor.period if self.camera is None else 1.0 / self.camera.rate

    @property
    def flies(self) -> bool:
        """Whether it starts in the air."""
        return self.motion.model != 'unicycle' and self.start[2] > 0.0

    @property
    def takes_off(self) -> bool:
        """Whether it is simulated and takes off by its driver's service `arm`."""
        return self.link != 'topics' and not self.external


class ScoringSettings(Settings):
    """Comparison of found targets with the truth."""

    radius: float | None = Field(
        None,
        gt=0.0,
        description='Distance within which a found target is true; default: 3 T_z, at most half '
        'the smallest distance of two targets [m]',
    )
    order: float = Field(2.0, ge=1.0, description='p of GOSPA [1]')


class Scenario(BaseScenario):
    """A scenario of a search for targets, all layers merged."""

    targets: TargetSettings = Field(description='True targets, for the simulation and the report')
    robots: dict[str, RobotSettings] = Field(min_length=1, description='Robots by name')
    filter: FilterSettings = Field(default_factory=FilterSettings, description='Search filter')
    planner: AnyPlanner = Field(default_factory=default_planner, description='Planner')
    floor: RenderSettings = Field(
        default_factory=lambda: RenderSettings.model_validate({}),
        description='Images of simulated cameras',
    )
    simulated: WeatherSettings = Field(
        default_factory=WeatherSettings, description='Disturbances of robots in the simulation'
    )
    scoring: ScoringSettings = Field(default_factory=ScoringSettings, description='Scores')

    def namespaces(self) -> dict[str, list[str]]:
        """Return the robots that share filter and planner, by namespace ('': the team)."""
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
            if robot.measurements == 'external':
                raise ScenarioError(
                    f"robots.{name}.measurements: read 'external', which needs real time, but "
                    f'{asked} is set; allowed is simulated, or rate 1 without lockstep'
                )
            if robot.link != 'topics':
                raise ScenarioError(
                    f'robots.{name}.link: read {robot.link!r}, which needs real time, but '
                    f'{asked} is set; allowed is topics, or rate 1 without lockstep'
                )
            if robot.body == 'external':
                raise ScenarioError(
                    f"robots.{name}.body: read 'external', but {asked} is set; allowed is "
                    'simulated, or neither --lockstep nor --rate: /clock gives the time'
                )

    @property
    def external_clock(self) -> bool:
        """Whether time comes from the program that moves a robot."""
        return any(robot.body == 'external' for robot in self.robots.values())

    def removal_distance(self) -> float:
        """Return T_z [m]: the filter's, else four deviations of the coarsest range."""
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
    """Return the settings of the planner of some robots; others plan for themselves.

    `common`: settings that all nodes share.
    """
    return PlannerNodeSettings.model_validate(
        {
            **common,
            'environment': scenario.environment,
            'planner': scenario.planner,
            # As in the filter.
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
    """Return the number of steps of a time, at least one."""
    return max(1, math.floor(time / step + 0.5))
