"""Scenario files: area, robots, planner, filter, and the end of a run."""

from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.loading import find_scenario, load_scenario
from maasi_sim.scenario.schema import Scenario

__all__ = ['Scenario', 'ScenarioError', 'find_scenario', 'load_scenario']
