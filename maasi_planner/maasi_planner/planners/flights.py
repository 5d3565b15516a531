"""Flights of a team that are planned together: present ones, and those after charging."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_planner.team import TeamView

# Flights of a robot that are planned: a present flight that collects most leaves gaps, which cost
# later ones more.
MOST = 5
# Share of its prizes that the last flight loses, so that present ones collect early.
LATER = 0.5
# Length of a tour over all cells, in their widths; and of a flight the least part for cells.
WHOLE, USEFUL = 1.2, 0.3


class Flights(NamedTuple):
    """Flights with their robots.

    names (r,): of the robots, first the present flights of all, then the following ones;
    starts, ends (r, d) [m]: ends are not a number where the end is free; budgets (r,): longest
    paths [m]; speeds (r,) [m/s]; worths (r,): share of a prize that a flight gains, 1: present.
    """

    names: list[str]
    starts: FloatArray
    ends: FloatArray
    budgets: FloatArray
    speeds: FloatArray
    worths: FloatArray

    @property
    def limited(self) -> bool:
        """Whether some flight has to end at home."""
        return bool(np.isfinite(self.budgets).any())


def flights_of(team: TeamView, names: list[str], points: FloatArray, pitch: float) -> Flights:
    """Return the flights for cells of a width `pitch` [m] at points (n, d) [m]."""
    d, now, later = team.dimension, [], []
    for name in names:
        view = team.robots[name]
        here = view.destination
        start, end, budget, full = here, here + np.nan, math.inf, math.inf
        if view.endurance is not None:
            budget, home = view.endurance.range_from(here)
            full = view.endurance.full_range()
            if math.isfinite(budget):
                end = home
                if view.endurance.charging:
                    start, budget = home, full
        now.append((start[:d], end[:d], budget))
        later.append((end[:d], end[:d], full))
    number = _number(now, later, points, pitch)
    rows = now + later * (number - 1)
    worths = np.repeat(1.0 - LATER * np.arange(number) / number, len(names))
    speeds = [team.robots[name].motion.settings.speed for name in names]
    starts, ends, budgets = (np.array([row[i] for row in rows]) for i in range(3))
    return Flights(names * number, starts, ends, budgets, np.tile(speeds, number), worths)


def _number(now: list, later: list, points: FloatArray, pitch: float) -> int:  # type: ignore[type-arg]
    """Return how many flights of each robot it takes to visit all points, at most `MOST`."""
    missing = WHOLE * pitch * len(points) - sum(budget for *_, budget in now)
    if not missing > 0.0:
        return 1
    middle = points.mean(axis=0)
    useful = sum(
        max(full - 2.0 * float(np.linalg.norm(middle - home)), USEFUL * full)
        for home, _, full in later
    )
    return min(1 + math.ceil(missing / max(useful, 1e-9)), MOST)
