"""Objective of a decision: the value of a joint candidate of the team (000, section 4.2)."""
