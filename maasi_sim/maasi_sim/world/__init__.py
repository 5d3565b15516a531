"""The simulated world: targets, robots and their sensors, on one clock."""
