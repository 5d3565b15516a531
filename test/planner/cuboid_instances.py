"""Problems of one robot as missions meet them, and others drawn at random."""

from __future__ import annotations

import numpy as np

from maasi_planner.buildings import CuboidSettings, HazardSettings, Objective, PlanSolver
from maasi_planner.buildings.agent import inflated
from maasi_planner.buildings.problem import Problem
from maasi_planner.buildings.robot_model import Dynamics
from maasi_sim.buildings.mission import CuboidMission, SearchRobot

AREA = np.array([[0.0, 250.0], [0.0, 400.0], [0.0, 80.0]])
OBJECTS = [
    {'centre': [175.0, 130.0], 'size': [60.0, 60.0, 60.0]},
    {'centre': [175.0, 320.0], 'size': [60.0, 60.0, 60.0]},
]
STARTS = {
    'purple': [166.0, 235.0, 5.0],
    'red': [185.0, 235.0, 5.0],
    'green': [165.0, 215.0, 5.0],
    'blue': [185.0, 215.0, 5.0],
}


def two_buildings(**settings):
    """Return the settings of figure 4."""
    return CuboidSettings(objects=OBJECTS, detection_probability=0.88, **settings)


def mission_of(settings, area, starts, seed=1, failures=False, scheme='distributed', **hazard):
    """Return a mission of robots that start at `starts`, by name."""
    battery = HazardSettings(failures=failures, **hazard)
    robots = {
        name: SearchRobot(np.array(place, dtype=float), hazard=battery)
        for name, place in starts.items()
    }
    return CuboidMission(settings, area, robots, seed=seed, scheme=scheme)


def solver_for(horizon, discount=1.0, **limits):
    """Return a solver of the paper's robot."""
    return PlanSolver(Dynamics(), Objective(horizon=horizon, discount=discount), **limits)


def problems_of_missions(horizon, number, seed=1, **settings):
    """Return (solver, problems): some of those that robots solve in missions of figure 4."""
    rng = np.random.default_rng(seed)
    met = []
    while len(met) < 8 * number:
        starts = {
            f'robot{i}': [rng.uniform(165.0, 185.0), rng.uniform(215.0, 235.0), 5.0]
            for i in range(3)
        }
        mission = mission_of(
            two_buildings(horizon=horizon, discount=1.0, time_limit=1e9, **settings),
            AREA,
            starts,
            seed=int(rng.integers(1000)),
        )
        for agent in mission.agents.values():
            agent.problem = _noting(agent.problem, met)
        mission.run(limit=120)
    chosen = rng.choice(len(met), number, replace=False)
    return solver_for(horizon), [met[i] for i in sorted(chosen)]


def joint_problems(robots, horizon, number, seed=1):
    """Return (solver, lists of problems): all robots' of a step, of centralized missions."""
    rng = np.random.default_rng(seed)
    met = []
    while len(met) < 4 * number:
        starts = {
            f'robot{i}': [rng.uniform(165.0, 185.0), rng.uniform(215.0, 235.0), 5.0]
            for i in range(robots)
        }
        mission = mission_of(
            two_buildings(horizon=horizon, discount=1.0, time_limit=1e9),
            AREA,
            starts,
            scheme='centralized',
        )
        single = []
        for agent in mission.agents.values():
            agent.problem = _noting(agent.problem, single)
        mission.run(limit=60)
        met += [single[i : i + robots] for i in range(0, len(single), robots)]
    chosen = rng.choice(len(met), number, replace=False)
    return solver_for(horizon), [met[i] for i in sorted(chosen)]


def _noting(method, met):
    def problem(*arguments):
        result = method(*arguments)
        met.append(result)
        return result

    return problem


def random_problem(rng, cuboids=6, obstacles=1):
    """Return a problem in a small area, crowded enough for all rows to matter."""
    area = np.array([[0.0, 120.0], [0.0, 120.0], [0.0, 60.0]])
    boxes = []
    for _ in range(obstacles):
        size = rng.uniform(8.0, 40.0, 3)
        low = rng.uniform(0.0, area[:, 1] - size)
        low[2] = 0.0 if rng.random() < 0.5 else low[2]
        boxes.append(np.stack([low, low + size], axis=1))
    solids = np.array(boxes).reshape(-1, 3, 2)
    while True:
        place = rng.uniform(area[:, 0], area[:, 1])
        speed = rng.uniform(-8.0, 8.0, 3)
        free = ~((solids[:, :, 0] < place) & (place < solids[:, :, 1])).all(axis=1).any()
        if free:
            break
    low = place + rng.uniform(-50.0, 40.0, (cuboids, 3)) * np.array([1.0, 1.0, 0.4])
    low = np.clip(low, area[:, 0], area[:, 1] - 10.0)
    corners = np.stack([low, low + 10.0], axis=2)
    target = corners[rng.integers(cuboids)].mean(axis=1)
    return Problem(
        position=place,
        velocity=speed,
        target=target,
        cuboids=corners,
        wanted=rng.random(cuboids) < 0.8,
        obstacles=inflated(solids, 0.01),
        area=area,
        between=bool(rng.random() < 0.7),
        brakes=bool(rng.random() < 0.7),
    )
