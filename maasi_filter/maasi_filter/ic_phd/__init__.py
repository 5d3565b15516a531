"""Particle PHD filter with an iterated corrector, and removal of found targets."""
