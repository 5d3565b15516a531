"""P2 and P1 of 004: the lean problem against the literal one, and states that are hard."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from cuboid_instances import (
    AREA,
    STARTS,
    mission_of,
    problems_of_missions,
    random_problem,
    solver_for,
    two_buildings,
)
from literal_cuboid import LiteralProblem, solve_with_highs, solve_with_scip

from maasi_planner.buildings import Dynamics, Objective, Problem, solve_jointly
from maasi_planner.buildings import problem as problem_module
from maasi_planner.buildings.preplanning import segment_cuts


def same_optimum(solver, problem, oracle=solve_with_highs):
    """Assert that the lean solution is the literal optimum; return whether there is one."""
    literal = LiteralProblem(solver.dynamics, solver.objective, problem)
    bound, value, _ = oracle(literal)
    plan = solver.solve(problem)
    if plan is None:
        assert value == np.inf
        return False
    assert plan.status == 'optimal'
    objective = literal.check(plan)
    assert objective == pytest.approx(plan.objective, abs=1e-6)
    assert bound - 1e-4 <= objective <= value + 1e-4
    return True


@pytest.mark.parametrize('part', range(4))
def test_same_optimum_as_the_literal_problem_on_problems_of_missions(part):
    solver, problems = problems_of_missions(3, 10, seed=part)
    assert all(same_optimum(solver, problem) for problem in problems)


@pytest.mark.parametrize('part', range(5))
def test_same_optimum_as_the_literal_problem_among_obstacles(part):
    rng = np.random.default_rng(part)
    solver = solver_for(4 if part == 0 else 3, discount=1.0 if part % 2 else 0.9)
    solved = sum(
        same_optimum(solver, random_problem(rng, 6, int(rng.integers(1, 3)))) for _ in range(12)
    )
    assert solved >= 6


def test_same_optimum_as_scip():
    rng = np.random.default_rng(9)
    solver = solver_for(3)
    for _ in range(3):
        same_optimum(solver, random_problem(rng, 3, 1), solve_with_scip)


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


CUBE = [[40.0, 60.0], [40.0, 60.0], [0.0, 100.0]]


def test_segments_do_not_cut_corners():
    solver = solver_for(6)
    cuts = {}
    for between in (True, False):
        problem = problem_at([37, 37, 10], [0, 0, 0], [65, 37, 10], obstacles=[CUBE])
        # Drawn around two corners of a thin wall: positions alone jump through it.
        problem.obstacles = np.array([[[48.0, 50.0], [0.0, 90.0], [0.0, 100.0]]])
        problem.between = between
        problem.brakes = False
        plan = solver.solve(problem)
        assert plan is not None
        cuts[between] = segment_cuts(
            plan.positions[:-1], plan.positions[1:], problem.obstacles + np.array([1e-3, -1e-3])
        ).any()
    assert cuts == {True: False, False: True}


def test_plans_around_a_corner_keep_off_it():
    solver = solver_for(10)
    for y in np.linspace(30.0, 70.0, 9):
        problem = problem_at([36, y, 10], [2, 3, 0], [64, 60, 10], obstacles=[CUBE])
        plan = solver.solve(problem)
        assert plan is not None
        shrunk = problem.obstacles + np.array([1e-3, -1e-3])
        assert not segment_cuts(plan.positions[:-1], plan.positions[1:], shrunk).any()


def test_falling_stops_above_the_floor():
    dynamics, solver = Dynamics(), solver_for(5)
    # About 50 m are needed to stop from 15 m/s.
    assert solver.solve(problem_at([50, 50, 30], [0, 0, -15], [50, 50, 5])) is None
    problem = problem_at([50, 50, 95], [0, 0, -15], [50, 50, 0])
    for _ in range(60):
        plan = solver.solve(problem)
        assert plan is not None
        problem.position, problem.velocity = plan.positions[1], plan.velocities[1]
        assert problem.position[2] >= -1e-3
    assert problem.position[2] < 1.0
    place, speed = np.array([50.0, 50.0, 95.0]), np.array([0.0, 0.0, -15.0])
    for _ in range(dynamics.braking_steps()):
        place, speed = dynamics.next(place, speed, dynamics.braking(speed))
    assert np.abs(speed).max() < 1e-9 and 30.0 < 95.0 - place[2] < 70.0


def test_every_plan_leaves_a_problem_that_has_one():
    rng = np.random.default_rng(3)
    solver = solver_for(4)
    for _ in range(15):
        problem = random_problem(rng, 5, 2)
        problem.between = problem.brakes = True
        for _ in range(8):
            plan = solver.solve(problem)
            if plan is None:
                break
            hint = [(k - 1, n) for k, n in plan.visits if k > 2]
            problem = replace(
                problem, position=plan.positions[1], velocity=plan.velocities[1], hint=hint
            )
            assert solver.solve(problem) is not None


def test_start_inside_a_cuboid():
    box = [[40.0, 60.0]] * 3
    solver = solver_for(5)
    plan = solver.solve(problem_at([50, 50, 50], [0, 0, 0], [50, 50, 50], [box]))
    assert plan is not None
    # P_1 is given by the state: the visit is due whatever is done.
    assert plan.visits == [(1, 0)]
    literal = LiteralProblem(
        solver.dynamics,
        solver.objective,
        problem_at([50, 50, 50], [0, 0, 0], [50, 50, 50], [box]),
    )
    assert literal.check(plan) == pytest.approx(plan.objective, abs=1e-6)


def test_a_given_visit_on_a_face_counts_despite_rounding():
    box = [[40.0, 60.0]] * 3
    plan = solver_for(5).solve(problem_at([40 - 1e-9, 50, 50], [0, 0, 0], [50, 50, 50], [box]))
    assert plan is not None and plan.visits == [(1, 0)]
    plan = solver_for(5).solve(problem_at([40 - 1e-3, 50, 50], [0, 0, 0], [50, 50, 50], [box]))
    assert plan is not None and [n for _, n in plan.visits] == [0] and plan.visits[0][0] > 1


@pytest.mark.parametrize('beyond', [0.0, 1e-6, 5e-5])
def test_start_at_a_bound_or_a_rounding_beyond(beyond):
    solver = solver_for(5)
    floor = problem_at([50, -beyond, -beyond], [0, 0, 0], [50, 20, 20])
    assert solver.solve(floor) is not None
    ceiling = problem_at([100 + beyond, 50, 100 + beyond], [0, 0, 0], [0, 50, 50])
    assert solver.solve(ceiling) is not None
    fast = problem_at([20, 50, 50], [15 + beyond, 0, 0], [90, 50, 50])
    assert solver.solve(fast) is not None
    face = problem_at([40 + beyond, 50, 10], [0, 0, 0], [20, 50, 10], obstacles=[CUBE])
    assert solver.solve(face) is not None


def test_flies_home_and_stays():
    solver = solver_for(10)
    problem = problem_at([80, 80, 40], [5, -5, 2], [20, 30, 0], homing=True)
    for _ in range(60):
        plan = solver.solve(problem)
        assert plan is not None and plan.visits == []
        problem = replace(problem, position=plan.positions[1], velocity=plan.velocities[1])
    assert problem.position == pytest.approx([20, 30, 0], abs=0.5)
    assert problem.velocity == pytest.approx([0, 0, 0], abs=0.2)


def test_node_limit_returns_the_best_plan_so_far():
    _, problems = problems_of_missions(10, 20, seed=5)
    limits = (3, 20000)
    few, many = (solver_for(10, node_limit=limit) for limit in limits)
    cut = 0
    for problem in problems:
        best, hasty = many.solve(problem), few.solve(problem)
        assert best is not None and best.status == 'optimal'
        if hasty is None:
            continue
        assert hasty.nodes <= limits[0]
        assert hasty.objective >= best.objective - 1e-6
        cut += hasty.status == 'node_limit'
    assert cut > 0


def test_time_limit_is_kept_and_said(monkeypatch):
    monkeypatch.setattr(problem_module, '_SLICE', 3)
    _, problems = problems_of_missions(10, 20, seed=5)
    solver = solver_for(10, time_limit=0.0)
    plans = [plan for plan in map(solver.solve, problems) if plan is not None]
    assert all(plan.nodes <= 3 for plan in plans)
    assert {plan.status for plan in plans} == {'optimal', 'time_limit'}


def test_hint_does_not_change_the_optimum():
    solver, problems = problems_of_missions(7, 20, seed=6)
    for problem in problems:
        with_hint = solver.solve(problem)
        without = solver.solve(replace(problem, hint=[]))
        assert with_hint is not None and without is not None
        assert with_hint.objective == pytest.approx(without.objective, abs=1e-6)


def test_joint_plan_is_the_best_division_of_the_cuboids():
    rng = np.random.default_rng(2)
    solver = solver_for(5)
    shared = 0
    for _ in range(12):
        first = random_problem(rng, 4, 1)
        second = replace(
            first,
            position=first.position,
            velocity=first.velocity + rng.uniform(-2.0, 2.0, 3),
            target=first.target,
        )
        problems = [first, second]
        if any(solver.solve(problem) is None for problem in problems):
            continue
        joint = solve_jointly(solver, problems)
        assert joint is not None and joint.status == 'optimal'
        visits = [n for plan in joint.plans for _, n in plan.visits]
        assert len(visits) == len(set(visits))
        best = np.inf
        for division in itertools.product((0, 1), repeat=4):
            parts = [
                solver.solve(replace(p, wanted=p.wanted & (np.array(division) == i)))
                for i, p in enumerate(problems)
            ]
            best = min(best, sum(plan.objective for plan in parts if plan is not None))
        assert joint.objective == pytest.approx(best, abs=2e-6)
        alone = [solver.solve(problem) for problem in problems]
        shared += joint.objective > sum(plan.objective for plan in alone) + 1e-3
    assert shared >= 2


def test_joint_plan_out_of_time_still_shares_nothing():
    mission = mission_of(two_buildings(horizon=7), AREA, STARTS)
    for name, agent in mission.agents.items():
        agent.observe(0, STARTS[name], np.zeros(3))
    everything = np.ones(32, dtype=bool)
    problems = [agent.problem([], everything) for agent in mission.agents.values()]
    joint = solve_jointly(mission.agents['red'].solver, problems, time_limit=0.0)
    assert joint is not None and joint.status == 'time_limit'
    visits = [n for plan in joint.plans for _, n in plan.visits]
    assert len(visits) == len(set(visits))


def test_settings_of_the_objective_are_checked():
    with pytest.raises(ValueError, match=r'horizon: got 1'):
        Objective(horizon=1)
    with pytest.raises(ValueError, match=r'guidance: got nan'):
        Objective(guidance=float('nan'))
    with pytest.raises(ValueError, match=r'cannot lift the weight of the robot.*32\.86 N'):
        Dynamics(force=30.0)
