"""Which components are found targets, and which of them a target from elsewhere may be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from maasi_filter.pmb.component import Component
from maasi_filter.records import FoundTarget

# Two estimates whose squared normalised difference is below this may be one target.
SAME_TARGET = 16.0
# Expected detections of a found target: one narrow detection alone is not enough.
LEAST_HITS = 1.5
# Detections of one scan that two components of one target do not cause together.
SEEN_BOTH = 1.5


def can_be_found(item: Component, probability: float) -> bool:
    """Return whether a component surely exists, and it is known well enough where.

    Parameters
    ----------
    probability : float
        Existence probability that is enough.
    """
    return (
        item.target is None
        and item.existence > probability
        and item.hits >= LEAST_HITS
        and item.density.radius <= item.found_radius
    )


def is_known(i: int, components: Sequence[Component], caused: NDArray[np.float64]) -> bool:
    """Return whether component i may be a found target that this scan has not seen beside it.

    A target causes one detection of a scan at most, so two components that together caused more
    than one are two targets.

    Parameters
    ----------
    caused : (n, m) array
        Probability that each component caused each detection of the scan.
    """
    density = components[i].density
    for f, other in enumerate(components):
        if other.target is None or caused[[i, f]].sum() > SEEN_BOTH:
            continue
        offset = density.mean - other.density.mean
        total = density.covariance + other.density.covariance
        if float(offset @ np.linalg.solve(total, offset)) < SAME_TARGET:
            return True
    return False


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
