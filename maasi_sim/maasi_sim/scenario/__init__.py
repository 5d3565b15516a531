"""Scenario files: what is searched, by which robots, how, and when it ends."""

from maasi_sim.scenario.layering import ScenarioError
from maasi_sim.scenario.loading import find_scenario, load_scenario
from maasi_sim.scenario.schema import Scenario

__all__ = ['Scenario', 'ScenarioError', 'find_scenario', 'load_scenario']
