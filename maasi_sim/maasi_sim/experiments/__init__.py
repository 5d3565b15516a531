"""The papers' experiments, and comparisons of searches."""
