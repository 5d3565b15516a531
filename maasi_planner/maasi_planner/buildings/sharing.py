"""What robots tell each other, and how they share the cuboids: 004, (10) to (14)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.buildings.settings import CuboidMethodSettings, HazardSettings


@dataclass(frozen=True)
class Broadcast:
    """Message of a robot to those in range at a step (V-B)."""

    robot: str
    step: int  # t
    position: FloatArray  # (3,) [m]
    velocity: FloatArray  # (3,) [m/s]
    searching: bool  # whether it takes part; on its way home it still shares its search map
    visited: BoolArray  # (N,): V, its search map
    flight_steps: int  # t_Fl, since its last recharge
    plan: Mapping[int, int]  # steps from now until the visit, by cuboid, of the plan before
    hazard: HazardSettings  # of its battery
    predicted: FloatArray  # (3,): position at t + tau* + 1 in the plan before [m]


def assigned(places: FloatArray, own: int, centres: FloatArray, unvisited: IntArray) -> int | None:
    """Return the cuboid assigned to robot `own` of robots at places (m, 3): (10); None: too few."""
    if not len(unvisited):
        return None
    # Deferred: SciPy takes long to import, and searches for targets do not need it.
    from scipy.optimize import linear_sum_assignment

    cost = np.sqrt(((places[:, None, :] - centres[unvisited][None, :, :]) ** 2).sum(axis=2))
    rows, columns = linear_sum_assignment(cost)
    chosen = np.flatnonzero(rows == own)
    return int(unvisited[columns[chosen[0]]]) if len(chosen) else None


def rewards(
    settings: CuboidMethodSettings,
    hazard: HazardSettings,
    flight_steps: int,
    heard: Sequence[Broadcast],
    draws: FloatArray,
) -> BoolArray:
    """Return r(n) for all cuboids, (N,): (11) to (14), from as many numbers drawn from 0 to 1."""
    result = np.ones(len(draws), dtype=bool)
    own = hazard.failure(flight_steps + settings.horizon)
    low = own <= 0.5
    holds = low if settings.condition == 'low_hazard' else not low
    for n in {n for message in heard for n in message.plan}:
        product, expected = 1.0, 0.0
        for message in heard:
            if n in message.plan:
                fails = message.hazard.failure(message.flight_steps + message.plan[n] - 1)  # (11)
                product *= fails
                expected += 1.0 - fails
        missed = (1.0 - own) * product  # (12)
        grown = settings.alpha * math.exp(-settings.beta * (expected - settings.alpha))
        joins = 1.0 - 1.0 / (1.0 + grown) if holds else 0.0
        result[n] = draws[n] < max(missed, joins)  # (13), (14)
    return result
