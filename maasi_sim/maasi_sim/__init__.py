"""Simulation, runs of scenarios, and the experiments of the papers."""
