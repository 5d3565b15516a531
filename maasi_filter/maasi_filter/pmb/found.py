"""Criteria for found targets, and matching of components and found targets."""

from __future__ import annotations

from collections.abc import Sequence

from maasi_filter.arrays import FloatArray
from maasi_filter.found_targets import SAME_TARGET, distance
from maasi_filter.pmb.component import Component
from maasi_filter.records import FoundTarget
from maasi_filter.vector_math import squared_distance

# Least expected number of detections of a found target: one precise detection is not enough.
LEAST_HITS = 1.5
# Expected joint detections in a scan from which two components are different targets.
SEEN_BOTH = 1.5


def can_be_found(item: Component, probability: float) -> bool:
    """Return whether a component almost surely exists, at a precisely known position.

    Parameters
    ----------
    probability : float
        Least existence probability.
    """
    return (
        item.target is None
        and item.existence > probability
        and item.hits >= LEAST_HITS
        and item.density.radius <= item.found_radius
    )


def is_known(i: int, components: Sequence[Component], caused: FloatArray) -> bool:
    """Return whether component i may be the same target as a found component.

    A target causes at most one detection per scan, so two components that together caused more than
    one are two targets.

    Parameters
    ----------
    caused : (n, m) array
        Probability that each component caused each detection of the scan.
    """
    density = components[i].density
    for f, other in enumerate(components):
        if other.target is None or components[i].differs(other):
            continue
        if caused[[i, f]].sum() > SEEN_BOTH:
            continue
        offset = density.mean - other.density.mean
        total = density.covariance + other.density.covariance
        if squared_distance(offset, total) < SAME_TARGET:
            return True
    return False


def nearest(target: FoundTarget, components: Sequence[Component]) -> Component | None:
    """Return the nearest component that is not found within the gate of a target, or None."""
    best, least = None, SAME_TARGET
    for item in components:
        if item.target is None:
            gap = distance(item.density.mean, item.density.covariance, target)
            if gap < least:
                best, least = item, gap
    return best
