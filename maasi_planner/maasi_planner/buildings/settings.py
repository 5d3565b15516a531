"""Settings of the search of buildings (004) and of its planner node."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.ros.node_settings import NodeSettings
from maasi_filter.settings import Finite, NotNegative, Positive, Settings, Vector3

Face = Literal['west', 'east', 'south', 'north', 'bottom', 'top']

FACES: tuple[Face, ...] = ('west', 'east', 'south', 'north', 'bottom', 'top')


class BoxSettings(Settings):
    """A box along the axes of the map."""

    centre: list[Finite] = Field(
        min_length=2,
        max_length=3,
        description='Centre x y z; with two numbers, the box stands on the floor [m, map]',
    )
    size: list[Positive] = Field(min_length=3, max_length=3, description='Size along x, y, z [m]')

    def array(self, floor: float) -> FloatArray:
        """Return lower and upper corner, (3, 2) [m]; floor: its height [m]."""
        size = np.array(self.size)
        centre = np.array([*self.centre, floor + 0.5 * size[2]])[:3]
        return np.stack([centre - 0.5 * size, centre + 0.5 * size], axis=1)

    def numbers(self, floor: float) -> list[float]:
        """Return centre and size as six numbers [m]; floor: its height [m]."""
        return [*self.array(floor).mean(axis=1).tolist(), *self.size]


class ObjectSettings(BoxSettings):
    """An object of interest."""

    faces: list[Face] = Field(
        default_factory=lambda: list(FACES[:4]),
        min_length=1,
        description='Faces to search; west is at the smallest x, north at the largest y',
    )


class SearchCameraSettings(Settings):
    """The camera of a robot, and how well it detects people (004, III-C)."""

    angle: float = Field(
        1.0471975511965976, gt=0.0, lt=3.0, description='Opening angle of the field of view [rad]'
    )
    least_distance: Positive = Field(
        17.0, description='d_min, distance up to which detection is certain (eq. 4) [m]'
    )
    largest_distance: Positive = Field(
        90.0, description='d_max, distance from which detection is impossible (eq. 4) [m]'
    )

    @model_validator(mode='after')
    def _order(self) -> SearchCameraSettings:
        if self.least_distance >= self.largest_distance:
            raise ValueError(
                f'least_distance: got {self.least_distance}, allowed is below largest_distance, '
                f'{self.largest_distance} [m]'
            )
        return self


class DynamicsSettings(Settings):
    """Mass point with air resistance under bounded forces, 004, (1)."""

    mass: Positive = Field(3.35, description='m, mass [kg]')
    resistance: float = Field(0.2, ge=0.0, lt=1.0, description='eta, air resistance per step [1]')
    force: Positive = Field(35.0, description='Largest force on each axis [N]')
    speed: Positive = Field(15.0, description='Largest speed on each axis [m/s]')
    gravity: NotNegative = Field(9.81, description='g, gravity [m/s^2]')

    @model_validator(mode='after')
    def _lifts(self) -> DynamicsSettings:
        weight = self.mass * self.gravity
        if weight >= self.force:
            raise ValueError(
                f'force: got {self.force} N, which cannot lift the weight of the robot, '
                f'{self.mass:g} kg x {self.gravity:g} m/s^2 = {weight:.2f} N; '
                'allowed is more than that'
            )
        return self


class HazardSettings(Settings):
    """Failure probability of a battery at each step, 004, (3)."""

    alpha: Positive = Field(100.0, description='alpha_1 of the failure probability (eq. 3) [steps]')
    beta: Positive = Field(0.3, description='beta_1 of the failure probability (eq. 3) [1/step]')
    recharge_steps: list[Annotated[int, Field(ge=1)]] = Field(
        [5, 10],
        min_length=2,
        max_length=2,
        description='T_R, shortest and longest duration of a recharge [steps]',
    )
    failures: bool = Field(True, description='Whether batteries can fail')

    @model_validator(mode='after')
    def _order(self) -> HazardSettings:
        if self.recharge_steps[0] > self.recharge_steps[1]:
            raise ValueError(
                f'recharge_steps: got {self.recharge_steps}, allowed is the least first'
            )
        return self

    def failure(self, steps: float) -> float:
        """Return p_b(t), t steps after the last recharge: (3)."""
        if not self.failures:
            return 0.0
        exponent = min(max(-self.beta * (steps - self.alpha), -700.0), 700.0)
        return 1.0 / (1.0 + self.alpha * math.exp(exponent))


class SearcherSettings(Settings):
    """A robot that searches buildings."""

    start: Vector3 = Field(
        description='Start position x y z, where the robot also recharges [m, map]'
    )
    yaw: Finite = Field(0.0, description='Heading at the start [rad]')
    dynamics: DynamicsSettings = Field(
        default_factory=DynamicsSettings, description='Dynamics of the robot'
    )
    hazard: HazardSettings = Field(
        default_factory=HazardSettings, description='Failures and recharging of its battery'
    )


class CuboidMethodSettings(Settings):
    """The distributed model predictive control of 004."""

    detection_probability: float = Field(
        0.88, gt=0.0, le=1.0, description='p_d that each snapshot must reach (eq. 4) [1]'
    )
    coverage: Literal['paper', 'strict'] = Field(
        'paper',
        description='Number of cells on a face: rounded as in the paper, which can leave strips '
        'of a few percent unseen, or large enough that every point is seen',
    )
    cuboid_size: Positive = Field(10.0, description='Side length of a cuboid [m]')
    camera: SearchCameraSettings = Field(default_factory=SearchCameraSettings, description='Camera')
    horizon: int = Field(10, ge=2, le=25, description='T, planning horizon [steps]')
    guidance_step: int = Field(
        3, ge=1, description='tau*, the step that is guided to a cuboid; at most T - 1 [1]'
    )
    guidance_weight: Positive = Field(1e-4, description='w1, weight of the guidance [1/m^2]')
    smoothness_weight: Positive = Field(1e-4, description='w2, weight of the smoothness [1/N^2]')
    visit_weight: NotNegative = Field(0.3, description='w3, weight of visits [1]')
    discount: float = Field(
        0.95,
        gt=0.0,
        le=1.0,
        description='Factor on the reward of a visit for each step of delay, stronger the more '
        'often the visit was postponed; 1: as in the paper, in which robots may hover forever [1]',
    )
    assignment: Literal['predicted', 'printed'] = Field(
        'predicted',
        description='Distances of the assignment (eq. 10) are measured from the planned positions '
        'at tau* + 1, as for a single robot, or from the present positions, as printed',
    )
    around_corners: bool = Field(
        True,
        description='Whether a robot heads for the first corner of its path around obstacles '
        'instead of the cuboid behind them',
    )
    between_samples: bool = Field(
        True, description='Whether plans avoid obstacles between samples, too'
    )
    brake_at_end: bool = Field(
        True,
        description='Whether each plan leaves space to brake after its last step; without it, as '
        'printed, the next problem may be infeasible',
    )
    clearance: NotNegative = Field(0.01, description='Distance kept from obstacles [m]')
    visit_depth: float = Field(
        1e-3,
        ge=0.0,
        lt=0.5,
        description='Planned depth of a visit inside its cuboid; 0: as in the paper, where an '
        'optimum touches a face and rounding decides whether the visit counts [m]',
    )
    alpha: Positive = Field(2.0, description='alpha_2 of eq. 13 [1]')
    beta: Positive = Field(0.5, description='beta_2 of eq. 13 [1]')
    condition: Literal['low_hazard', 'printed'] = Field(
        'low_hazard',
        description='When eq. 13 holds: where p_b(t + T) is at most 0.5, or above 0.5 as printed',
    )
    communication_range: Positive = Field(100.0, description='C_R, range of communication [m]')
    time_limit: Positive = Field(
        0.5, description='Wall time of a solve, after which the best plan so far is used [s]'
    )
    node_limit: int = Field(
        20000,
        ge=1,
        description='Number of nodes of a solve, after which the best plan so far is used; gives '
        'the same plan on every machine [1]',
    )

    @property
    def guided(self) -> int:
        """Index of the position that is guided to a cuboid, tau* + 1."""
        return min(self.guidance_step, self.horizon - 1) + 1

    def rewards(self, put_off: int = 0) -> FloatArray:
        """Return the reward of a visit at P_0 to P_T, (T + 1,), postponed `put_off` times [1]."""
        steps = np.maximum(np.arange(self.horizon + 1) - 1, 0)
        return np.asarray(self.visit_weight * self.discount ** ((1 + put_off) * steps))


class CuboidSettings(CuboidMethodSettings):
    """The distributed model predictive control of 004 and its mission."""

    objects: list[ObjectSettings] = Field(default_factory=list, description='Objects to search')
    obstacles: list[BoxSettings] = Field(default_factory=list, description='Obstacles to avoid')


Box = Annotated[list[Finite], Field(min_length=6, max_length=6)]


class CuboidPlannerSettings(NodeSettings, SearcherSettings):
    """Settings of the planner node of one robot."""

    live: ClassVar[frozenset[str]] = frozenset({'link_patience'})

    search_on_start: bool = Field(
        False,
        description='Whether the search starts as soon as the planner is active; otherwise it '
        'starts with the service search/start',
    )
    step: float = Field(1.0, gt=0.0, le=10.0, description='dT, duration of a step [s]')
    team: list[str] = Field([], description='Names of all robots, which select their colours')
    environment: EnvironmentSettings = Field(description='Area in which robots may move')
    planner: CuboidMethodSettings = Field(
        default_factory=CuboidMethodSettings, description='Distributed model predictive control'
    )
    objects: list[Box] = Field(
        min_length=1, description='Objects to search: centre x y z and size x y z of each [m]'
    )
    faces: list[str] = Field(
        [], description='Faces of each object, separated by spaces; default: the lateral faces'
    )
    obstacles: list[Box] = Field(
        [], description='Obstacles to avoid: centre x y z and size x y z of each [m]'
    )
    link_patience: float = Field(
        0.3,
        gt=0.0,
        le=1.0,
        description='Share of a step after which the robot decides without the messages of '
        'others; not in lockstep [1]',
    )

    def search(self) -> CuboidSettings:
        """Return the search with its objects; ValueError if the number of faces does not fit."""
        if self.faces and len(self.faces) != len(self.objects):
            raise ValueError(
                f'faces: got {len(self.faces)}, allowed is one for each of {len(self.objects)} '
                'objects, or none'
            )
        content = self.planner.model_dump()
        objects = []
        for index, box in enumerate(self.objects):
            item: dict[str, object] = {'centre': box[:3], 'size': box[3:]}
            if self.faces:
                item['faces'] = self.faces[index].split()
            objects.append(item)
        content['objects'] = objects
        content['obstacles'] = [{'centre': box[:3], 'size': box[3:]} for box in self.obstacles]
        return CuboidSettings.model_validate(content)
