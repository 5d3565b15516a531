"""Problems of one robot as missions meet them, and others drawn at random."""

import numpy as np

from maasi_planner.buildings.agent import inflated
from maasi_planner.buildings.dynamics import Dynamics
from maasi_planner.buildings.problem import PlanSolver, Problem
from maasi_planner.buildings.settings import CuboidMethodSettings, CuboidSettings, SearcherSettings
from maasi_sim.run.buildings.mission import CuboidMission

AREA = np.array([[0.0, 250.0], [0.0, 400.0], [0.0, 80.0]])
OBJECTS = [
    {'centre': [175.0, 130.0], 'size': [60.0, 60.0, 60.0]},
    {'centre': [175.0, 320.0], 'size': [60.0, 60.0, 60.0]},
]


def two_buildings(**settings):
    """Return the settings of figure 4, without a limit of wall time."""
    return CuboidSettings(objects=OBJECTS, time_limit=1e9, **settings)


def robots_at(starts, **hazard):
    """Return robots that start at places, by name; batteries fail if anything is said of them."""
    hazard = {'failures': bool(hazard), **hazard}
    return {
        name: SearcherSettings.model_validate({'start': list(place), 'hazard': hazard})
        for name, place in starts.items()
    }


def solver_for(horizon, discount=1.0, **settings):
    limits = {'time_limit': 1e9, **settings}
    return PlanSolver(
        Dynamics(), CuboidMethodSettings(horizon=horizon, discount=discount, **limits)
    )


def problems_of_missions(horizon, number, seed=1):
    """Return (solver, problems): some of those that robots solve in missions of figure 4."""
    rng = np.random.default_rng(seed)
    met = []
    while len(met) < 8 * number:
        met += _met(rng, 3, horizon, 'distributed', 120)
    chosen = rng.choice(len(met), number, replace=False)
    return solver_for(horizon), [met[i] for i in sorted(chosen)]


def joint_problems(robots, horizon, number, seed=1):
    """Return (solver, lists of problems): all robots' of a step, of centralized missions."""
    rng = np.random.default_rng(seed)
    met = []
    while len(met) < 4 * number:
        single = _met(rng, robots, horizon, 'centralized', 60)
        met += [single[i : i + robots] for i in range(0, len(single), robots)]
    chosen = rng.choice(len(met), number, replace=False)
    return solver_for(horizon), [met[i] for i in sorted(chosen)]


def _met(rng, number, horizon, scheme, limit):
    starts = {
        f'robot{i}': [rng.uniform(165.0, 185.0), rng.uniform(215.0, 235.0), 5.0]
        for i in range(number)
    }
    seed = int(rng.integers(1000)) if scheme == 'distributed' else 1
    settings = two_buildings(horizon=horizon, discount=1.0)
    mission = CuboidMission(settings, AREA, robots_at(starts), seed=seed, scheme=scheme)
    met = []
    for agent in mission.agents.values():
        agent.problem = lambda *given, true=agent.problem: met.append(true(*given)) or met[-1]
    mission.run(limit)
    return met


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
        if not ((solids[:, :, 0] < place) & (place < solids[:, :, 1])).all(axis=1).any():
            break
    low = place + rng.uniform(-50.0, 40.0, (cuboids, 3)) * np.array([1.0, 1.0, 0.4])
    low = np.clip(low, area[:, 0], area[:, 1] - 10.0)
    corners = np.stack([low, low + 10.0], axis=2)
    target = corners[rng.integers(cuboids)].mean(axis=1)
    wanted = rng.random(cuboids) < 0.8
    return Problem(place, speed, target, corners, wanted, inflated(solids, 0.01), area)
