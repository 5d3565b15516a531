"""Poses, sensors, detection probabilities and measurement models."""
