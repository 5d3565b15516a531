"""Settings of the planner node."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field, model_validator

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.ros.node_settings import NodeSettings
from maasi_filter.settings import NotNegative, Positive, Settings, Vector3
from maasi_planner.endurance import EnduranceSettings
from maasi_planner.settings import AnyPlanner, CandidateSettings, RobotModel, planner_settings


class PlannedRobotSettings(RobotModel):
    """Settings of a robot for the planner."""

    radius: NotNegative = Field(0.1, description='Radius of a circle around the robot [m]')
    candidates: CandidateSettings = Field(
        description='Waypoints that the planner picks from; default in a scenario: a grid from '
        'which the robot sees the whole area'
    )
    endurance: EnduranceSettings | None = Field(
        None,
        description='Battery model, which brings the robot home before its battery is empty; '
        'default: unlimited battery',
    )


class OtherRobotSettings(Settings):
    """Settings of a robot with its own planner."""

    radius: NotNegative = Field(0.1, description='Radius of a circle around the robot [m]')
    start: Vector3 = Field(description='Start position [m, map]')


class PlannerNodeSettings(NodeSettings):
    """Settings of the planner node."""

    live: ClassVar[frozenset[str]] = frozenset(
        {
            'state_timeout',
            'views_rate',
            'planner.threshold',
            'planner.gamma',
            'planner.explored_threshold',
            'planner.mass_threshold',
            'planner.gain_threshold',
        }
    )

    environment: EnvironmentSettings = Field(
        description='Search area, keep-outs, obstacles and prior'
    )
    planner: AnyPlanner = Field(default_factory=planner_settings, description='Planner')
    robots: dict[str, PlannedRobotSettings] = Field(min_length=1, description='Robots by name')
    others: dict[str, OtherRobotSettings] = Field(
        {},
        description='Robots with their own planner, by name; this planner avoids their '
        'destinations',
    )
    exploration_spacing: float | None = Field(
        None, gt=0.0, description='Spacing of the exploration grid; default: that of the filter [m]'
    )
    search_on_start: bool = Field(
        False,
        description='Whether the search starts as soon as the planner is active; otherwise it '
        'starts with the service search/start or a goal of the action search',
    )
    state_timeout: Positive = Field(
        1.0,
        description='Time without a state after which the planner plans without the robot; not in '
        'lockstep [s]',
    )
    filter_timeout: NotNegative = Field(
        4.0,
        description='Wall time without a heartbeat of the filter, or without the update of a '
        'batch, after which all robots are held; 0 disables this; not in lockstep [s]',
    )
    views_rate: NotNegative = Field(
        1.0, description='Highest rate of exploration and marker messages [1/s]'
    )

    @model_validator(mode='after')
    def _others_are_others(self) -> PlannerNodeSettings:
        both = sorted(set(self.robots) & set(self.others))
        if both:
            raise ValueError(f'others: got {both}, allowed are names that are not in robots')
        return self
