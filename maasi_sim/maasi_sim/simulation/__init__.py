"""The simulation: world, robots and sensors on one clock, emulated vehicles, and its node."""
