"""P2 of 004, the problem of one robot at a step, and P1, the joint one, with exact solutions.

Without (5j) P1 decomposes into one P2 per robot. Best-first search forbids a cuboid that two robots
plan to visit to one or the other; the first node without conflicts is the optimum.
"""

import heapq
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.buildings import branch_and_bound as bb
from maasi_planner.buildings.axis_problem import SCALE, axis_rows
from maasi_planner.buildings.dynamics import Dynamics
from maasi_planner.buildings.search_tree import make_tree
from maasi_planner.buildings.settings import CuboidMethodSettings

How = Literal['optimal', 'best_so_far', 'shifted', 'brake']

GIVE = 1e-4  # relaxation of bounds if rounding leaves the state outside of them [m, m/s]
TOUCH = 1e-6  # tolerance of the present position in a cuboid, whose faces plans touch [m]
_SLICE, _CAPACITY = 500, 16384  # nodes between checks of the time limit; capacity of open nodes
# Share of the smoothness weight on the flight home, which makes forces unique.
_HOMING_SMOOTHNESS = 1e-2


@dataclass
class Problem:
    """State and knowledge of a robot when it plans."""

    position: FloatArray  # (3,) [m]
    velocity: FloatArray  # (3,) [m/s]
    target: FloatArray  # (3,): x*, guidance target [m]
    cuboids: FloatArray  # (N, 3, 2): lower and upper corners [m]
    wanted: BoolArray  # (N,): which are unvisited and have a reward of 1
    obstacles: FloatArray  # (O, 3, 2): objects and obstacles, clearance included [m]
    area: FloatArray  # (3, 2): admissible positions [m]
    homing: bool = False  # whether it only flies to its target (8)
    hint: list[tuple[int, int]] = field(default_factory=list)  # visits of the previous plan
    put_off: int = 0  # consecutive postponements of the first visit, if rewards are discounted


@dataclass
class Plan:
    """A plan from P_0 on."""

    positions: FloatArray  # (T + 1, 3), from now on [m]
    velocities: FloatArray  # (T + 1, 3) [m/s]
    controls: FloatArray  # (T, 3): forces [N]
    visits: list[tuple[int, int]]  # step, from 1, and cuboid, each once, in order
    how: How  # best_so_far: a limit was reached; shifted, brake: no solution
    objective: float = float('nan')  # value of (9), without cuboids visited earlier
    nodes: int = 0  # number of solved relaxations


class PlanSolver:
    """Solves the problems of one kind of robot within a number of nodes or seconds."""

    def __init__(self, dynamics: Dynamics, settings: CuboidMethodSettings) -> None:
        self.dynamics, self.settings = dynamics, settings
        horizon, smoothness = settings.horizon, settings.smoothness_weight
        pull = np.zeros(horizon + 1)
        pull[settings.guided] = settings.guidance_weight
        # As printed, the path after the horizon is unconstrained.
        steps = dynamics.braking_steps() if settings.brake_at_end else 0
        self._rolling = dynamics.rolling_distances(steps)
        self._rise, self._sink = dynamics.distance_reductions(steps)
        self._search = axis_rows(dynamics, horizon, pull, smoothness, self._rolling)
        pull = np.full(horizon + 1, settings.guidance_weight)
        pull[0] = 0.0
        self._homing = axis_rows(
            dynamics, horizon, pull, _HOMING_SMOOTHNESS * smoothness, self._rolling
        )
        self._tree = make_tree(_CAPACITY, horizon, len(self._search.matrix))

    def solve(self, problem: Problem) -> Plan | None:
        """Return the best plan or None; `GIVE` relaxes bounds that rounding violates."""
        plan = self._solve(problem, 0.0)
        return plan if plan is not None else self._solve(problem, GIVE)

    def _solve(self, problem: Problem, give: float) -> Plan | None:
        settings, tree, horizon = self.settings, self._tree, self.settings.horizon
        instance, base, due = self._instance(problem, give)
        chosen: list[int] = []
        for step, cuboid in problem.hint:
            same = np.flatnonzero((instance.visit_step == step) & (instance.visit_cuboid == cuboid))
            chosen += same[:1].tolist()
        bb.begin(instance, tree, np.array(chosen, dtype=np.int64))
        begun = time.perf_counter()
        how: How = 'optimal'
        while True:
            left = settings.node_limit - int(tree.counts[2])
            outcome = bb.search(instance, tree, min(_SLICE, left))
            if outcome in (bb.FOUND, bb.EXHAUSTED):
                break
            if (
                outcome == bb.FULL
                or int(tree.counts[2]) >= settings.node_limit
                or time.perf_counter() - begun > settings.time_limit
            ):
                how = 'best_so_far'
                break
        node = int(tree.counts[3])
        if node < 0:
            return None
        forces = tree.values[node, :, 2 * horizon - 1 : 3 * horizon - 1].T
        controls = np.clip(forces, -self.dynamics.force, self.dynamics.force)
        visits = [(1, cuboid) for cuboid in due]
        for q in tree.visits[node, : tree.number[node]]:
            visits.append((int(instance.visit_step[q]), int(instance.visit_cuboid[q])))
        return Plan(
            *self.dynamics.fly(problem.position, problem.velocity, controls, horizon),
            visits,
            how,
            (float(tree.best[0]) + base) / SCALE,
            int(tree.counts[2]),
        )

    def _instance(self, problem: Problem, give: float) -> tuple[bb.Instance, float, list[int]]:
        """Return the compiled form, the unconstrained objective, and due visits."""
        horizon, dynamics = self.settings.horizon, self.dynamics
        rows = self._homing if problem.homing else self._search
        # Without forces.
        positions, velocities, _ = dynamics.fly(
            problem.position, problem.velocity, np.zeros((horizon, 3)), horizon
        )
        braking = positions[horizon] + self._rolling[:, None] * velocities[horizon]
        still = np.zeros((horizon, 3))
        offset = np.vstack([positions[2:], velocities[1:], still, braking]).T
        # Unconstrained minimum: forces -H^-1 f.
        pulled = rows.matrix[: horizon - 1]
        weight = rows.pull[2:]
        away = offset[:, : horizon - 1] - np.asarray(problem.target, dtype=float)[:, None]
        slope = 2.0 * (away * weight) @ pulled
        forces = -slope @ rows.inverse
        base = float((weight * away * away).sum() + 0.5 * (slope * forces).sum())
        given = rows.pull[1] * (positions[1] - problem.target)
        base += float((given * (positions[1] - problem.target)).sum())
        lower, upper = self._bounds(problem, give)
        rewards = SCALE * self.settings.rewards(problem.put_off)
        due, wanted = _due(problem, positions[1])
        steps, cuboids, low, high, fall, climb = self._visits(problem, positions[1], wanted)
        reward = rewards[steps]
        follows, ahead = bb.longest_chains(steps, cuboids, reward, low, high, fall, climb)
        instance = bb.Instance(
            gram=rows.gram,
            free=np.ascontiguousarray(offset + forces @ rows.matrix.T),
            lower=lower,
            upper=upper,
            rise=self._rise,
            sink=self._sink,
            given=positions[:2].copy(),
            area=np.ascontiguousarray(problem.area, dtype=float),
            horizon=horizon,
            visit_step=steps,
            visit_cuboid=cuboids,
            visit_reward=reward,
            visit_lower=problem.cuboids[cuboids][:, :, 0].copy(),
            visit_upper=problem.cuboids[cuboids][:, :, 1].copy(),
            most=float((reward + ahead).max()) if len(steps) else 0.0,
            ahead=ahead,
            follows=follows,
            obstacles=np.ascontiguousarray(problem.obstacles, dtype=float).reshape(-1, 3, 2),
            between=self.settings.between_samples,
        )
        return instance, base - float(rewards[1]) * len(due), due

    def _bounds(self, problem: Problem, give: float) -> tuple[FloatArray, FloatArray]:
        horizon, dynamics = self.settings.horizon, self.dynamics
        area = np.asarray(problem.area, dtype=float)
        parts = horizon - 1, horizon, horizon
        others = np.repeat([np.nan, dynamics.speed + give, dynamics.force], parts)
        lower, upper = np.tile(-others, (3, 1)), np.tile(others, (3, 1))
        lower[:, : horizon - 1] = area[:, :1] - give
        upper[:, : horizon - 1] = area[:, 1:] + give
        return (
            np.hstack([lower, area[:, :1] - self._sink - give]),
            np.hstack([upper, area[:, 1:] + self._rise + give]),
        )

    def _visits(
        self, problem: Problem, first: FloatArray, wanted: BoolArray
    ) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return possible visits from P_1, and lowest and highest paths to each (3, T + 1)."""
        dynamics, sums = self.dynamics, np.zeros((2, 3, self.settings.horizon + 1))
        for side, sign in enumerate((-1.0, 1.0)):
            speed = np.array(problem.velocity, dtype=float)
            push = dynamics.step / dynamics.mass * (sign * dynamics.force - dynamics.weight)
            for k in range(self.settings.horizon):
                sums[side, :, k + 1] = sums[side, :, k] + dynamics.step * speed
                speed = np.clip(dynamics.retained * speed + push, -dynamics.speed, dynamics.speed)
        fall, climb = sums
        number = np.flatnonzero(wanted)
        area = np.asarray(problem.area, dtype=float)
        reach_low = np.maximum(first[:, None] + fall - fall[:, 1:2], area[:, :1])
        reach_high = np.minimum(first[:, None] + climb - climb[:, 1:2], area[:, 1:])
        boxes = problem.cuboids[number]
        low = np.maximum(boxes[None, :, :, 0], reach_low.T[:, None, :])
        high = np.minimum(boxes[None, :, :, 1], reach_high.T[:, None, :])
        meets = (low <= high + 1e-9).all(axis=2)
        meets[:2] = False
        steps, which = np.nonzero(meets)
        return steps.copy(), number[which], low[steps, which], high[steps, which], fall, climb


def _due(problem: Problem, point: FloatArray) -> tuple[list[int], BoolArray]:
    wanted = np.asarray(problem.wanted, dtype=bool).copy()
    if problem.homing:
        return [], np.zeros_like(wanted)
    low, high = problem.cuboids[:, :, 0] - TOUCH, problem.cuboids[:, :, 1] + TOUCH
    due = np.flatnonzero(((low <= point) & (point <= high)).all(axis=1) & wanted)
    wanted[due] = False
    return due.tolist(), wanted


_GAP = 1e-7  # tolerance of equal objectives [1]


def solve_jointly(solver: PlanSolver, problems: Sequence[Problem]) -> list[Plan] | None:
    """Return the optimal plans of all robots, in the order of the problems, or None."""
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
