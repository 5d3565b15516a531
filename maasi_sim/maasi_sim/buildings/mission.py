"""A search of buildings (004) in one process: robots, batteries, and a link of limited range."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_planner.buildings import (
    Activity,
    Broadcast,
    Choice,
    CoveragePlan,
    CuboidSettings,
    Dynamics,
    DynamicsSettings,
    HazardSettings,
    SearchAgent,
    Snapshot,
    decision_stream,
    plan_mission,
    solve_jointly,
)

Scheme = Literal['distributed', 'sequential', 'centralized']


@dataclass
class SearchRobot:
    """A robot of a mission; it starts, and recharges, at `start`, (3,) [m]."""

    start: FloatArray
    dynamics: DynamicsSettings = field(default_factory=DynamicsSettings)
    hazard: HazardSettings = field(default_factory=HazardSettings)


@dataclass
class MissionRecord:
    """What became of a mission.

    Attributes
    ----------
    mission : CoveragePlan
        What was searched.
    steps, complete : int, bool
        Until all cuboids were visited, or it was given up; whether all were.
    paths : dict
        By robot: positions at all steps, (steps + 1, 3) [m].
    visited, active : (steps + 1,) array
        Cuboids visited by the team, and robots that search.
    snapshots : list of Snapshot
        In order of time.
    collisions, outside : int
        Steps on which a robot's way cut an object or obstacle, or it was outside the area.
    how : dict
        Number of choices by how they were made.
    solve_times : array
        Wall time of each decision [s]; of all robots together if centralized.
    recharges : int
        Batteries that failed.
    plans : dict
        Predicted positions of all robots at the steps that were asked for.
    """

    mission: CoveragePlan
    steps: int
    complete: bool
    paths: dict[str, FloatArray]
    visited: NDArray[np.int64]
    active: NDArray[np.int64]
    snapshots: list[Snapshot]
    collisions: int
    outside: int
    how: dict[str, int]
    solve_times: FloatArray
    recharges: int
    plans: dict[int, dict[str, FloatArray]]


def within_range(
    positions: Mapping[str, FloatArray], communication_range: float
) -> dict[str, list[str]]:
    """Return the robots in range of each robot, in name order: at most C_R [m] away (III-B)."""
    names = sorted(positions)
    return {
        name: [
            other
            for other in names
            if other != name
            and float(np.linalg.norm(positions[name] - positions[other])) <= communication_range
        ]
        for name in names
    }


class CuboidMission:
    """Robots that search the faces of objects, step by step of dT [s].

    `scheme`: distributed is each for itself, as in P2; sequential one after the other, each knowing
    the new plans of those before it; centralized all together, P1.

    Raises
    ------
    ValueError
        If a robot cannot fly, an object is outside the area, or no cuboid can be reached.
    """

    def __init__(
        self,
        settings: CuboidSettings,
        area: ArrayLike,
        robots: Mapping[str, SearchRobot],
        step: float = 1.0,
        seed: int = 1,
        scheme: Scheme = 'distributed',
    ) -> None:
        self.settings = settings
        self.seed = seed
        self.scheme = scheme
        self.mission = plan_mission(settings, area)
        self.agents = {
            name: SearchAgent(
                name,
                settings,
                self.mission,
                Dynamics.from_settings(robots[name].dynamics, step),
                robots[name].hazard,
                robots[name].start,
            )
            for name in sorted(robots)
        }
        self.positions = {name: agent.home.copy() for name, agent in self.agents.items()}
        self.velocities = {name: np.zeros(3) for name in self.agents}
        self.step = 0
        self.choices: dict[str, Choice] = {}

    def run(self, limit: int = 2000, keep: tuple[int, ...] = ()) -> MissionRecord:
        """Run until the team has visited all cuboids, or for `limit` steps.

        The end is that of the union of what the robots have visited, which none of them may know.
        """
        paths: dict[str, list[FloatArray]] = {name: [] for name in self.agents}
        visited, active, times = [], [], []
        how: dict[str, int] = {}
        plans: dict[int, dict[str, FloatArray]] = {}
        collisions = outside = recharges = 0
        area = self.mission.area
        while True:
            broadcasts = self._observe()
            for name, place in self.positions.items():
                paths[name].append(place.copy())
            union = np.any([agent.visited for agent in self.agents.values()], axis=0)
            visited.append(int(union.sum()))
            searching = {
                name for name, agent in self.agents.items() if agent.activity is Activity.SEARCHING
            }
            active.append(len(searching))
            if union.all() or self.step >= limit:
                break
            times += self._decide(broadcasts)
            recharges += sum(self.agents[name].activity is Activity.RETURNING for name in searching)
            if self.step in keep:
                plans[self.step] = {n: c.plan.positions for n, c in self.choices.items()}
            for name, choice in self.choices.items():
                how[choice.how] = how.get(choice.how, 0) + 1
                agent = self.agents[name]
                place, speed = agent.dynamics.next(
                    self.positions[name], self.velocities[name], choice.control
                )
                collisions += self.mission.way_hits(self.positions[name], place)
                beyond = (place < area[:, 0] - 1e-2) | (place > area[:, 1] + 1e-2)
                outside += bool(beyond.any())
                self.positions[name], self.velocities[name] = place, speed
            self.step += 1
        snapshots = [shot for agent in self.agents.values() for shot in agent.snapshots]
        return MissionRecord(
            self.mission,
            self.step,
            bool(union.all()),
            {name: np.array(path) for name, path in paths.items()},
            np.array(visited),
            np.array(active),
            sorted(snapshots, key=lambda shot: (shot.step, shot.robot, shot.cuboid)),
            collisions,
            outside,
            how,
            np.array(times),
            recharges,
            plans,
        )

    def _observe(self) -> dict[str, Broadcast]:
        broadcasts = {}
        for name, agent in self.agents.items():
            message = agent.observe(self.step, self.positions[name], self.velocities[name])
            if message is not None:
                broadcasts[name] = message
        return broadcasts

    def _rng(self, name: str) -> np.random.Generator:
        return decision_stream(self.seed, name, self.step)

    def _decide(self, broadcasts: dict[str, Broadcast]) -> list[float]:
        heard = self.heard(broadcasts)
        if self.scheme == 'centralized':
            return self._decide_jointly(broadcasts, heard)
        times = []
        done: dict[str, Choice] = {}
        for name, agent in self.agents.items():
            wanted = None
            if self.scheme == 'sequential':
                wanted = self._not_planned(agent, heard[name], done)
            begun = time.perf_counter()
            done[name] = agent.decide(heard[name], self._rng(name), wanted)
            times.append(time.perf_counter() - begun)
        self.choices = done
        return times

    def heard(self, broadcasts: dict[str, Broadcast]) -> dict[str, list[Broadcast]]:
        """Return the messages that each robot receives; none while it recharges."""
        places = {name: message.position for name, message in broadcasts.items()}
        reach = within_range(places, self.settings.communication_range)
        return {name: [broadcasts[other] for other in reach.get(name, [])] for name in self.agents}

    def _not_planned(
        self, agent: SearchAgent, heard: list[Broadcast], done: dict[str, Choice]
    ) -> BoolArray:
        """Return the cuboids that no plan of another robot has, the new ones where there are."""
        wanted = np.ones(len(agent.visited), dtype=bool)
        for message in heard:
            if message.robot in done:
                planned = [n for _, n in done[message.robot].plan.visits]
            else:
                planned = [n for n, tau in message.plan.items() if tau >= 0]
            wanted[planned] = False
        return wanted

    def _decide_jointly(
        self, broadcasts: dict[str, Broadcast], heard: dict[str, list[Broadcast]]
    ) -> list[float]:
        agents = list(self.agents.values())
        known = np.any([agent.visited for agent in agents], axis=0)
        for agent in agents:
            agent.visited |= known
        begun = time.perf_counter()
        everything = np.ones(len(known), dtype=bool)
        # Each is drawn to its nearest cuboid, as (6) has it.
        problems = [agent.problem([], everything) for agent in agents]
        joint = solve_jointly(agents[0].solver, problems)
        spent = time.perf_counter() - begun
        self.choices = {}
        for index, agent in enumerate(agents):
            plan = None if joint is None else joint.plans[index]
            self.choices[agent.name] = agent.follow(plan, problems[index].target)
        return [spent]


def summary(record: MissionRecord) -> dict[str, Any]:
    """Return the figures of a mission as plain values."""
    chances = [shot.detection_probability for shot in record.snapshots]
    return {
        'steps': record.steps,
        'complete': record.complete,
        'cuboids': len(record.mission.cells),
        'visited': int(record.visited[-1]),
        'collisions': record.collisions,
        'outside': record.outside,
        'recharges': record.recharges,
        'least_detection_probability': min(chances) if chances else None,
        'solve_median': float(np.median(record.solve_times)) if len(record.solve_times) else None,
        **{f'choices_{how}': number for how, number in sorted(record.how.items())},
    }
