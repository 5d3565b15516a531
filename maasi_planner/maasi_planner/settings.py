"""Settings of candidates, motion and planners: checked models for files, parameters and code."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, SerializeAsAny, model_validator

from maasi_filter.plugins import ChosenSettings, OwnSettings, PluginError, PluginGroup
from maasi_filter.settings import (
    Finite,
    NotNegative,
    Positive,
    SensorSettings,
    Settings,
    Vector3,
)

PositiveInt = Annotated[int, Field(ge=1, le=10_000)]

PLANNERS = PluginGroup(
    'maasi.planners',
    'planner',
    'maasi_planner.planners.base:Planner',
    {
        # `make_planner` chooses this one or `tour`.
        'auto': 'maasi_planner.planners.intermittent:Intermittent',
        'maasi': 'maasi_planner.planners.intermittent:Intermittent',
        'asi': 'maasi_planner.planners.intermittent:Intermittent',
        'maas': 'maasi_planner.planners.active_search:ActiveSearch',
        'as': 'maasi_planner.planners.active_search:ActiveSearch',
        'mutual_information': 'maasi_planner.planners.mutual_information:MutualInformation',
        'nearest_widest': 'maasi_planner.planners.nearest_widest:NearestWidest',
        'lawnmower': 'maasi_planner.planners.lawnmower:Lawnmower',
        'tour': 'maasi_planner.planners.tour:Tour',
    },
)
_PLANNER = OwnSettings(PLANNERS, 'name')

MOTIONS = PluginGroup(
    'maasi.motion_models',
    'motion model',
    'maasi_planner.motion.base:MotionModel',
    {
        'constant_speed': 'maasi_planner.motion.models:ConstantSpeed',
        'mambo': 'maasi_planner.motion.models:Mambo',
        'unicycle': 'maasi_planner.motion.models:Unicycle',
        'quadrotor': 'maasi_planner.motion.models:Quadrotor',
    },
)
_MOTION = OwnSettings(MOTIONS, 'model')


class CandidateSettings(Settings):
    """Candidate waypoints of a robot: exactly one of `grid`, `ring` and `points`."""

    grid: list[PositiveInt] | None = Field(
        None, min_length=2, max_length=3, description='Number of waypoints on each map axis [1]'
    )
    spacing: Positive | list[Positive] | None = Field(
        None, description='Distance between neighbours of the grid, one number or one per axis [m]'
    )
    corner: list[Finite] | None = Field(
        None,
        min_length=2,
        max_length=3,
        description='First waypoint of the grid; default: the grid is centred [m, map]',
    )
    ring: Literal[4, 6, 8] | None = Field(
        None,
        description='Number of waypoints around the robot: 4 or 8 at its height, or 6 with one '
        'above and one below',
    )
    distance: Positive | None = Field(
        None, description="Distance of the ring's waypoints from the robot [m]"
    )
    points: list[Annotated[list[Finite], Field(min_length=2, max_length=3)]] | None = Field(
        None, min_length=1, description='List of waypoints [m, map]'
    )

    @model_validator(mode='after')
    def _one_kind(self) -> CandidateSettings:
        kinds = [name for name in ('grid', 'ring', 'points') if getattr(self, name) is not None]
        if len(kinds) != 1:
            raise ValueError(
                f'candidates: got {kinds or "none"} of grid, ring and points, allowed is one'
            )
        if self.grid is not None and self.spacing is None:
            raise ValueError('spacing: got nothing, a grid needs it [m]')
        if self.grid is None and (self.spacing is not None or self.corner is not None):
            raise ValueError('spacing, corner: allowed only with grid')
        if (self.ring is None) != (self.distance is None):
            raise ValueError('ring, distance: allowed are both or none')
        if self.grid is not None:
            for name, value in (('spacing', self.spacing), ('corner', self.corner)):
                if isinstance(value, list) and len(value) != len(self.grid):
                    raise ValueError(
                        f'{name}: got {len(value)} numbers, allowed are {len(self.grid)}'
                    )
        return self


class MotionSettings(Settings):
    """Model, limits and controller of a robot's motion."""

    model: Annotated[str, MOTIONS, AfterValidator(MOTIONS.check)] = Field(
        'constant_speed', description='Motion model and controller, or your own module:Class'
    )
    settings: Annotated[Any, _MOTION, AfterValidator(_MOTION.check)] = Field(
        None, validate_default=True, description='Settings of your own motion model'
    )
    speed: float = Field(0.4, gt=0.0, le=100.0, description='Highest speed [m/s]')
    acceleration: float | None = Field(
        None, gt=0.0, le=100.0, description='Highest acceleration; default: unlimited [m/s^2]'
    )
    tolerance: Positive = Field(
        0.05, description='Distance at which a waypoint counts as reached [m]'
    )
    arrival_radius: float | None = Field(
        None,
        ge=0.0,
        description='Distance from the waypoint at which the planner picks the next one, so that '
        'the robot passes without slowing down; 0: the robot stops at each waypoint, as in the '
        'papers; default: its braking distance, at most half the width of its field of view [m]',
    )
    approach_rate: float | None = Field(
        None,
        gt=0.0,
        le=20.0,
        description='Speed per metre of remaining distance near the waypoint; default: that of '
        'the controller [1/s]',
    )
    heading: Literal['keep', 'travel'] = Field(
        'keep',
        description='Whether a robot that can move sideways keeps its heading or turns into its '
        'direction of travel',
    )
    yaw_rate: float = Field(1.5, gt=0.0, le=20.0, description='Highest turn rate [rad/s]')
    yaw_acceleration: float | None = Field(
        None, gt=0.0, description='Highest angular acceleration; default: unlimited [rad/s^2]'
    )
    tilt: float = Field(
        0.5, gt=0.0, lt=1.5, description='Largest roll and pitch of a flying robot [rad]'
    )
    state_weights: list[NotNegative] = Field(
        [1.0] * 12,
        min_length=12,
        max_length=12,
        description='LQR weights of position, roll, pitch and yaw, velocity, and angular velocity '
        '[1]',
    )
    input_weights: list[Positive] = Field(
        [1000.0, 1000.0, 1000.0, 100.0],
        min_length=4,
        max_length=4,
        description='LQR weights of roll, pitch and yaw torque, and of the collective force [1]',
    )
    control_inputs: Literal['all', 'torques'] = Field(
        'all', description='Inputs of a flying robot that count in the control cost C'
    )
    clearance: Positive = Field(
        0.05, description='Distance kept from obstacles in addition to the radius of the robot [m]'
    )
    obstacle_term: Literal['none', 'printed', 'away'] = Field(
        'none',
        description='Obstacle term of real-drone exploration 2024 (eq. 14, 15) in place of paths '
        'around obstacles: none, as printed, or directed away from the obstacle',
    )
    obstacle_distance: Positive = Field(
        0.12, description='d_l, distance to an obstacle below which the obstacle term acts [m]'
    )
    obstacle_gain: NotNegative = Field(
        0.002, description='k_obs, gain of the obstacle term [unit of the input]'
    )
    avoidance: Literal['steer', 'dynamic_window'] = Field(
        'steer', description='How a ground robot avoids obstacles'
    )

    @model_validator(mode='after')
    def _one_avoidance(self) -> MotionSettings:
        if self.obstacle_term != 'none' and self.avoidance != 'steer':
            raise ValueError(
                f'avoidance: got {self.avoidance} with obstacle_term {self.obstacle_term}, which '
                'acts in place of it; allowed is one of them'
            )
        return self


class RobotModel(Settings):
    """Properties of a robot for planner, driver and simulation."""

    start: Vector3 = Field(
        [0.0, 0.0, 0.0],
        description='Start position; in 2D its height is that of the waypoints, and over terrain '
        'above the ground [m, map]',
    )
    radius: Positive = Field(0.1, description='Radius of a circle around the robot [m]')
    motion: MotionSettings = Field(
        default_factory=MotionSettings, description='Motion model, limits and controller'
    )
    sensor: SensorSettings = Field(
        default_factory=SensorSettings, description='Sensor model that filter and planner use'
    )

    @classmethod
    def part_of(cls, robot: RobotModel) -> dict[str, Any]:
        """Return the values of a robot's model that this model has."""
        return {key: getattr(robot, key) for key in cls.model_fields}


class PlannerSettings(Settings):
    """Settings of all planners; plugins have them and `settings`."""

    #: Whether robots stop at each waypoint, unless their `arrival_radius` says otherwise.
    stops: ClassVar[bool] = False

    name: Annotated[str, PLANNERS, AfterValidator(PLANNERS.check)] = Field(
        'auto', description='Planner, or your own module:Class'
    )
    settings: Annotated[Any, _PLANNER, AfterValidator(_PLANNER.check)] = Field(
        None, validate_default=True, description='Settings of your own planner'
    )
    measurement: Literal['periodic', 'event'] = Field(
        'periodic',
        description='Measure at every period, or only if the trigger of MAASI 2024 (eq. 24, 33) '
        'fires',
    )
    trigger: Literal['absolute', 'relative'] = Field(
        'absolute',
        description='Compare the trigger with the threshold, or with the threshold times the mean '
        'of the trigger along the trajectory',
    )
    gamma: NotNegative = Field(
        1.0, description='Weight of the unexplored share e in the trigger [1]'
    )
    threshold: NotNegative = Field(4.0, description='T_delta, threshold of the trigger [1]')
    explored_threshold: float = Field(
        0.999,
        gt=0.0,
        le=1.0,
        description='Explored share of the area above which the search can end [1]',
    )
    mass_threshold: Positive = Field(
        0.1, description='Mass above which a cluster is worth a visit [1]'
    )
    gain_threshold: float = Field(
        1e-4,
        ge=0.0,
        lt=1.0,
        description='The search can end when this share of the expected targets, or less, is '
        'unseen where robots can still go: of all targets (tour), or of the most that the '
        'candidates ever showed (maasi with objective information) [1]',
    )
    coordination: Literal['centralized', 'independent'] = Field(
        'centralized',
        description='Whether all robots share one filter and choose jointly, or each robot has '
        'its own filter, chooses alone and shares only found targets',
    )

    @classmethod
    def chosen_by(cls, values: Any) -> type[PlannerSettings]:
        """Return the settings model for these values: this one, or one of its kind."""
        return cls

    def renamed(self, name: str) -> PlannerSettings:
        """Return the settings of another planner, with the values of this one that it shares."""
        given = {key: getattr(self, key) for key in self.model_fields_set}
        if name == self.name and isinstance(self, settings_model({**given, 'name': name})):
            return self
        return planner_settings(**{**shared_values(name, given), 'name': name})


class JointSettings(PlannerSettings):
    """Settings of a planner whose robots choose jointly."""

    enumeration_limit: int = Field(
        50_000,
        ge=1,
        description='Largest number of joint candidates that is searched exactly; with more, '
        'robots choose in turn [1]',
    )
    improvement_rounds: int = Field(
        3, ge=0, le=100, description='Most rounds of improvement when robots choose in turn [1]'
    )


def settings_model(values: Mapping[str, Any]) -> type[PlannerSettings]:
    """Return the settings model for the keys under `planner`, by its name, or raise ValueError."""
    name = values.get('name', 'auto')
    try:
        planner: Any = PLANNERS.load(name)
    except (PluginError, TypeError):
        PlannerSettings.model_validate({'name': name}, strict=True)  # raises, with the key
        raise
    model: type[PlannerSettings] = planner.keys.chosen_by(values)
    return model


def shared_values(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a planner that another one shares, without plugin settings."""
    known = PlannerSettings.model_fields
    with suppress(ValueError):  # unknown names are refused later
        known = settings_model({**values, 'name': name}).model_fields
    return {key: value for key, value in values.items() if key in known and key != 'settings'}


def planner_settings(name: str = 'auto', **values: Any) -> PlannerSettings:
    """Return the settings of a planner; unknown keys are refused."""
    values['name'] = name
    return settings_model(values).model_validate(values, strict=True)


def _models() -> dict[str, type[PlannerSettings]]:
    paper = {'maasi, objective: paper': settings_model({'objective': 'paper'})}
    return {name: settings_model({'name': name}) for name in sorted(PLANNERS.built_in)} | paper


_CHOSEN = ChosenSettings(settings_model, _models)
AnyPlanner = Annotated[PlannerSettings, SerializeAsAny(), _CHOSEN, BeforeValidator(_CHOSEN.check)]
