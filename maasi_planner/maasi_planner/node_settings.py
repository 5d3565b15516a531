"""Settings of the planner node."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from maasi_filter.node_settings import NodeSettings
from maasi_filter.settings import EnvironmentSettings, Finite, SensorSettings, Settings
from maasi_planner.settings import CandidateSettings, MotionSettings, PlannerSettings


class PlannedRobotSettings(Settings):
    """What the planner knows of a robot."""

    candidates: CandidateSettings = Field(description='Waypoints to choose from')
    motion: MotionSettings = Field(default_factory=MotionSettings, description='How it moves')
    sensor: SensorSettings = Field(
        default_factory=SensorSettings, description='Its sensor, as the planner believes'
    )
    radius: float = Field(default=0.1, ge=0.0, description='Of a circle around the robot [m]')
    start: Annotated[list[Finite], Field(min_length=3, max_length=3)] = Field(
        default=[0.0, 0.0, 0.0],
        description='Position at the start; its height is that of the waypoints in 2D [m, map]',
    )


class OtherRobotSettings(Settings):
    """What the planner knows of a robot that plans for itself."""

    radius: float = Field(default=0.1, ge=0.0, description='Of a circle around the robot [m]')
    start: Annotated[list[Finite], Field(min_length=3, max_length=3)] = Field(
        description='Position at the start [m, map]'
    )


class PlannerNodeSettings(NodeSettings):
    """Settings of the planner node."""

    environment: EnvironmentSettings = Field(description='Where the targets are')
    planner: PlannerSettings = Field(default_factory=PlannerSettings, description='The planner')
    robots: dict[str, PlannedRobotSettings] = Field(min_length=1, description='Robots, by name')
    others: dict[str, OtherRobotSettings] = Field(
        default={},
        description='Robots that plan for themselves, by name; where they go is kept clear',
    )
    exploration_spacing: float | None = Field(
        default=None,
        gt=0.0,
        description='Spacing of the exploration grid; none: as the filter has it [m]',
    )
    search_on_start: bool = Field(
        default=True, description='Whether to search at once, without a goal of the action search'
    )
    state_timeout: float = Field(
        default=1.0,
        gt=0.0,
        description='Wall time without a state after which a robot is planned without; not in '
        'lockstep [s]',
    )
    views_rate: float = Field(
        default=1.0, ge=0.0, description='Most publications of exploration and markers [1/s]'
    )

    @model_validator(mode='after')
    def _others_are_others(self) -> PlannerNodeSettings:
        both = sorted(set(self.robots) & set(self.others))
        if both:
            raise ValueError(f'others: got {both}, allowed are names that are not in robots')
        return self
