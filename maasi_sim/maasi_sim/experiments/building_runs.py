"""Searches of buildings as experiments: runs and measured quantities."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from maasi_planner.buildings import (
    CuboidSettings,
    DynamicsSettings,
    HazardSettings,
    plan_mission,
)
from maasi_sim.buildings.mission import CuboidMission, SearchRobot, summary
from maasi_sim.experiments.experiment import Outcome, Quantity

# Largest number of steps of a mission.
_LIMIT = 1000
# Without a limit on wall time a decision does not depend on the machine [s].
_FOR_EVER = 1e9

QUANTITIES = (
    Quantity('steps', 'time until all cuboids are visited', 's', 'restricted'),
    Quantity('cuboids', 'cuboids'),
    Quantity('coverage', 'share of the faces that is seen'),
    Quantity('complete', 'missions with all cuboids visited'),
    Quantity('collisions', 'steps on which an object was cut'),
    Quantity('least_detection_probability', 'least p_d of a snapshot'),
    Quantity('active', 'robots that search, mean over the steps'),
    Quantity('recharges', 'batteries that failed'),
    Quantity('solve_mean', 'time of a decision', 's'),
    Quantity('centralized', 'time of a joint decision, P1', 's'),
    Quantity('distributed', 'time of a decision of one robot, P2', 's'),
)
_STEPS_TIMED = 8
_SNAPSHOT = ('cuboid', 'robot', 'step', 'distance', 'detection_probability')


def mission_settings(settings: dict[str, Any]) -> CuboidSettings:
    """Return the settings of the planner of a case."""
    return CuboidSettings.model_validate({'time_limit': _FOR_EVER, **settings['mission']})


def _robots(settings: dict[str, Any], seed: int) -> dict[str, SearchRobot]:
    """Return the robots of a case: at given places, or at random ones outside of objects."""
    rng = np.random.default_rng(seed)
    hazard = {'failures': False, **settings.get('hazard', {})}
    dynamics = DynamicsSettings.model_validate(settings.get('dynamics', {}))
    starts = settings.get('starts')
    if starts is None:
        box = np.array(settings.get('spawn', settings['area']), dtype=float)
        mission = plan_mission(mission_settings(settings), settings['area'])
        starts = {}
        while len(starts) < settings['agents']:
            place = rng.uniform(box[:, 0], box[:, 1])
            # Robots start at least 2 m from objects.
            near = (mission.solids[:, :, 0] - 2.0 < place) & (place < mission.solids[:, :, 1] + 2.0)
            if not near.all(axis=1).any():
                starts[f'agent{len(starts) + 1:02d}'] = place.tolist()
    robots = {}
    for name in sorted(starts):
        own = dict(hazard)
        if 'alpha_range' in settings:
            own['alpha'] = float(rng.uniform(*settings['alpha_range']))
        robots[name] = SearchRobot(
            np.array(starts[name], dtype=float), dynamics, HazardSettings.model_validate(own)
        )
    return robots


def run_mission(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a mission of a case."""
    mission = CuboidMission(
        mission_settings(settings),
        settings['area'],
        _robots(settings, seed),
        seed=seed,
        scheme=settings.get('scheme', 'distributed'),
    )
    record = mission.run(settings.get('limit', _LIMIT), tuple(settings.get('keep', ())))
    facts = summary(record)
    length = record.steps + 1
    columns: dict[str, Any] = {
        'step': np.arange(length),
        'visited': record.visited,
        'active': record.active,
    }
    for name, path in record.paths.items():
        for axis, letter in enumerate('xyz'):
            columns[f'{name}_{letter}'] = path[:, axis]
    return Outcome(
        {
            'steps': record.steps if record.complete else None,
            'limit': settings.get('limit', _LIMIT),
            'complete': record.complete,
            'cuboids': facts['cuboids'],
            'visited': facts['visited'],
            'coverage': record.mission.coverage,
            'collisions': record.collisions,
            'outside': record.outside,
            'recharges': record.recharges,
            'active': float(record.active.mean()),
            'least_detection_probability': facts['least_detection_probability'],
            'optimal': record.how.get('optimal', 0) / max(sum(record.how.values()), 1),
        },
        columns,
        {
            'snapshots': [
                {name: getattr(shot, name) for name in _SNAPSHOT} for shot in record.snapshots
            ],
            'plans': {
                str(step): {name: plan.tolist() for name, plan in plans.items()}
                for step, plans in record.plans.items()
            },
        },
        {'solve_mean': float(record.solve_times.mean()) if len(record.solve_times) else 0.0},
    )


def run_timing(settings: dict[str, Any], seed: int) -> Outcome:
    """Time the decisions of both controllers at the first steps of a mission."""
    spent = {}
    visited = {}
    for scheme in ('centralized', 'distributed'):
        mission = CuboidMission(
            mission_settings(settings),
            settings['area'],
            _robots(settings, seed),
            seed=seed,
            scheme=scheme,  # type: ignore[arg-type]
        )
        begun = time.perf_counter()
        record = mission.run(_STEPS_TIMED)
        spent[scheme] = float(record.solve_times.mean())
        spent[f'{scheme}_mission'] = time.perf_counter() - begun
        visited[f'visited_{scheme}'] = int(record.visited[-1])
    rows = {'step': np.arange(_STEPS_TIMED)}
    return Outcome({'cuboids': len(mission.mission.cells), **visited}, rows, {}, spent)
