"""The particle PHD filter with an iterated corrector, and what it adds to find targets."""
