"""Emulated vehicles that are reached by their own protocols."""
