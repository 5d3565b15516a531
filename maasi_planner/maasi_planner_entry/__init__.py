"""Console scripts of maasi_planner."""

from functools import partial

from maasi_filter_entry import run

cuboid_planner_node = partial(run, 'maasi_planner.buildings.cuboid_planner_node:CuboidPlannerNode')
planner_node = partial(run, 'maasi_planner.planner_node:PlannerNode')
