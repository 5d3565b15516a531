"""What the simulation node publishes, beside time and steps."""
