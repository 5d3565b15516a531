"""A search of buildings (paper 004) in one process: robots, batteries and radio link."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_filter.arrays import BoolArray, FloatArray
from maasi_planner.buildings.agent import (
    Activity,
    Broadcast,
    SearchAgent,
    Snapshot,
    decision_stream,
)
from maasi_planner.buildings.preplanning import CoveragePlan, plan_mission
from maasi_planner.buildings.problem import Plan, solve_jointly
from maasi_planner.buildings.settings import CuboidSettings, SearcherSettings

Scheme = Literal['distributed', 'sequential', 'centralized']


@dataclass
class MissionRecord:
    """Results of a mission."""

    mission: CoveragePlan
    steps: int
    complete: bool  # whether all cuboids were visited
    paths: dict[str, FloatArray]  # positions at all steps, (steps + 1, 3) [m]
    visited: NDArray[np.int64]  # (steps + 1,): cuboids visited by the team
    active: NDArray[np.int64]  # (steps + 1,): robots that search
    snapshots: list[Snapshot]
    collisions: int  # steps on which a path cut an object or obstacle
    outside: int  # steps on which a robot was outside the area
    how: dict[str, int]  # number of decisions by method
    solve_times: FloatArray  # per decision; of all robots together if centralized [s]
    recharges: int  # batteries that failed
    plans: dict[int, dict[str, FloatArray]]  # predicted positions at the requested steps


def within_range(
    positions: Mapping[str, FloatArray], communication_range: float
) -> dict[str, list[str]]:
    """Return the robots within C_R [m] of each robot, in name order (III-B)."""
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
    """Robots that search the faces of objects in steps of dT [s].

    Schemes: distributed (P2, each robot alone), sequential (each knows the new plans of those
    before), centralized (P1). Raises ValueError if a robot cannot fly, an object is outside the
    area, or no cuboid can be reached.
    """

    def __init__(
        self,
        settings: CuboidSettings,
        area: ArrayLike,
        robots: Mapping[str, SearcherSettings],
        step: float = 1.0,
        seed: int = 1,
        scheme: Scheme = 'distributed',
    ) -> None:
        self.settings, self.seed, self.scheme = settings, seed, scheme
        self.mission = plan_mission(settings, area)
        self.agents = {
            name: SearchAgent(name, settings, self.mission, robots[name], step)
            for name in sorted(robots)
        }
        self.positions = {name: agent.home.copy() for name, agent in self.agents.items()}
        self.velocities = {name: np.zeros(3) for name in self.agents}
        self.step = 0
        self.choices: dict[str, Plan] = {}

    def run(self, limit: int = 2000, keep: tuple[int, ...] = ()) -> MissionRecord:
        """Run until the team has visited all cuboids, or up to a limit of steps."""
        paths: dict[str, list[FloatArray]] = {name: [] for name in self.agents}
        visited, active, times = [], [], []
        how: dict[str, int] = {}
        plans: dict[int, dict[str, FloatArray]] = {}
        collisions = outside = recharges = 0
        area = self.mission.area
        while True:
            broadcasts = {}
            for name, agent in self.agents.items():
                message = agent.observe(self.step, self.positions[name], self.velocities[name])
                if message is not None:
                    broadcasts[name] = message
                paths[name].append(self.positions[name].copy())
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
                plans[self.step] = {n: c.positions for n, c in self.choices.items()}
            for name, choice in self.choices.items():
                how[choice.how] = how.get(choice.how, 0) + 1
                agent = self.agents[name]
                place, speed = agent.dynamics.next(
                    self.positions[name], self.velocities[name], choice.controls[0]
                )
                collisions += self.mission.path_hits(self.positions[name], place)
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

    def _decide(self, broadcasts: dict[str, Broadcast]) -> list[float]:
        if self.scheme == 'centralized':
            return [self._decide_jointly()]
        places = {name: message.position for name, message in broadcasts.items()}
        # Recharging robots receive nothing.
        reach = within_range(places, self.settings.communication_range)
        times = []
        done: dict[str, Plan] = {}
        for name, agent in self.agents.items():
            received = [broadcasts[other] for other in reach.get(name, [])]
            wanted = _not_planned(received, done, agent) if self.scheme == 'sequential' else None
            rng = decision_stream(self.seed, name, self.step)
            begun = time.perf_counter()
            done[name] = agent.decide(received, rng, wanted)
            times.append(time.perf_counter() - begun)
        self.choices = done
        return times

    def _decide_jointly(self) -> float:
        agents = list(self.agents.values())
        known = np.any([agent.visited for agent in agents], axis=0)
        for agent in agents:
            agent.visited |= known
        begun = time.perf_counter()
        everything = np.ones(len(known), dtype=bool)
        # Equation (6): each robot is drawn to its nearest cuboid.
        problems = [agent.problem([], everything) for agent in agents]
        joint = solve_jointly(agents[0].solver, problems)
        spent = time.perf_counter() - begun
        plans = [None] * len(agents) if joint is None else joint
        self.choices = {agent.name: agent.follow(plan) for agent, plan in zip(agents, plans)}
        return spent


def _not_planned(received: list[Broadcast], done: dict[str, Plan], agent: SearchAgent) -> BoolArray:
    """Return the cuboids that no plan of another robot contains, preferring new plans."""
    wanted = np.ones(len(agent.visited), dtype=bool)
    for message in received:
        if message.robot in done:
            planned = [n for _, n in done[message.robot].visits]
        else:
            planned = [n for n, tau in message.plan.items() if tau >= 0]
        wanted[planned] = False
    return wanted
