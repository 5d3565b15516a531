"""Found targets that come from elsewhere: other robots' filters, or a search before a restart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maasi_filter.pmb.component import Component
from maasi_filter.records import FoundTarget

# Two estimates whose squared normalised difference is below this may be one target.
SAME_TARGET = 16.0


def nearest(target: FoundTarget, components: Sequence[Component]) -> Component | None:
    """Return the nearest component that may be a target, or None."""
    best, least = None, SAME_TARGET
    for item in components:
        position, covariance = item.density.mean, item.density.covariance
        if item.target is not None:
            position, covariance = item.target.position, item.target.covariance
        offset = position - target.position
        distance = float(offset @ np.linalg.solve(covariance + target.covariance, offset))
        if distance < least:
            best, least = item, distance
    return best


def same_estimate(one: FoundTarget, other: FoundTarget) -> bool:
    """Return whether nothing of an estimate has changed."""
    return (
        one.origin == other.origin
        and one.robot == other.robot
        and np.array_equal(one.position, other.position)
        and np.array_equal(one.covariance, other.covariance)
    )
