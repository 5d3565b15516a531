"""Searches of buildings (004): scenario, simulation, observer and report."""
