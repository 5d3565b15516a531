"""Which measurement a group of particles comes from: whose target it is once it is found."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maasi_filter.state_file import text, untext

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Credit:
    """The measurement that a group of particles comes from.

    Attributes
    ----------
    robot : str
        Who measured.
    measurement : int
        That robot's measurement index.
    found_radius : float
        T_r of its sensor, metres.
    """

    robot: str
    measurement: int
    found_radius: float


def credit_of(
    weights: FloatArray, group: IntArray, credits: Sequence[Credit | None], otherwise: Credit
) -> Credit:
    """Return the credit of the heaviest group among some particles.

    Groups of particles that no detection explained, such as births anywhere, have none.

    Parameters
    ----------
    weights, group : (n,) arrays
        Of the particles of a cluster.
    credits : sequence
        Of each group.
    otherwise : Credit
        Where no group has one.
    """
    mass = np.bincount(group, weights, minlength=len(credits))
    known = [g for g, credit in enumerate(credits) if credit is not None and mass[g] > 0.0]
    if not known:
        return otherwise
    best = credits[max(known, key=lambda g: mass[g])]
    assert best is not None
    return best


def to_arrays(credits: Sequence[Credit | None]) -> dict[str, NDArray]:
    """Return credits as arrays of a state file."""
    rows = [(c.robot, c.measurement, c.found_radius) if c else ('', 0, 0.0) for c in credits]
    return {
        'credit_robots': text(json.dumps([row[0] for row in rows])),
        'credit_measurements': np.array([row[1] for row in rows], np.int64),
        'credit_radii': np.array([row[2] for row in rows], float),
    }


def from_arrays(state: Mapping[str, NDArray]) -> list[Credit | None]:
    """Return the credits in a state file.

    Raises
    ------
    ValueError
        If there is not a name for each.
    """
    robots = json.loads(untext(state['credit_robots']))
    count = len(state['credit_radii'])
    if not isinstance(robots, list) or list(map(type, robots)) != [str] * count:
        raise ValueError(f'credit_robots: got {str(robots)[:100]}, allowed are {count} names')
    return [
        Credit(robot, int(measurement), float(radius)) if robot else None
        for robot, measurement, radius in zip(
            robots,
            state['credit_measurements'],
            state['credit_radii'],
        )
    ]
