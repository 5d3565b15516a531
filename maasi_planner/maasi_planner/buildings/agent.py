"""One robot of the distributed search of 004: knowledge, messages, decisions and snapshots.

Robots share messages and cuboids by (10) to (14).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import BoolArray, FloatArray, IntArray
from maasi_planner.buildings.dynamics import Dynamics
from maasi_planner.buildings.preplanning import CoveragePlan, PathFinder, detection_probability
from maasi_planner.buildings.problem import Plan, PlanSolver, Problem
from maasi_planner.buildings.settings import (
    CuboidMethodSettings,
    CuboidSettings,
    HazardSettings,
    SearcherSettings,
)


@dataclass(frozen=True)
class Broadcast:
    """Message of a robot to others in range at a step (V-B)."""

    robot: str
    step: int  # t
    position: FloatArray  # (3,) [m]
    velocity: FloatArray  # (3,) [m/s]
    searching: bool  # whether it searches; on its path home it still shares its search map
    visited: BoolArray  # (N,): V, its search map
    flight_steps: int  # t_Fl, since its last recharge
    plan: Mapping[int, int]  # steps to the visit by cuboid, of the previous plan
    hazard: HazardSettings  # of its battery
    predicted: FloatArray  # (3,): position at t + tau* + 1 in the previous plan [m]


def assigned(points: FloatArray, row: int, centres: FloatArray, unvisited: IntArray) -> int | None:
    """Return the cuboid assigned to robot `row` of robots at positions (m, 3): (10), or None."""
    if not len(unvisited):
        return None
    from scipy.optimize import linear_sum_assignment

    cost = np.sqrt(((points[:, None, :] - centres[unvisited][None, :, :]) ** 2).sum(axis=2))
    rows, columns = linear_sum_assignment(cost)
    chosen = np.flatnonzero(rows == row)
    return int(unvisited[columns[chosen[0]]]) if len(chosen) else None


def rewards(
    settings: CuboidMethodSettings,
    hazard: HazardSettings,
    flight_steps: int,
    received: Sequence[Broadcast],
    draws: FloatArray,
) -> BoolArray:
    """Return r(n) for all cuboids, (N,): (11) to (14), for random numbers `draws` in [0, 1]."""
    result = np.ones(len(draws), dtype=bool)
    failing = hazard.failure(flight_steps + settings.horizon)
    low = failing <= 0.5
    holds = low if settings.condition == 'low_hazard' else not low
    for n in {n for message in received for n in message.plan}:
        product, expected = 1.0, 0.0
        for message in received:
            if n in message.plan:
                fails = message.hazard.failure(message.flight_steps + message.plan[n] - 1)  # (11)
                product *= fails
                expected += 1.0 - fails
        missed = (1.0 - failing) * product  # (12)
        grown = settings.alpha * math.exp(-settings.beta * (expected - settings.alpha))
        joins = 1.0 - 1.0 / (1.0 + grown) if holds else 0.0
        result[n] = draws[n] < max(missed, joins)  # (13), (14)
    return result


_ARRIVED, _ARRIVED_SPEED = 2.0, 2.0  # tolerances of arrival at the station [m, m/s]
# Largest deviation from the last plan for which that plan may be continued [m, m/s].
_SAME_STATE = 0.5


class Activity(Enum):
    """Activity of a robot."""

    SEARCHING = 0
    RETURNING = 1
    RECHARGING = 2


@dataclass(frozen=True)
class Snapshot:
    """Snapshot of a cell."""

    robot: str
    step: int
    cuboid: int  # index of that of the cell
    position: FloatArray  # (3,) of the robot [m]
    direction: FloatArray  # (3,) optical axis, opposite to the normal of the face
    distance: float  # from the face [m]
    detection_probability: float  # p_d at that distance


def decision_stream(seed: int, robot: str, step: int) -> np.random.Generator:
    """Return the random generator of a robot's decision at a step, the same in every process."""
    key = (seed, crc32(robot.encode()), step, crc32(b'cuboid'))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))


def inflated(boxes: FloatArray, clearance: float) -> FloatArray:
    """Return boxes (n, 3, 2) extended by a clearance [m] on all sides."""
    return boxes + np.array([-clearance, clearance])


class SearchAgent:
    """A robot with its own planner: at each step it observes, sends and decides."""

    def __init__(
        self,
        name: str,
        settings: CuboidSettings,
        mission: CoveragePlan,
        robot: SearcherSettings,
        step: float = 1.0,
    ) -> None:
        self.name, self.settings, self.mission = name, settings, mission
        self.dynamics = Dynamics(robot.dynamics, step)
        self.hazard = robot.hazard
        self.home = np.array(robot.start, dtype=float)
        self.solver = PlanSolver(self.dynamics, settings)
        self._solids = inflated(mission.solids, settings.clearance)
        self._cuboids = inflated(mission.boxes, -settings.visit_depth)
        speed = self.dynamics.speed
        climb = float(self.dynamics.deceleration[1, 2]) / max(1.0 - self.dynamics.retained, 1e-9)
        self._paths = PathFinder(self._solids, mission.area, speed, min(climb, speed))
        self._check_home()
        self.visited = np.zeros(len(mission.cells), dtype=bool)
        self.snapshots: list[Snapshot] = []
        self.activity = Activity.SEARCHING
        self.flight_steps = 0
        self.plan: Plan | None = None
        self.target = self.home
        self.failed = 0
        self.put_off = 0
        self._recharge_left = 0
        self.step = -1
        self.position = self.home
        self.velocity = np.zeros(3)

    def _check_home(self) -> None:
        area, problem = self.mission.area, ''
        if not ((self.home >= area[:, 0]) & (self.home <= area[:, 1])).all():
            problem = f', allowed is what lies inside the area, {area.tolist()} [m]'
        elif self.mission.hits(self.home):
            problem = ', which is inside an object or obstacle, allowed is a position outside'
        elif not any(self._paths.reaches(self.home, centre) for centre in self.mission.centres):
            problem = ', from which no cuboid can be reached: obstacles enclose it'
        if problem:
            raise ValueError(f'{self.name}: start: read {self.home.tolist()}{problem}')

    @property
    def done(self) -> bool:
        """Whether all cuboids are visited as far as the robot knows."""
        return bool(self.visited.all())

    def observe(self, step: int, position: ArrayLike, velocity: ArrayLike) -> Broadcast | None:
        """Update the robot's state; return its message to the others, None while it recharges."""
        point = np.array(position, dtype=float)
        speed = np.array(velocity, dtype=float)
        if not (np.isfinite(point).all() and np.isfinite(speed).all()):
            raise ValueError(
                f'{self.name}: state: got {point}, {speed}, allowed are finite numbers'
            )
        if self.plan is not None and step != self.step + 1:
            # After a recharge or a missed step there is no previous plan.
            self.plan = None
        self.step = step
        self.position, self.velocity = point, speed
        plan = {}
        if self.activity is Activity.SEARCHING:
            self._photograph()
            if self.plan is not None:
                plan = {n: k - 1 for k, n in self.plan.visits}
        elif self.activity is Activity.RETURNING:
            slow = float(np.abs(speed).max()) <= _ARRIVED_SPEED
            if slow and float(np.linalg.norm(point - self.home)) <= _ARRIVED:
                self.activity = Activity.RECHARGING
                self._recharge_left = -1
        if self.activity is Activity.RECHARGING:
            return None
        return Broadcast(
            robot=self.name,
            step=step,
            position=point,
            velocity=speed,
            searching=self.activity is Activity.SEARCHING,
            visited=self.visited.copy(),
            flight_steps=self.flight_steps,
            plan=plan,
            hazard=self.hazard,
            predicted=self._predicted(),
        )

    def _photograph(self) -> None:
        for n in np.flatnonzero(self.mission.inside(self.position) & ~self.visited):
            self.visited[n] = True
            cell = self.mission.cells[n]
            distance = cell.distance(self.position)
            chance = detection_probability(distance, self.settings.camera)
            self.snapshots.append(
                Snapshot(
                    self.name, self.step, int(n), self.position, -cell.normal, distance, chance
                )
            )

    def decide(
        self,
        received: Sequence[Broadcast],
        rng: np.random.Generator,
        wanted: BoolArray | None = None,
    ) -> Plan:
        """Decide for the last observed step; `wanted` (N,) replaces the drawn rewards."""
        fails, minutes = rng.random(2)
        if self.activity is not Activity.RECHARGING:
            for message in received:
                self.visited |= message.visited  # (15i)
        self._battery(float(fails), float(minutes))
        received = [message for message in received if message.searching]
        if wanted is None:
            draws = rng.random(len(self.visited))
            wanted = rewards(self.settings, self.hazard, self.flight_steps, received, draws)
        return self.follow(self.solver.solve(self.problem(received, wanted)))

    def problem(self, received: Sequence[Broadcast], wanted: BoolArray) -> Problem:
        """Return the problem of the step, with rewards (N,) of 1 for `wanted` cuboids."""
        homing = self.activity is not Activity.SEARCHING
        self.target = self.home if homing else self._aim(received)
        if self.settings.around_corners and (self.target != self.position).any():
            self.target = self._paths.first_corner(self.position, self.target)
        return Problem(
            position=self.position,
            velocity=self.velocity,
            target=self.target,
            cuboids=self._cuboids,
            wanted=wanted & ~self.visited,
            obstacles=self._solids,
            area=self.mission.area,
            homing=homing,
            hint=[(k - 1, n) for k, n in self.plan.visits if k > 2] if self.plan else [],
            put_off=self.put_off,
        )

    def _aim(self, received: Sequence[Broadcast]) -> FloatArray:
        centres, unvisited = self.mission.centres, np.flatnonzero(~self.visited)
        if not received and len(unvisited):
            offset = centres[unvisited] - self._predicted()
            return centres[unvisited[np.argmin((offset * offset).sum(axis=1))]]
        predicted = self.settings.assignment == 'predicted'
        points = {m.robot: m.predicted if predicted else m.position for m in received}
        points[self.name] = self._predicted() if predicted else self.position
        order = sorted(points)
        stacked = np.stack([points[name] for name in order])
        chosen = assigned(stacked, order.index(self.name), centres, unvisited)
        return self.position if chosen is None else centres[chosen]

    def _predicted(self) -> FloatArray:
        """Return x at t + tau* + 1 of the previous plan, or the present position."""
        if self.plan is None:
            return self.position
        last = len(self.plan.positions) - 1
        return np.asarray(self.plan.positions[min(self.settings.guided + 1, last)])

    def follow(self, plan: Plan | None) -> Plan:
        """Adopt a plan or, without one, the rest of the previous plan, or brake."""
        if plan is None:
            self.failed += 1
            # The rest of the previous plan, with braking at its end, or braking.
            last, controls, visits = self.plan, [], []
            if last is not None and (
                np.abs(last.positions[1] - self.position).max() <= _SAME_STATE
                and np.abs(last.velocities[1] - self.velocity).max() <= _SAME_STATE
            ):
                controls = list(last.controls[1:])
                visits = [(k - 1, n) for k, n in last.visits if k > 1 and not self.visited[n]]
            flown = self.dynamics.fly(self.position, self.velocity, controls, self.settings.horizon)
            plan = Plan(*flown, visits, 'shifted' if controls else 'brake')
        before = [k - 1 for k, _ in self.plan.visits if k > 1] if self.plan else []
        now = [k for k, _ in plan.visits]
        # Without this count a robot can postpone its visit forever.
        self.put_off = self.put_off + 1 if before and now and min(now) > min(before) else 0
        self.plan = plan
        if self.activity is not Activity.RECHARGING:
            self.flight_steps += 1
        return plan

    def _battery(self, fails: float, minutes: float) -> None:
        if self.activity is Activity.SEARCHING:
            if fails < self.hazard.failure(self.flight_steps):
                self.activity = Activity.RETURNING
                self.plan = None
        elif self.activity is Activity.RECHARGING:
            if self._recharge_left < 0:
                low, high = self.hazard.recharge_steps
                self._recharge_left = low + int(minutes * (high - low + 1))
            self._recharge_left -= 1
            if self._recharge_left <= 0:
                self.activity = Activity.SEARCHING
                self.flight_steps = 0
                self.plan = None
