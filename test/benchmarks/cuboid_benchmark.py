"""Time of the search of buildings (004), on problems that robots meet in missions of figure 4."""

from functools import partial

import numpy as np
from timing import entry, few, times_of

from maasi_planner.buildings.problem import solve_jointly

# Of SCIP: absolute gap, and time of an instance [s].
GAP, LIMIT = 1e-4, 20.0


def least_times(solve, problems, repeats):
    """Return the least wall time of a few calls for each problem [s]."""
    return np.array([min(times_of(partial(solve, item), repeats)) for item in problems])


def rows(name, times, **others):
    """Yield the median of times [ms], another of their values by name, and the largest."""
    for what, value in {name: np.median(times), **others, 'max': times.max()}.items():
        yield entry(what if what == name else f'{name}_{what}', float(value))


def against_scip(name, solver, problems):
    """Return how many times faster than a mixed-integer solver the median instance is solved."""
    from mixed_cuboid import solve_with_scip

    theirs, missed = [], 0
    for problem in problems:
        plan = solver.solve(problem)
        bound, value, spent = solve_with_scip(solver, problem, True, GAP, LIMIT)
        if plan is None or not bound - GAP <= plan.objective <= value + GAP:
            raise RuntimeError(f'SCIP: another optimum, in [{bound}, {value}]: {plan}')
        # Stopped by the limit: its time is at least this.
        missed += value - bound > 2.0 * GAP
        theirs.append(spent)
    what = f'SCIP, median {1e3 * float(np.median(theirs)):.0f} ms'
    if missed:
        what += f', {missed} of {len(problems)} stopped at {LIMIT:.0f} s'
    ratio = float(np.median(np.divide(theirs, least_times(solver.solve, problems, 3))))
    return entry(name, ratio, 'times', what, ratio)


def run(share=1.0):
    from cuboid_instances import joint_problems, problems_of_missions

    for horizon in (3, 7, 10):
        solver, problems = problems_of_missions(horizon, few(share, 300), seed=21)
        times = 1e3 * least_times(solver.solve, problems, 2)
        yield from rows(f'cuboid_solve_t{horizon}', times, p95=np.percentile(times, 95))
    for robots in (3, 5):
        solver, problems = joint_problems(robots, 7, few(share, 60), seed=22)
        times = 1e3 * least_times(partial(solve_jointly, solver), problems, 1)
        yield from rows(f'cuboid_centralized_{robots}_7', times, mean=times.mean())
    yield against_scip('cuboid_vs_scip_t7', *problems_of_missions(7, few(share, 15), seed=11))
