"""Exact joint planning of all robots: 004, P1.

Without (5j) the problem decomposes into one problem P2 per robot. A cuboid that two robots plan to
visit counts once: best-first search branches by forbidding it to one or to the other robot. The
first node without such a conflict is the optimum.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from maasi_planner.buildings.problem import Plan, PlanSolver, Problem

# Tolerance of equal objectives [1].
_GAP = 1e-7


@dataclass
class JointPlan:
    """Plans of all robots.

    plans: in the order of the problems; objective: their sum, (6) with each cuboid counted once;
    status: optimal, or time_limit: conflicts were resolved in the order of the robots; solves:
    number of solved problems of single robots.
    """

    plans: list[Plan]
    objective: float
    status: Literal['optimal', 'time_limit']
    solves: int


def solve_jointly(
    solver: PlanSolver, problems: Sequence[Problem], time_limit: float = math.inf
) -> JointPlan | None:
    """Return the optimal plans of all robots; None if a robot has none."""
    begun = time.perf_counter()
    known: dict[tuple[int, frozenset[int]], Plan | None] = {}

    def plan_of(robot: int, forbidden: frozenset[int], hint: Plan | None = None) -> Plan | None:
        key = (robot, forbidden)
        if key not in known:
            problem = problems[robot]
            wanted = problem.wanted.copy()
            wanted[list(forbidden)] = False
            visits = problem.hint if hint is None else hint.visits
            kept = [(k, n) for k, n in visits if n not in forbidden]
            known[key] = solver.solve(replace(problem, wanted=wanted, hint=kept))
        return known[key]

    nothing: frozenset[int] = frozenset()
    first = [plan_of(robot, nothing) for robot in range(len(problems))]
    if any(plan is None for plan in first):
        return None
    number = 0
    begin = [plan for plan in first if plan is not None]
    queue: list[tuple[float, int, tuple[frozenset[int], ...], list[Plan]]] = [
        (_total(begin), number, tuple(nothing for _ in problems), begin)
    ]
    seen = {queue[0][2]}
    while queue:
        total, _, forbidden, plans = heapq.heappop(queue)
        conflict = _conflict(plans)
        if conflict is None:
            status: Literal['optimal', 'time_limit'] = 'optimal'
            return JointPlan(plans, total, status, len(known))
        if time.perf_counter() - begun > time_limit:
            return _in_turn(solver, problems, len(known))
        cuboid, robots = conflict
        # Branch: either this robot or all others must not visit the cuboid.
        one, others = robots[0], [robot for robot in range(len(problems)) if robot != robots[0]]
        for leaving in ([one], others):
            child = list(forbidden)
            new = list(plans)
            for robot in leaving:
                child[robot] = child[robot] | {cuboid}
                if any(n == cuboid for _, n in plans[robot].visits):
                    again = plan_of(robot, child[robot], plans[robot])
                    if again is None:
                        break
                    new[robot] = again
                # A plan that does not visit the cuboid remains optimal.
                known.setdefault((robot, child[robot]), new[robot])
            else:
                key = tuple(child)
                if key not in seen:
                    seen.add(key)
                    number += 1
                    heapq.heappush(queue, (_total(new), number, key, new))
    return None


def _total(plans: Sequence[Plan]) -> float:
    return round(math.fsum(plan.objective for plan in plans) / _GAP) * _GAP


def _conflict(plans: Sequence[Plan]) -> tuple[int, list[int]] | None:
    """Return a cuboid that several robots visit, and these robots."""
    users: dict[int, list[int]] = {}
    for robot, plan in enumerate(plans):
        for _, cuboid in plan.visits:
            users.setdefault(cuboid, []).append(robot)
    shared = {cuboid: robots for cuboid, robots in users.items() if len(robots) > 1}
    if not shared:
        return None
    cuboid = max(shared, key=lambda n: (len(shared[n]), -n))
    return cuboid, shared[cuboid]


def _in_turn(solver: PlanSolver, problems: Sequence[Problem], solves: int) -> JointPlan | None:
    """Return sequential plans, each without the cuboids of the earlier ones."""
    taken: set[int] = set()
    plans: list[Plan] = []
    for problem in problems:
        wanted = problem.wanted.copy()
        wanted[sorted(taken)] = False
        plan = solver.solve(replace(problem, wanted=wanted))
        if plan is None:
            return None
        taken |= {n for _, n in plan.visits}
        plans.append(plan)
    return JointPlan(plans, _total(plans), 'time_limit', solves + len(problems))
