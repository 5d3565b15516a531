"""Searches for targets: nodes, observer, scores and report."""
