"""Distributed model predictive control that searches the faces of objects (004)."""
