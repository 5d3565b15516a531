"""The runtime that all nodes share: life cycle, lockstep, parameters, QoS, conversions."""
