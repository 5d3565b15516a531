"""One robot of the distributed search of 004: knowledge, messages, decisions and snapshots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Literal
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_planner.buildings.guidance import WayFinder, assigned, nearest
from maasi_planner.buildings.preplanning import CoveragePlan, detection_probability
from maasi_planner.buildings.problem import Objective, Plan, PlanSolver, Problem
from maasi_planner.buildings.robot_model import Dynamics, Hazard, HeardPlan, rewards
from maasi_planner.buildings.settings import CuboidSettings, HazardSettings

How = Literal['optimal', 'best_so_far', 'shifted', 'brake']

# Tolerances of arrival at the station [m, m/s].
_ARRIVED, _ARRIVED_SPEED = 2.0, 2.0
# Largest deviation from the last plan for which that plan may be continued [m, m/s].
_SAME_STATE = 0.5
# Depth of planned visits: on a face, rounding would decide whether a cuboid is visited [m].
_INTO = 1e-3


class Activity(Enum):
    """Activity of a robot."""

    SEARCHING = 0
    RETURNING = 1
    RECHARGING = 2


@dataclass(frozen=True)
class Broadcast:
    """Message of a robot to those in range at a step (V-B).

    robot: its name; step: t; position, velocity (3,): [m, m/s]; searching: whether it takes part; a
    robot on its way home still shares its search map; visited (N,): V, its search map;
    flight_steps: t_Fl, since its last recharge; plan: steps from now until the visit, by cuboid, of
    its previous plan; hazard: of its battery; predicted (3,): position at t + tau* + 1 in its
    previous plan [m].
    """

    robot: str
    step: int
    position: FloatArray
    velocity: FloatArray
    searching: bool
    visited: BoolArray
    flight_steps: int
    plan: Mapping[int, int]
    hazard: Hazard
    predicted: FloatArray


@dataclass(frozen=True)
class Snapshot:
    """Snapshot of a cell.

    robot: name of the robot; step: time step; cuboid: index of the cuboid of the cell; position
    (3,): of the robot [m]; direction (3,): optical axis, opposite to the normal of the face;
    distance: from the face [m]; detection_probability: p_d at that distance.
    """

    robot: str
    step: int
    cuboid: int
    position: FloatArray
    direction: FloatArray
    distance: float
    detection_probability: float


@dataclass(frozen=True)
class Choice:
    """Decision of a robot at a step.

    control (3,): force until the next step [N]; velocity (3,): resulting velocity at the next step
    [m/s]; plan: plan of the decision; how: optimal; best_so_far: a limit ended the solve; shifted:
    no solution, it continues the previous plan; brake: no valid previous plan either; target (3,):
    x* [m]; activity: present activity.
    """

    control: FloatArray
    velocity: FloatArray
    plan: Plan
    how: How
    target: FloatArray
    activity: Activity


def make_objective(settings: CuboidSettings) -> Objective:
    """Return the objective of settings."""
    return Objective(
        settings.horizon,
        settings.guidance_step,
        settings.guidance_weight,
        settings.smoothness_weight,
        settings.visit_weight,
        settings.discount,
    )


def decision_stream(seed: int, robot: str, step: int) -> np.random.Generator:
    """Return the generator of a robot's decision at a step: the same in every process."""
    key = (seed, crc32(robot.encode()), step, crc32(b'cuboid'))
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))


def inflated(boxes: FloatArray, clearance: float) -> FloatArray:
    """Return boxes (n, 3, 2) with a clearance [m] on all sides."""
    return boxes + np.array([-clearance, clearance])


class SearchAgent:
    """A robot with its own planner.

    At each step: `observe` its state, send the returned message, and `decide` with the messages
    received.
    `mission` is the same for all robots; `home` is G, where it recharges (3,) [m].
    """

    def __init__(
        self,
        name: str,
        settings: CuboidSettings,
        mission: CoveragePlan,
        dynamics: Dynamics,
        hazard: HazardSettings,
        home: ArrayLike,
    ) -> None:
        self.name = name
        self.settings = settings
        self.mission = mission
        self.dynamics = dynamics
        self.hazard = Hazard(hazard.alpha, hazard.beta, hazard.failures)
        self._recharge_steps = hazard.recharge_steps
        self.home = np.asarray(home, dtype=float)
        self.solver = PlanSolver(
            dynamics, make_objective(settings), settings.node_limit, settings.time_limit
        )
        self.solids = inflated(mission.solids, settings.clearance)
        self._cuboids = inflated(mission.boxes, -_INTO)
        climb = dynamics.deceleration(2)[1] / max(1.0 - dynamics.retained, 1e-9)
        self._ways = WayFinder(
            self.solids, mission.area, dynamics.speed, min(climb, dynamics.speed)
        )
        self._check_home()
        self.visited = np.zeros(len(mission.cells), dtype=bool)
        self.snapshots: list[Snapshot] = []
        self.activity = Activity.SEARCHING
        self.flight_steps = 0
        self.plan: Plan | None = None
        self.failed = 0
        self.put_off = 0
        self._recharge_left = 0
        self.step = -1
        self.position = self.home
        self.velocity = np.zeros(3)

    def _check_home(self) -> None:
        area = self.mission.area
        if not (
            np.isfinite(self.home).all()
            and (self.home >= area[:, 0]).all()
            and (self.home <= area[:, 1]).all()
        ):
            raise ValueError(
                f'{self.name}: start: read {self.home.tolist()}, allowed is what lies inside the '
                f'area, {area.tolist()} [m]'
            )
        if self.mission.hits(self.home):
            raise ValueError(
                f'{self.name}: start: read {self.home.tolist()}, which is inside an object or '
                'obstacle, allowed is a place outside'
            )
        if not any(self._ways.reaches(self.home, centre) for centre in self.mission.centres):
            raise ValueError(
                f'{self.name}: start: read {self.home.tolist()}, from where no cuboid can be '
                'reached: obstacles close it in'
            )

    @property
    def done(self) -> bool:
        """Whether all cuboids are visited, as far as it knows."""
        return bool(self.visited.all())

    def observe(self, step: int, position: ArrayLike, velocity: ArrayLike) -> Broadcast | None:
        """Update its own state; return the message to the others, None while it recharges."""
        place = np.array(position, dtype=float)
        speed = np.array(velocity, dtype=float)
        if not (np.isfinite(place).all() and np.isfinite(speed).all()):
            raise ValueError(
                f'{self.name}: state: got {place}, {speed}, allowed are finite numbers'
            )
        if self.plan is not None and step != self.step + 1:
            # After a recharge or a missed step the plan is not that of the previous step.
            self.plan = None
        self.step = step
        self.position, self.velocity = place, speed
        if self.activity is Activity.SEARCHING:
            for n in np.flatnonzero(self.mission.inside(place)):
                if not self.visited[n]:
                    self.visited[n] = True
                    self.snapshots.append(self._snapshot(int(n)))
        elif self.activity is Activity.RETURNING:
            slow = float(np.abs(speed).max()) <= _ARRIVED_SPEED
            if slow and float(np.linalg.norm(place - self.home)) <= _ARRIVED:
                self.activity = Activity.RECHARGING
                self._recharge_left = -1
        if self.activity is Activity.RECHARGING:
            return None
        plan = {}
        if self.activity is Activity.SEARCHING and self.plan is not None:
            plan = {n: k - 1 for k, n in self.plan.visits}
        return Broadcast(
            self.name,
            step,
            place,
            speed,
            self.activity is Activity.SEARCHING,
            self.visited.copy(),
            self.flight_steps,
            plan,
            self.hazard,
            self.predicted(),
        )

    def _snapshot(self, n: int) -> Snapshot:
        cell = self.mission.cells[n]
        distance = cell.distance(self.position)
        return Snapshot(
            self.name,
            self.step,
            n,
            self.position.copy(),
            -cell.normal,
            distance,
            detection_probability(distance, self.settings.camera),
        )

    def decide(
        self, heard: Sequence[Broadcast], rng: np.random.Generator, wanted: BoolArray | None = None
    ) -> Choice:
        """Decide for the step that was observed last."""
        fails, minutes = rng.random(2)
        if self.activity is not Activity.RECHARGING:
            for message in heard:
                self.visited |= message.visited  # (15i)
        self._battery(float(fails), float(minutes))
        heard = [message for message in heard if message.searching]
        drawn = rewards(
            len(self.visited),
            self.flight_steps,
            self.settings.horizon,
            self.hazard,
            [HeardPlan(m.plan, m.flight_steps, m.hazard) for m in heard],
            self.settings.alpha,
            self.settings.beta,
            self.settings.condition,
            rng,
        )
        problem = self.problem(heard, drawn if wanted is None else wanted)
        plan = self.solver.solve(problem)
        return self.follow(plan, problem.target)

    def problem(self, heard: Sequence[Broadcast], wanted: BoolArray) -> Problem:
        """Return the problem of the step, with rewards (N,) of 1 for `wanted` cuboids."""
        homing = self.activity is not Activity.SEARCHING
        target = self.home if homing else self._target(heard)
        if self.settings.around_corners and (target != self.position).any():
            target = self._ways.first_corner(self.position, target)
        return Problem(
            self.position,
            self.velocity,
            target,
            self._cuboids,
            wanted & ~self.visited,
            self.solids,
            self.mission.area,
            homing,
            self.settings.between_samples,
            True,
            [(k - 1, n) for k, n in self.plan.visits if k > 2] if self.plan else [],
            self.put_off,
        )

    def _target(self, heard: Sequence[Broadcast]) -> FloatArray:
        """Return x*: the cuboid nearest to its predicted position, or the assigned one (10)."""
        unvisited = np.flatnonzero(~self.visited)
        if heard:
            if self.settings.assignment == 'predicted':
                places = np.stack([self.predicted(), *(message.predicted for message in heard)])
            else:
                places = np.stack([self.position, *(message.position for message in heard)])
            order = sorted(
                range(len(places)), key=lambda i: self.name if i == 0 else heard[i - 1].robot
            )
            chosen = assigned(places[order], order.index(0), self.mission.centres, unvisited)
        else:
            chosen = nearest(self.predicted(), self.mission.centres, unvisited)
        return self.position if chosen is None else self.mission.centres[chosen]

    def predicted(self) -> FloatArray:
        """Return x at t + tau* + 1 of the previous plan; the present position without a plan."""
        if self.plan is None:
            return self.position
        guided = self.solver.objective.guided
        return np.asarray(self.plan.positions[min(guided + 1, len(self.plan.positions) - 1)])

    def follow(self, plan: Plan | None, target: FloatArray) -> Choice:
        """Return the choice of a plan; without one, of the previous plan, or to brake."""
        how: How
        if plan is not None:
            how = 'optimal' if plan.status == 'optimal' else 'best_so_far'
        else:
            self.failed += 1
            plan = self._shifted()
            how = 'shifted'
            if plan is None:
                plan, how = self._stop(), 'brake'
        before = [k - 1 for k, _ in self.plan.visits if k > 1] if self.plan else []
        now = [k for k, _ in plan.visits]
        # Count postponements: otherwise a robot can postpone its visit for ever.
        self.put_off = self.put_off + 1 if before and now and min(now) > min(before) else 0
        self.plan = plan
        if self.activity is not Activity.RECHARGING:
            self.flight_steps += 1
        return Choice(plan.controls[0], plan.velocities[1], plan, how, target, self.activity)

    def _battery(self, fails: float, minutes: float) -> None:
        if self.activity is Activity.SEARCHING:
            if fails < self.hazard(self.flight_steps):
                self.activity = Activity.RETURNING
                self.plan = None
        elif self.activity is Activity.RECHARGING:
            if self._recharge_left < 0:
                low, high = self._recharge_steps
                self._recharge_left = low + int(minutes * (high - low + 1))
            self._recharge_left -= 1
            if self._recharge_left <= 0:
                self.activity = Activity.SEARCHING
                self.flight_steps = 0
                self.plan = None

    def _shifted(self) -> Plan | None:
        """Return the rest of the previous plan, with braking at its end."""
        if self.plan is None:
            return None
        off = max(
            float(np.abs(self.plan.positions[1] - self.position).max()),
            float(np.abs(self.plan.velocities[1] - self.velocity).max()),
        )
        if off > _SAME_STATE:
            return None
        return self._flown(list(self.plan.controls[1:]), [(k - 1, n) for k, n in self.plan.visits])

    def _stop(self) -> Plan:
        return self._flown([], [])

    def _flown(self, controls: list[FloatArray], visits: list[tuple[int, int]]) -> Plan:
        """Return the plan of given controls, followed by braking."""
        horizon = self.settings.horizon
        positions, velocities, used = [self.position], [self.velocity], []
        for k in range(horizon):
            control = controls[k] if k < len(controls) else self.dynamics.braking(velocities[-1])
            place, speed = self.dynamics.next(positions[-1], velocities[-1], control)
            positions.append(place)
            velocities.append(speed)
            used.append(control)
        return Plan(
            np.array(positions),
            np.array(velocities),
            np.array(used),
            [(k, n) for k, n in visits if k >= 1 and not self.visited[n]],
            float('nan'),
            'time_limit',
            0,
        )
