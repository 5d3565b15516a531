"""Fault campaign: whole runs in which nodes are killed or hang, and checks of their results."""
