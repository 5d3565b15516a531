"""Distributed model predictive control that searches the faces of objects (004)."""

from __future__ import annotations

from maasi_planner.buildings.agent import (
    Activity,
    Broadcast,
    Choice,
    SearchAgent,
    Snapshot,
    decision_stream,
)
from maasi_planner.buildings.centralized import JointPlan, solve_jointly
from maasi_planner.buildings.preplanning import CoveragePlan, plan_mission
from maasi_planner.buildings.problem import Objective, Plan, PlanSolver, Problem
from maasi_planner.buildings.robot_model import Dynamics
from maasi_planner.buildings.settings import (
    BoxSettings,
    CuboidSettings,
    DynamicsSettings,
    HazardSettings,
    ObjectSettings,
)

__all__ = [
    'Activity',
    'BoxSettings',
    'Broadcast',
    'Choice',
    'CoveragePlan',
    'CuboidSettings',
    'Dynamics',
    'DynamicsSettings',
    'HazardSettings',
    'JointPlan',
    'ObjectSettings',
    'Objective',
    'Plan',
    'PlanSolver',
    'Problem',
    'SearchAgent',
    'Snapshot',
    'decision_stream',
    'plan_mission',
    'solve_jointly',
]
