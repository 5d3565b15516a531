"""The problem of one robot at one step, 004, P2, and its exact solution."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.buildings import branch_and_bound as bb
from maasi_planner.buildings.axis_problem import SCALE, AxisRows, axis_rows
from maasi_planner.buildings.robot_model import Dynamics
from maasi_planner.buildings.search_tree import make_tree

# Relaxation of bounds if rounding leaves the state outside of them [m, m/s].
GIVE = 1e-4
# Tolerance of the present position in a cuboid: plans touch faces, up to rounding [m].
TOUCH = 1e-6
# Nodes between two checks of the time limit, and capacity of open nodes.
_SLICE, _ROOM = 500, 16384
# Share of the smoothness weight of a robot that flies home, so that its forces are unique.
_HOMING_SMOOTHNESS = 1e-2


@dataclass(frozen=True)
class Objective:
    """Weights and horizon of (9).

    horizon: T, at least 2; guidance_step: tau*, limited to T - 1; guidance: w1 [1/m^2]; smoothness:
    w2 [1/N^2]; visit: w3 [1]; discount: factor of w3 per step of delay of a visit; 1 in the paper.
    """

    horizon: int = 10
    guidance_step: int = 3
    guidance: float = 1e-4
    smoothness: float = 1e-4
    visit: float = 0.3
    discount: float = 1.0

    def __post_init__(self) -> None:
        if self.horizon < 2:
            raise ValueError(f'horizon: got {self.horizon}, allowed are whole numbers from 2')
        if self.guidance_step < 1:
            raise ValueError(
                f'guidance_step: got {self.guidance_step}, allowed are whole numbers from 1'
            )
        for name in ('guidance', 'smoothness', 'visit', 'discount'):
            value = getattr(self, name)
            least = 0.0 if name == 'visit' else 1e-300
            if not (math.isfinite(value) and value >= least):
                raise ValueError(f'{name}: got {value}, allowed are numbers above 0')

    @property
    def guided(self) -> int:
        """Index of the guided position, tau* + 1."""
        return min(self.guidance_step, self.horizon - 1) + 1

    def rewards(self, put_off: int = 0) -> FloatArray:
        """Return the reward of a visit at P_0 to P_T, (T + 1,) [1]."""
        steps = np.maximum(np.arange(self.horizon + 1) - 1, 0)
        return np.asarray(self.visit * self.discount ** ((1 + put_off) * steps))


@dataclass
class Problem:
    """State and knowledge of a robot when it plans.

    position, velocity (3,): its state [m, m/s]; target (3,): x*, guidance target [m]; cuboids (N,
    3, 2): lower and upper corners [m]; wanted (N,): which are unvisited and have a reward of 1;
    obstacles (O, 3, 2): objects and obstacles, clearance included [m]; area (3, 2): admissible
    positions [m]; homing: whether it only flies to its target, without search (8); between, brakes:
    whether segments between positions avoid obstacles too, and whether the terminal state allows
    braking in time; hint: visits (step, cuboid) of the previous plan, shifted to now; put_off:
    consecutive postponements of the first visit; without effect if rewards are not discounted.
    """

    position: FloatArray
    velocity: FloatArray
    target: FloatArray
    cuboids: FloatArray
    wanted: BoolArray
    obstacles: FloatArray
    area: FloatArray
    homing: bool = False
    between: bool = True
    brakes: bool = True
    hint: list[tuple[int, int]] = field(default_factory=list)
    put_off: int = 0


@dataclass
class Plan:
    """A plan, starting at P_0.

    positions, velocities (T + 1, 3): from now on [m, m/s]; controls (T, 3): forces [N]; visits:
    step, from 1, and cuboid; each cuboid once, in order of the steps; objective: value of (9),
    without cuboids visited earlier; status: optimal, or the limit that ended the solve; nodes:
    number of solved relaxations.
    """

    positions: FloatArray
    velocities: FloatArray
    controls: FloatArray
    visits: list[tuple[int, int]]
    objective: float
    status: Literal['optimal', 'time_limit', 'node_limit']
    nodes: int


class PlanSolver:
    """Solves the problems of one kind of robot; reuses its matrices and workspace.

    After `node_limit` relaxations or `time_limit` [s of wall time] it returns the best plan so far.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        objective: Objective,
        node_limit: int = 20000,
        time_limit: float = math.inf,
    ) -> None:
        self.dynamics = dynamics
        self.objective = objective
        self.node_limit = node_limit
        self.time_limit = time_limit
        horizon = objective.horizon
        self._braking_steps = dynamics.braking_steps()
        pull = np.zeros(horizon + 1)
        pull[objective.guided] = objective.guidance
        self._search = axis_rows(dynamics, horizon, pull, objective.smoothness, self._braking_steps)
        pull = np.full(horizon + 1, objective.guidance)
        pull[0] = 0.0
        smoothness = _HOMING_SMOOTHNESS * objective.smoothness
        self._homing = axis_rows(dynamics, horizon, pull, smoothness, self._braking_steps)
        self._gram = {
            rows is self._homing: np.ascontiguousarray(np.stack([rows.gram] * 3))
            for rows in (self._search, self._homing)
        }
        self._tree = make_tree(_ROOM, horizon, len(self._search.matrix))
        # Distances of braking relative to those of air resistance alone.
        ways = np.zeros((2, 3, self._braking_steps))
        for axis in range(3):
            for side, loss in enumerate(dynamics.deceleration(axis)):
                lost, way = 0.0, 0.0
                for j in range(1, self._braking_steps):
                    lost = dynamics.retained * lost + loss
                    way += dynamics.step * lost
                    ways[side, axis, j] = way
        self._rise, self._sink = ways

    def solve(self, problem: Problem) -> Plan | None:
        """Return the best plan; None if there is none.

        Bounds are relaxed by `GIVE` if rounding has left the state outside.
        """
        plan = self._solve(problem, 0.0)
        return plan if plan is not None else self._solve(problem, GIVE)

    def _free_motion(self, problem: Problem) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return force-free positions and velocities (T + 1, 3), and the offset of the rows."""
        dynamics, horizon = self.dynamics, self.objective.horizon
        positions = np.empty((horizon + 1, 3))
        velocities = np.empty((horizon + 1, 3))
        positions[0], velocities[0] = problem.position, problem.velocity
        for k in range(horizon):
            positions[k + 1], velocities[k + 1] = dynamics.next(
                positions[k], velocities[k], np.zeros(3)
            )
        ways = dynamics.step * np.cumsum(dynamics.retained ** np.arange(self._braking_steps))
        offset = np.vstack(
            [
                positions[2:],
                velocities[1:],
                np.zeros((horizon, 3)),
                positions[horizon] + ways[:, None] * velocities[horizon],
            ]
        ).T
        return positions, velocities, offset

    def _solve(self, problem: Problem, give: float) -> Plan | None:
        instance, first, base, fixed = self._instance(problem, give)
        tree = self._tree
        chosen: list[int] = []
        for step, cuboid in problem.hint:
            same = np.flatnonzero((instance.visit_step == step) & (instance.visit_cuboid == cuboid))
            chosen += same[:1].tolist()
        bb.begin(instance, tree, first, np.array(chosen, dtype=np.int64))
        begun = time.perf_counter()
        status: Literal['optimal', 'time_limit', 'node_limit'] = 'optimal'
        while True:
            left = self.node_limit - int(tree.counts[2])
            outcome = bb.search(instance, tree, first, min(_SLICE, left))
            if outcome in (bb.FOUND, bb.EXHAUSTED):
                break
            if outcome == bb.FULL or int(tree.counts[2]) >= self.node_limit:
                status = 'node_limit'
                break
            if time.perf_counter() - begun > self.time_limit:
                status = 'time_limit'
                break
        node = int(tree.counts[3])
        if node < 0:
            return None
        return self._plan(problem, instance, node, base, fixed, status)

    def _instance(
        self, problem: Problem, give: float
    ) -> tuple[bb.Instance, float, float, list[int]]:
        """Return the compiled form, largest reward, unconstrained objective, and due visits."""
        objective, horizon = self.objective, self.objective.horizon
        rows: AxisRows = self._homing if problem.homing else self._search
        positions, _, offset = self._free_motion(problem)
        # Unconstrained minimum: forces -H^-1 f.
        pulled = rows.matrix[: horizon - 1]
        weight = rows.pull[2:]
        away = offset[:, : horizon - 1] - np.asarray(problem.target, dtype=float)[:, None]
        slope = 2.0 * (away * weight) @ pulled
        forces = -slope @ rows.inverse
        free = offset + forces @ rows.matrix.T
        base = float((weight * away * away).sum() + 0.5 * (slope * forces).sum())
        given = rows.pull[1] * (positions[1] - problem.target)
        base += float((given * (positions[1] - problem.target)).sum())
        lower, upper = self._bounds(problem, give)
        chosen, wanted = self._due(problem, positions[1])
        visits = self._visits(problem, positions, wanted)
        steps, cuboids, boxes, clipped, fall, climb = visits
        rewards = SCALE * objective.rewards(problem.put_off)
        reward = rewards[steps] if len(steps) else np.zeros(0)
        follows, ahead = bb.longest_chains(
            steps, cuboids, reward, clipped[:, :, 0].copy(), clipped[:, :, 1].copy(), fall, climb
        )
        first = float((reward + ahead).max()) if len(steps) else 0.0
        instance = bb.Instance(
            gram=self._gram[problem.homing],
            free=np.ascontiguousarray(free),
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
            visit_lower=boxes[:, :, 0].copy(),
            visit_upper=boxes[:, :, 1].copy(),
            ahead=ahead,
            follows=follows,
            obstacles=np.ascontiguousarray(problem.obstacles, dtype=float).reshape(-1, 3, 2),
            between=problem.between,
            brakes=problem.brakes,
        )
        return instance, first, base - float(rewards[1]) * len(chosen), chosen

    def _bounds(self, problem: Problem, give: float) -> tuple[FloatArray, FloatArray]:
        dynamics, horizon = self.dynamics, self.objective.horizon
        area = np.asarray(problem.area, dtype=float)
        terminal = self._braking_steps
        lower = np.empty((3, 3 * horizon - 1 + terminal))
        upper = np.empty_like(lower)
        first, second = horizon - 1, 2 * horizon - 1
        last = 3 * horizon - 1
        lower[:, :first] = area[:, :1] - give
        upper[:, :first] = area[:, 1:] + give
        lower[:, first:second] = -dynamics.speed - give
        upper[:, first:second] = dynamics.speed + give
        lower[:, second:last] = -dynamics.force
        upper[:, second:last] = dynamics.force
        if problem.brakes:
            lower[:, last:] = area[:, :1] - self._sink - give
            upper[:, last:] = area[:, 1:] + self._rise + give
        else:
            lower[:, last:] = -np.inf
            upper[:, last:] = np.inf
        return lower, upper

    def _due(self, problem: Problem, place: FloatArray) -> tuple[list[int], BoolArray]:
        """Return the cuboids that the next step visits under any force, and the others."""
        wanted = np.asarray(problem.wanted, dtype=bool).copy()
        if problem.homing or not len(wanted):
            return [], np.zeros_like(wanted)
        low, high = problem.cuboids[:, :, 0] - TOUCH, problem.cuboids[:, :, 1] + TOUCH
        inside = ((low <= place) & (place <= high)).all(axis=1)
        due = np.flatnonzero(inside & wanted)
        wanted[due] = False
        return due.tolist(), wanted

    def _visits(
        self, problem: Problem, positions: FloatArray, wanted: BoolArray
    ) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return possible visits: steps, cuboids, boxes, and extreme motion.

        A visit is possible only if its cuboid intersects the set reachable by extreme forces.
        """
        horizon = self.objective.horizon
        fall, climb = self._extremes(problem)
        number = np.flatnonzero(wanted)
        reach_low = positions[1][:, None] + fall - fall[:, 1:2]
        reach_high = positions[1][:, None] + climb - climb[:, 1:2]
        area = np.asarray(problem.area, dtype=float)
        reach_low = np.maximum(reach_low, area[:, :1])
        reach_high = np.minimum(reach_high, area[:, 1:])
        boxes = problem.cuboids[number]
        low = np.maximum(boxes[None, :, :, 0], reach_low.T[:, None, :])
        high = np.minimum(boxes[None, :, :, 1], reach_high.T[:, None, :])
        meets = (low <= high + 1e-9).all(axis=2)
        meets[:2] = False
        steps, which = np.nonzero(meets[: horizon + 1])
        clipped = np.stack([low[steps, which], high[steps, which]], axis=2)
        return (
            steps.astype(np.int64),
            number[which].astype(np.int64),
            np.ascontiguousarray(boxes[which]),
            clipped,
            fall,
            climb,
        )

    def _extremes(self, problem: Problem) -> tuple[FloatArray, FloatArray]:
        """Return sums of the lowest and highest velocities before each step, (3, T + 1) [m]."""
        dynamics, horizon = self.dynamics, self.objective.horizon
        sums = np.zeros((2, 3, horizon + 1))
        for side, sign in enumerate((-1.0, 1.0)):
            speed = np.array(problem.velocity, dtype=float)
            push = dynamics.step / dynamics.mass * (sign * dynamics.force - dynamics.weight)
            for k in range(horizon):
                sums[side, :, k + 1] = sums[side, :, k] + dynamics.step * speed
                speed = np.clip(dynamics.retained * speed + push, -dynamics.speed, dynamics.speed)
        return sums[0], sums[1]

    def _plan(
        self,
        problem: Problem,
        instance: bb.Instance,
        node: int,
        base: float,
        due: list[int],
        status: Literal['optimal', 'time_limit', 'node_limit'],
    ) -> Plan:
        horizon, dynamics, tree = self.objective.horizon, self.dynamics, self._tree
        controls = np.clip(
            tree.values[node, :, 2 * horizon - 1 : 3 * horizon - 1].T,
            -dynamics.force,
            dynamics.force,
        )
        positions = np.empty((horizon + 1, 3))
        velocities = np.empty((horizon + 1, 3))
        positions[0], velocities[0] = problem.position, problem.velocity
        for k in range(horizon):
            positions[k + 1], velocities[k + 1] = dynamics.next(
                positions[k], velocities[k], controls[k]
            )
        chosen = tree.visits[node, : tree.number[node]]
        visits = [(1, cuboid) for cuboid in due]
        visits += [(int(instance.visit_step[q]), int(instance.visit_cuboid[q])) for q in chosen]
        return Plan(
            positions,
            velocities,
            controls,
            visits,
            (float(tree.best[0]) + base) / SCALE,
            status,
            int(tree.counts[2]),
        )
