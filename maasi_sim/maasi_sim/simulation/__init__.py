"""The simulation: world, robots and sensors on one clock, emulated vehicles, the sim node."""
