"""Found targets that come from elsewhere: other robots' filters, or a search before a restart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maasi_filter.ic_phd.found_targets import FoundTarget
from maasi_filter.ic_phd.search_filter import SAME_TARGET
from maasi_filter.models.sensor import is_covariance
from maasi_filter.pmb.component import Component


def check_taken(robot: str, targets: Sequence[FoundTarget], dimension: int) -> None:
    """Refuse targets with numbers that are not finite, or of another dimension.

    Raises
    ------
    ValueError
        Naming the robot, the target and what is allowed.
    """
    for target in targets:
        shapes = target.position.shape, target.covariance.shape
        if shapes != ((dimension,), (dimension, dimension)):
            raise ValueError(
                f'{robot}: target {target.id}: got {len(target.position)} dimensions, allowed '
                f'is {dimension}'
            )
        if not (np.isfinite(target.position).all() and is_covariance(target.covariance)):
            raise ValueError(
                f'{robot}: target {target.id}: got position {target.position.tolist()} with '
                f'covariance {target.covariance.tolist()}, allowed are finite numbers and a '
                'positive definite matrix'
            )


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
