"""Poisson multi-Bernoulli filter."""
