"""Planning of waypoints and measurements: planners, motion models and objectives."""

from maasi_planner.candidates import CandidateSet, Unseen, Viewer, unseen_parts
from maasi_planner.measurement_schedule import MeasurementSchedule
from maasi_planner.motion import MotionModel, RobotState, Trajectories, make_motion
from maasi_planner.planners import Planner, make_planner
from maasi_planner.settings import (
    CandidateSettings,
    MotionSettings,
    PlannerSettings,
    planner_settings,
)
from maasi_planner.team import Decision, RobotDecision, RobotView, TeamView
from maasi_planner.warm_up import warm_up

__all__ = [
    'CandidateSet',
    'CandidateSettings',
    'Decision',
    'MeasurementSchedule',
    'MotionModel',
    'MotionSettings',
    'Planner',
    'PlannerSettings',
    'RobotDecision',
    'RobotState',
    'RobotView',
    'TeamView',
    'Trajectories',
    'Unseen',
    'Viewer',
    'make_motion',
    'make_planner',
    'planner_settings',
    'unseen_parts',
    'warm_up',
]
