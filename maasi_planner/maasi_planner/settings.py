"""Settings of candidates, robot motion and planners: checked models for files, parameters, code."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, Field, model_validator

from maasi_filter.plugins import OwnSettings, PluginGroup
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
        # `make_planner` takes this one, or `tour`.
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
        None, min_length=2, max_length=3, description='Waypoints on each map axis [1]'
    )
    spacing: Positive | list[Positive] | None = Field(
        None, description='Distance of neighbours in the grid, one or one per axis [m]'
    )
    corner: list[Finite] | None = Field(
        None,
        min_length=2,
        max_length=3,
        description='First waypoint of the grid; left out, the grid is centred [m, map]',
    )
    ring: Literal[4, 6, 8] | None = Field(
        None,
        description='Waypoints around the robot: 4 or 8 level directions, or 6 with up and down',
    )
    distance: Positive | None = Field(None, description='Distance of the ring from the robot [m]')
    points: list[Annotated[list[Finite], Field(min_length=2, max_length=3)]] | None = Field(
        None, min_length=1, description='Waypoints, one by one [m, map]'
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
    """How a robot moves to a waypoint: model, limits and controller."""

    model: Annotated[str, MOTIONS, AfterValidator(MOTIONS.check)] = Field(
        'constant_speed', description='Motion model and controller, or module:Class of your own'
    )
    settings: Annotated[Any, _MOTION, AfterValidator(_MOTION.check)] = Field(
        None, validate_default=True, description='Settings of a model of your own'
    )
    speed: float = Field(0.4, gt=0.0, le=100.0, description='Largest speed [m/s]')
    acceleration: float | None = Field(
        None, gt=0.0, le=100.0, description='Largest acceleration; none: no limit [m/s^2]'
    )
    tolerance: Positive = Field(
        0.05, description='Distance at which a waypoint counts as reached [m]'
    )
    arrival_radius: float | None = Field(
        None,
        ge=0.0,
        description='Distance from the waypoint at which the next one is decided, so that the '
        'robot passes without slowing down; 0: it stops at each waypoint, as in the papers; none: '
        'where it begins to brake, at most what the sensor sees to each side [m]',
    )
    approach_rate: float | None = Field(
        None,
        gt=0.0,
        le=20.0,
        description='Speed per metre left near the waypoint; none: of the controller [1/s]',
    )
    heading: Literal['keep', 'travel'] = Field(
        'keep',
        description='Whether a robot that can move sideways keeps its heading or faces its travel',
    )
    yaw_rate: float = Field(1.5, gt=0.0, le=20.0, description='Largest turn rate [rad/s]')
    yaw_acceleration: float | None = Field(
        None, gt=0.0, description='Largest change of the turn rate; none: no limit [rad/s^2]'
    )
    tilt: float = Field(
        0.5, gt=0.0, lt=1.5, description='Largest tilt of a flying robot, each axis [rad]'
    )
    state_weights: list[NotNegative] = Field(
        [1.0] * 12,
        min_length=12,
        max_length=12,
        description='LQR weights of position, roll pitch yaw, velocity, angular velocity [1]',
    )
    input_weights: list[Positive] = Field(
        [1000.0, 1000.0, 1000.0, 100.0],
        min_length=4,
        max_length=4,
        description='LQR weights of roll, pitch and yaw torque and of the collective force [1]',
    )
    control_inputs: Literal['all', 'torques'] = Field(
        'all', description='Inputs of a flying robot that the control cost C counts'
    )
    clearance: Positive = Field(
        0.05, description='Kept from obstacles beyond the radius of the robot [m]'
    )
    obstacle_term: Literal['none', 'printed', 'away'] = Field(
        'none',
        description='001, eq. (14), (15), in place of ways around obstacles: none, as printed, or '
        'pushing away from the obstacle',
    )
    obstacle_distance: Positive = Field(
        0.12, description='d_l, distance to an obstacle below which the term acts [m]'
    )
    obstacle_gain: NotNegative = Field(
        0.002, description='k_obs, gain of the term [unit of the input]'
    )
    avoidance: Literal['steer', 'dynamic_window'] = Field(
        'steer', description='How a ground robot gets around obstacles'
    )

    @model_validator(mode='after')
    def _one_way_around(self) -> MotionSettings:
        if self.obstacle_term != 'none' and self.avoidance != 'steer':
            raise ValueError(
                f'avoidance: got {self.avoidance} with obstacle_term {self.obstacle_term}, which '
                'acts in place of it; allowed is one of them'
            )
        return self


class RobotModel(Settings):
    """What planner, driver and simulation know of a robot."""

    start: Vector3 = Field(
        [0.0, 0.0, 0.0],
        description='Position at the start; its height is that of the waypoints in 2D [m, map]',
    )
    radius: Positive = Field(0.1, description='Of a circle around the robot [m]')
    motion: MotionSettings = Field(default_factory=MotionSettings, description='How it moves')
    sensor: SensorSettings = Field(
        default_factory=SensorSettings, description='Its sensor, as filter and planner believe'
    )

    @classmethod
    def part_of(cls, robot: RobotModel) -> dict[str, Any]:
        """Return the values of a robot's model that this one has."""
        return {key: getattr(robot, key) for key in cls.model_fields}


class Weights(NamedTuple):
    """Weights and choices of the objective, with the defaults of the objective in use."""

    information: bool
    alpha: float
    beta: float
    control: float
    per_distance: bool
    arrival: bool
    present: bool
    own: bool
    extend: bool


class PlannerSettings(Settings):
    """Choice of planner, and its parameters. None means the default of the objective."""

    name: Annotated[str, PLANNERS, AfterValidator(PLANNERS.check)] = Field(
        'auto', description='Planner, or module:Class of your own'
    )
    settings: Annotated[Any, _PLANNER, AfterValidator(_PLANNER.check)] = Field(
        None, validate_default=True, description='Settings of a planner of your own'
    )
    objective: Literal['paper', 'information'] = Field(
        'information',
        description='Terms T and E: as in 000 (17) to (22), (26) to (32), or information gain and '
        'expected new targets of all measurements of the team together',
    )
    alpha: NotNegative = Field(
        0.5, description='Weight of target refinement T (001: of exploration) [1]'
    )
    beta: float | None = Field(
        None, ge=0.0, description='Weight of exploration E; none: 0.5 paper, 1 information [1]'
    )
    control_weight: float | None = Field(
        None,
        ge=0.0,
        description='Weight of the control cost C; none: 1 paper, 1e-6 information [1]',
    )
    normalisation: Literal['steps', 'distance'] = Field(
        'steps', description='What J is divided by: steps K, or metres of the trajectory'
    )
    measure_at_arrival: bool | None = Field(
        None,
        description='Whether T and E count the measurement at the waypoint itself; none: only '
        'information does',
    )
    count_present: bool | None = Field(
        None,
        description='Whether T and E count the measurement at the present place, the same for all '
        'candidates; none: only paper does',
    )
    own_measurement: bool | None = Field(
        None,
        description='Whether e in E at a measurement includes that measurement itself, as (21), '
        '(22) do; none: true. With pi = 1 around the robot that makes E vanish',
    )
    extension: Literal['measuring', 'silent'] = Field(
        'measuring',
        description='Whether robots that wait at the end of a predicted trajectory go on measuring',
    )
    cluster_candidates: bool | None = Field(
        None, description='Whether cluster centres are candidates too; none: only information'
    )
    exploration_nodes: int = Field(
        1000, ge=8, le=1_000_000, description='Most nodes for expected new targets [1]'
    )
    enumeration_limit: int = Field(
        50_000,
        ge=1,
        description='Most joint candidates searched exactly; above, robots choose in turn [1]',
    )
    improvement_rounds: int = Field(
        3, ge=0, le=100, description='Most rounds of improvement when robots choose in turn [1]'
    )
    pair_budget: int = Field(
        1000,
        ge=0,
        description='Most evaluations of moves of two robots when up to 5 choose in turn [1]',
    )
    measurement: Literal['periodic', 'event'] = Field(
        'periodic', description='Measure at every period, or only when worth it (24), (33)'
    )
    trigger: Literal['absolute', 'relative'] = Field(
        'absolute',
        description='Compare (24) with the threshold, or with the threshold times its mean along '
        'the trajectory',
    )
    gamma: NotNegative = Field(1.0, description='Weight of e in the trigger [1]')
    threshold: NotNegative = Field(4.0, description='T_delta, threshold of the trigger [1]')
    explored_threshold: float = Field(
        0.999, gt=0.0, le=1.0, description='Explored share at which the search may end [1]'
    )
    mass_threshold: Positive = Field(
        0.1, description='Mass of a cluster that is still worth a visit [1]'
    )
    gain_threshold: float = Field(
        1e-4,
        ge=0.0,
        lt=1.0,
        description='Share of the expected targets that are unseen where robots can go on at which '
        'the search may end: of all (tour), of those that the candidates showed at most (maasi '
        'with information) [1]',
    )
    horizon: int = Field(1, ge=1, le=3, description='maas: waypoints planned ahead [1]')
    agent_exploration: Literal['own', 'shared'] = Field(
        'own',
        description='maas: whether e of a robot has its own measurements only (002, eq. 12, 16) or '
        'those of the whole team',
    )
    refinement: Literal['centres', 'mutual_information'] = Field(
        'centres', description='maas: T by centre probabilities or by mutual information'
    )
    coordination: Literal['centralized', 'independent'] = Field(
        'centralized',
        description='All robots with one filter and joint choices, or each for itself with a '
        'filter of its own, sharing only what is found',
    )
    lane_spacing: float | None = Field(
        None, gt=0.0, description='lawnmower: distance of lanes; none: size of the view [m]'
    )
    layer_spacing: float | None = Field(
        None, gt=0.0, description='lawnmower: distance of layers in 3D; none: as lanes [m]'
    )
    margin: float | None = Field(
        None,
        ge=0.0,
        description='lawnmower: distance of the outer lanes from the bounds; none: half a lane [m]',
    )

    def renamed(self, name: str) -> PlannerSettings:
        """Return the settings of a planner by name, with the same numbers."""
        if name == self.name:
            return self
        return PlannerSettings.model_validate({**dict(self), 'name': name, 'settings': None})

    def weights(self) -> Weights:
        """Return the weights of the objective."""
        information = self.objective == 'information'

        def given(value: float | None, paper: float, other: float) -> float:
            return value if value is not None else other if information else paper

        return Weights(
            information=information,
            alpha=self.alpha,
            beta=given(self.beta, 0.5, 1.0),
            control=given(self.control_weight, 1.0, 1e-6),
            per_distance=self.normalisation == 'distance',
            arrival=bool(given(self.measure_at_arrival, False, True)),
            present=bool(given(self.count_present, True, False)),
            own=self.own_measurement is not False,
            extend=self.extension == 'measuring',
        )

    @model_validator(mode='after')
    def _lanes_are_shared_out(self) -> PlannerSettings:
        if self.name == 'lawnmower' and self.coordination == 'independent':
            raise ValueError(
                "coordination: got 'independent', allowed with lawnmower is 'centralized': its "
                'robots share the lanes'
            )
        return self
