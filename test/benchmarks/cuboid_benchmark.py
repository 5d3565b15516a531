"""Time of the search of buildings (004), on problems that robots meet in missions of figure 4."""

import time
from functools import partial

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array
from timing import entry, few, times_of

from maasi_planner.buildings.problem import solve_jointly

# Of other solvers: absolute gap, and time of an instance [s].
GAP, LIMIT = 1e-4, 20.0


def least_times(solve, problems, repeats):
    """Return the least wall time of a few calls for each problem [s]."""
    return np.array([min(times_of(partial(solve, item), repeats)) for item in problems])


def rows(name, times, **others):
    """Yield the median of times [ms], another of their values by name, and the largest."""
    for what, value in {name: np.median(times), **others, 'max': times.max()}.items():
        yield entry(what if what == name else f'{name}_{what}', float(value))


def solve_with_highs(mixed, gap, limit):
    """Return (lower bound, value of the best point found, seconds) of HiGHS, by `milp` of SciPy.

    It takes no squares with integers: tangents bound them from below, until they are tight.
    """
    begun = time.perf_counter()
    number, count = len(mixed.cost), len(mixed.squares)
    cost = np.array([*mixed.cost, *(weight for weight, *_ in mixed.squares)])
    bounds = Bounds([*mixed.lower, *[0.0] * count], [*mixed.upper, *[np.inf] * count])
    integrality = np.array([*mixed.integer, *[False] * count], int)
    rows = list(mixed.rows)

    def add_tangent(index, at):
        _, columns, coefficients, constant = mixed.squares[index]
        slopes = -2.0 * at * np.array(coefficients)
        least = 2.0 * at * constant - at * at
        rows.append(([*columns, number + index], [*slopes, 1.0], least, np.inf))

    for index in range(count):
        for at in (2.0, 7.0, 20.0, 60.0):
            add_tangent(index, at)
            add_tangent(index, -at)
    best, bound = np.inf, -np.inf
    while (left := limit - (time.perf_counter() - begun)) > 0.0:
        lengths = [len(columns) for columns, *_ in rows]
        at = np.repeat(np.arange(len(rows)), lengths), np.concatenate([row[0] for row in rows])
        values = np.concatenate([row[1] for row in rows])
        matrix = csr_array((values, at), (len(rows), len(cost)))
        limits = LinearConstraint(matrix, [row[2] for row in rows], [row[3] for row in rows])
        options = {'time_limit': left, 'mip_rel_gap': 0.0}
        solved = milp(
            cost, integrality=integrality, bounds=bounds, constraints=limits, options=options
        )
        if solved.mip_dual_bound is not None:
            bound = max(bound, solved.mip_dual_bound)
        if solved.x is None:
            break
        best = min(best, mixed.value(solved.x[:number]))
        if best - bound <= gap or solved.status != 0:
            break
        for index, (weight, columns, coefficients, constant) in enumerate(mixed.squares):
            at = float(np.dot(coefficients, solved.x[columns])) + constant
            if weight * (at * at - solved.x[number + index]) > 0.1 * gap / count:
                add_tangent(index, at)
    return bound, best, time.perf_counter() - begun


def against_solver(name, peer, solve, solver, problems):
    """Return how many times faster than a mixed-integer solver the median instance is solved."""
    from mixed_cuboid import MixedProblem

    theirs, missed = [], 0
    for problem in problems:
        plan = solver.solve(problem)
        bound, value, spent = solve(MixedProblem(solver, problem, apart=True), GAP, LIMIT)
        if plan is None or not bound - GAP <= plan.objective <= value + GAP:
            raise RuntimeError(f'{peer}: another optimum, in [{bound}, {value}]: {plan}')
        # Stopped by the limit: its time is at least this.
        missed += value - bound > 2.0 * GAP
        theirs.append(spent)
    what = f'{peer}, median {1e3 * float(np.median(theirs)):.0f} ms'
    if missed:
        what += f', {missed} of {len(problems)} stopped at {LIMIT:.0f} s'
    ratio = float(np.median(np.divide(theirs, least_times(solver.solve, problems, 3))))
    return entry(name, ratio, 'times', what, ratio)


def run(share=1.0):
    from cuboid_instances import joint_problems, problems_of_missions
    from mixed_cuboid import solve_with_scip

    for horizon in (3, 7, 10):
        solver, problems = problems_of_missions(horizon, few(share, 300), seed=21)
        times = 1e3 * least_times(solver.solve, problems, 2)
        yield from rows(f'cuboid_solve_t{horizon}', times, p95=np.percentile(times, 95))
    for robots in (3, 5):
        solver, problems = joint_problems(robots, 7, few(share, 60), seed=22)
        times = 1e3 * least_times(partial(solve_jointly, solver), problems, 1)
        yield from rows(f'cuboid_centralized_{robots}_7', times, mean=times.mean())
    case = problems_of_missions(7, few(share, 15), seed=11)
    for peer, solve in (('SCIP', solve_with_scip), ('HiGHS', solve_with_highs)):
        yield against_solver(f'cuboid_vs_{peer.lower()}_t7', peer, solve, *case)
