"""Time of the search of buildings (004): `run()` returns a list of figures.

The instances are problems that robots meet in missions of figure 4 with N = 32 cuboids and the
paper's undiscounted rewards. SCIP gets the same instances in the same run, as the tight
formulation of `MixedProblem`, to an absolute gap of 1e-4, and at most 20 s each.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / 'planner'))

from cuboid_instances import joint_problems, problems_of_missions
from mixed_cuboid import MixedProblem, solve_with_scip
from timing import entry

from maasi_planner.buildings.centralized import solve_jointly

GAP, LIMIT = 1e-4, 20.0


def time_of(function: Callable[[], Any], repeats: int = 3) -> float:
    """Return the least wall time of a few calls [s]."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        function()
        times.append(time.perf_counter() - begun)
    return min(times)


def against_scip(number: int) -> dict[str, object]:
    """Return how many times faster than SCIP the median instance is solved."""
    solver, problems = problems_of_missions(7, number, seed=11)
    ratios, theirs, missed = [], [], 0
    for problem in problems:
        ours = time_of(lambda problem=problem: solver.solve(problem))
        plan = solver.solve(problem)
        bound, value, spent = solve_with_scip(MixedProblem(solver, problem, apart=True), GAP, LIMIT)
        if plan is None or not bound - GAP <= plan.objective <= value + GAP:
            raise RuntimeError(f'SCIP: another optimum, in [{bound}, {value}]: {plan}')
        # Stopped by the limit: its time is at least this.
        missed += value - bound > 2.0 * GAP
        ratios.append(spent / ours)
        theirs.append(spent)
    what = f'SCIP, median {1e3 * float(np.median(theirs)):.0f} ms'
    if missed:
        what += f', {missed} of {number} stopped at {LIMIT:.0f} s'
    ratio = float(np.median(ratios))
    return entry('cuboid_vs_scip_t7', ratio, 'times', what, ratio)


def run(share: float = 1.0) -> list[dict[str, object]]:
    def few(number: int) -> int:
        return max(1, round(share * number))

    rows = []
    for horizon in (3, 7, 10):
        solver, problems = problems_of_missions(horizon, few(300), seed=21)
        times = [1e3 * time_of(lambda p=p, s=solver: s.solve(p), 2) for p in problems]
        rows.append(entry(f'cuboid_solve_t{horizon}', float(np.median(times))))
        rows.append(entry(f'cuboid_solve_t{horizon}_p95', float(np.percentile(times, 95))))
        rows.append(entry(f'cuboid_solve_t{horizon}_max', max(times)))
    for robots in (3, 5):
        solver, joint = joint_problems(robots, 7, few(60), seed=22)
        times = [1e3 * time_of(lambda p=p, s=solver: solve_jointly(s, p), 1) for p in joint]
        name = f'cuboid_centralized_{robots}_7'
        rows.append(entry(name, float(np.median(times))))
        rows.append(entry(f'{name}_mean', float(np.mean(times))))
        rows.append(entry(f'{name}_max', max(times)))
    rows.append(against_scip(few(15)))
    return rows
