"""Fault campaign: whole runs in which nodes are killed or hang, judged by what they leave."""
