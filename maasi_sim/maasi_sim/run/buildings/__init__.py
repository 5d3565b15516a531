"""Searches of buildings (paper 004): scenario, simulation, observer and report."""
