"""Runtime shared by all nodes: life cycle, lockstep, parameters, QoS, conversions.

It stands in the first package with nodes, so that all others can import it: packages import one
way.
"""
