"""P2 and P1 of 004: the lean problem against a mixed-integer one, and states that are hard."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from cuboid_instances import problems_of_missions, random_problem, solver_for
from mixed_cuboid import MixedProblem, solve_with_scip

from maasi_planner.buildings import problem as problem_module
from maasi_planner.buildings.preplanning import segment_cuts
from maasi_planner.buildings.problem import Problem, solve_jointly


def same_optimum(solver, problem):
    """Assert that the lean solution is the optimum; return whether there is one."""
    mixed = MixedProblem(solver, problem)
    bound, value, _ = solve_with_scip(mixed)
    plan = solver.solve(problem)
    if plan is None:
        assert value == np.inf
        return False
    assert plan.how == 'optimal'
    objective = mixed.check(plan)
    assert objective == pytest.approx(plan.objective, abs=1e-6)
    assert bound - 1e-4 <= objective <= value + 1e-4
    return True


def test_same_optimum_as_scip_on_problems_of_missions():
    solver, problems = problems_of_missions(3, 20, seed=0)
    assert all(same_optimum(solver, problem) for problem in problems)


@pytest.mark.parametrize('part', range(4))
def test_same_optimum_as_scip_among_obstacles(part):
    rng = np.random.default_rng(part)
    horizon, discount = 4 if part == 0 else 3, 1.0 if part % 2 else 0.9
    ways = ({}, {'between_samples': False}, {'between_samples': False, 'brake_at_end': False})
    solvers = [solver_for(horizon, discount, **way) for way in ways]
    solved = sum(
        same_optimum(solvers[number % 3], random_problem(rng, 6, int(rng.integers(1, 3))))
        for number in range(6 if part == 0 else 9)
    )
    assert solved >= (3 if part == 0 else 5)


def problem_at(position, velocity, target, cuboids=(), obstacles=(), **others):
    """Return a problem in a box of 100 m."""
    corners = np.array(cuboids, dtype=float).reshape(-1, 3, 2)
    return Problem(
        position=np.array(position, dtype=float),
        velocity=np.array(velocity, dtype=float),
        target=np.array(target, dtype=float),
        cuboids=corners,
        wanted=np.ones(len(corners), dtype=bool),
        obstacles=np.array(obstacles, dtype=float).reshape(-1, 3, 2),
        area=np.array([[0.0, 100.0]] * 3),
        **others,
    )


def flown(solver, problem, steps):
    """Yield the plans of a robot that flies the first step of each."""
    for _ in range(steps):
        plan = solver.solve(problem)
        assert plan is not None
        yield plan
        problem = replace(problem, position=plan.positions[1], velocity=plan.velocities[1])


def cuts(plan, problem):
    shrunk = problem.obstacles + np.array([1e-3, -1e-3])
    return segment_cuts(plan.positions[:-1], plan.positions[1:], shrunk).any()


CUBE = [[40.0, 60.0], [40.0, 60.0], [0.0, 100.0]]
THIN_WALL = [[48.0, 50.0], [0.0, 90.0], [0.0, 100.0]]  # positions alone jump through it


@pytest.mark.parametrize('between', [True, False])
def test_segments_keep_off_obstacles_unless_as_printed(between):
    solver = solver_for(6, between_samples=between)
    problem = problem_at([37, 37, 10], [8, 0, 0], [65, 37, 10], obstacles=[THIN_WALL])
    cut = [cuts(plan, problem) for plan in flown(solver, problem, 5)]
    assert any(cut) != between


def test_falling_stops_above_the_floor():
    solver = solver_for(5)
    # About 50 m are needed to stop from 15 m/s.
    assert solver.solve(problem_at([50, 50, 30], [0, 0, -15], [50, 50, 5])) is None
    problem = problem_at([50, 50, 95], [0, 0, -15], [50, 50, 0])
    heights = [plan.positions[1, 2] for plan in flown(solver, problem, 60)]
    assert min(heights) >= -1e-3 and heights[-1] < 1.0
    dynamics, steps = solver.dynamics, solver.dynamics.braking_steps()
    places, speeds, _ = dynamics.fly(problem.position, problem.velocity, [], steps)
    assert np.abs(speeds[-1]).max() < 1e-9 and 30.0 < 95.0 - places[-1, 2] < 70.0


def test_as_printed_a_plan_leaves_no_room_to_brake():
    falling = problem_at([50, 50, 48], [0, 0, -15], [50, 50, 5])
    printed = solver_for(5, brake_at_end=False)
    plan = printed.solve(falling)
    assert solver_for(5).solve(falling) is None and plan.positions[-1, 2] >= -1e-3
    # The next problem has no solution.
    problem = replace(falling, position=plan.positions[1], velocity=plan.velocities[1])
    assert printed.solve(problem) is None


def test_every_plan_leaves_a_problem_that_has_one():
    rng = np.random.default_rng(3)
    solver, problems = solver_for(4), []
    while len(problems) < 8:
        problem = random_problem(rng, 5, 2)
        if solver.solve(problem) is not None:
            problems.append(problem)
    for problem in problems:
        assert len(list(flown(solver, problem, 9))) == 9


@pytest.mark.parametrize(('x', 'due'), [(50.0, True), (40 - 1e-9, True), (40 - 1e-3, False)])
def test_a_given_visit_counts_despite_rounding(x, due):
    """P_1 is given by the state: inside a cuboid or on its face the visit is due."""
    problem = problem_at([x, 50, 50], [0, 0, 0], [50, 50, 50], [[[40.0, 60.0]] * 3])
    solver = solver_for(5)
    plan = solver.solve(problem)
    ((step, cuboid),) = plan.visits
    assert cuboid == 0 and (step == 1) == due
    assert MixedProblem(solver, problem).check(plan) == pytest.approx(plan.objective, abs=1e-6)


@pytest.mark.parametrize('beyond', [0.0, 1e-6, 5e-5])
def test_start_at_a_bound_or_a_rounding_beyond(beyond):
    solver = solver_for(5)
    for position, velocity, target, obstacles in (
        ([50, -beyond, -beyond], [0, 0, 0], [50, 20, 20], []),
        ([100 + beyond, 50, 100 + beyond], [0, 0, 0], [0, 50, 50], []),
        ([20, 50, 50], [15 + beyond, 0, 0], [90, 50, 50], []),
        ([40 + beyond, 50, 10], [0, 0, 0], [20, 50, 10], [CUBE]),
    ):
        assert solver.solve(problem_at(position, velocity, target, (), obstacles)) is not None


def test_limits_return_the_best_plan_so_far(monkeypatch):
    _, problems = problems_of_missions(10, 20, seed=5)
    best = [solver_for(10).solve(problem) for problem in problems]
    assert {plan.how for plan in best} == {'optimal'}
    few = [solver_for(10, node_limit=3).solve(problem) for problem in problems]
    # Wall time is looked at after each slice.
    monkeypatch.setattr(problem_module, '_SLICE', 3)
    quick = [solver_for(10, time_limit=1e-9).solve(problem) for problem in problems]
    for hasty in (few, quick):
        pairs = [(plan, whole) for plan, whole in zip(hasty, best) if plan is not None]
        assert {plan.how for plan, _ in pairs} == {'optimal', 'best_so_far'}
        for plan, whole in pairs:
            assert plan.nodes <= 3 and plan.objective >= whole.objective - 1e-6


def test_hint_does_not_change_the_optimum():
    solver, problems = problems_of_missions(7, 20, seed=6)
    hinted = [problem for problem in problems if problem.hint]
    assert len(hinted) > 5
    for problem in hinted:
        objectives = [solver.solve(p).objective for p in (problem, replace(problem, hint=[]))]
        assert objectives[0] == pytest.approx(objectives[1], abs=1e-6)


def test_joint_plan_is_the_best_division_of_the_cuboids():
    rng = np.random.default_rng(2)
    solver = solver_for(5)
    shared = 0
    for _ in range(12):
        first = random_problem(rng, 4, 1)
        second = replace(first, velocity=first.velocity + rng.uniform(-2.0, 2.0, 3))
        problems = [first, second]
        alone = [solver.solve(problem) for problem in problems]
        joint = solve_jointly(solver, problems)
        assert (joint is None) == (None in alone)
        if joint is None:
            continue
        visits = [n for plan in joint for _, n in plan.visits]
        assert len(visits) == len(set(visits))
        best = np.inf
        for division in itertools.product((0, 1), repeat=4):
            parts = [
                solver.solve(replace(p, wanted=p.wanted & (np.array(division) == i)))
                for i, p in enumerate(problems)
            ]
            best = min(best, sum(plan.objective for plan in parts))
        objective = sum(plan.objective for plan in joint)
        assert objective == pytest.approx(best, abs=2e-6)
        shared += objective > sum(plan.objective for plan in alone) + 1e-3
    assert shared >= 2
