"""Runtime shared by all nodes: life cycle, lockstep, parameters, QoS, conversions."""
