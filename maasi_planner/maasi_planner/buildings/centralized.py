"""Exact joint planning of all robots: 004, P1.

Without (5j) it decomposes into one P2 per robot; best-first search forbids a cuboid that two robots
plan to visit to one or the other, and the first node without one is the optimum.
"""

import heapq
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from maasi_planner.buildings.problem import Plan, PlanSolver, Problem

_GAP = 1e-7  # tolerance of equal objectives [1]


def solve_jointly(solver: PlanSolver, problems: Sequence[Problem]) -> list[Plan] | None:
    """Return the optimal plans of all robots, in the order of the problems; None: one has none."""
    known: dict[tuple[int, frozenset[int]], Plan | None] = {}

    def plan_of(robot: int, forbidden: frozenset[int], hint: list[tuple[int, int]]) -> Plan | None:
        key = (robot, forbidden)
        if key not in known:
            problem = problems[robot]
            wanted = problem.wanted.copy()
            wanted[list(forbidden)] = False
            kept = [(k, n) for k, n in hint if n not in forbidden]
            known[key] = solver.solve(replace(problem, wanted=wanted, hint=kept))
        return known[key]

    nothing: frozenset[int] = frozenset()
    first = [plan_of(robot, nothing, problem.hint) for robot, problem in enumerate(problems)]
    begin = [plan for plan in first if plan is not None]
    if len(begin) < len(problems):
        return None
    start = tuple(nothing for _ in problems)
    queue = [(_total(begin), 0, start, begin)]
    seen = {start}
    while queue:
        _, _, forbidden, plans = heapq.heappop(queue)
        users = Counter(n for plan in plans for _, n in plan.visits)
        cuboid = max(users, key=lambda n: (users[n], -n), default=None)
        if cuboid is None or users[cuboid] == 1:
            return plans
        visiting = [
            robot for robot, plan in enumerate(plans) if any(n == cuboid for _, n in plan.visits)
        ]
        # Branch: either the first of these robots or all others must not visit the cuboid.
        others = [robot for robot in range(len(problems)) if robot != visiting[0]]
        for leaving in (visiting[:1], others):
            child, new = list(forbidden), list(plans)
            for robot in leaving:
                child[robot] = child[robot] | {cuboid}
                if robot in visiting:
                    again = plan_of(robot, child[robot], plans[robot].visits)
                    if again is None:
                        break
                    new[robot] = again
                # A plan that does not visit the cuboid remains optimal.
                known.setdefault((robot, child[robot]), new[robot])
            else:
                key = tuple(child)
                if key not in seen:
                    seen.add(key)
                    heapq.heappush(queue, (_total(new), len(seen), key, new))
    return None


def _total(plans: Sequence[Plan]) -> float:
    return round(math.fsum(plan.objective for plan in plans) / _GAP) * _GAP
