"""Distributed model predictive control that searches the faces of objects (004)."""

from __future__ import annotations

from maasi_planner.planners.cuboid.agent import (
    Activity,
    Broadcast,
    Choice,
    SearchAgent,
    Snapshot,
    decision_stream,
)
from maasi_planner.planners.cuboid.centralized import JointPlan, solve_jointly
from maasi_planner.planners.cuboid.dynamics import Dynamics
from maasi_planner.planners.cuboid.preplanning import Mission, plan_mission
from maasi_planner.planners.cuboid.problem import Objective, Plan, PlanSolver, Problem
from maasi_planner.planners.cuboid.settings import (
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
    'CuboidSettings',
    'Dynamics',
    'DynamicsSettings',
    'HazardSettings',
    'JointPlan',
    'Mission',
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
