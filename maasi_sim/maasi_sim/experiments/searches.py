"""Searches in one process as experiments: cases, runs and measured quantities."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np

from maasi_filter.models.pose import Pose
from maasi_filter.unexplored_map import UnexploredMap
from maasi_sim.experiments.experiment import Case, Outcome, Quantity
from maasi_sim.scenario.loading import scenario_from_content, scenario_from_values
from maasi_sim.search import search
from maasi_sim.search_result import SearchResult

QUANTITIES = (
    Quantity('measurements_to_find_all', 'measurements to find all', '', 'restricted', 'limit'),
    Quantity('time_to_find_all', 'time to find all', 's', 'restricted', 'time_limit'),
    Quantity('measurements', 'measurements taken'),
    Quantity('found', 'targets found'),
    Quantity('false_found', 'false targets'),
    Quantity('rmse', 'RMSE', 'm'),
    Quantity('step_time', 'computation per measurement', 's'),
    Quantity('filter_time', 'filter step', 's'),
    Quantity('planning_time', 'decision', 's'),
    Quantity('explored', 'share explored in the end'),
    Quantity('clearance', 'smallest distance to an obstacle', 'm'),
)

# Measurements, and particles, of a small case.
_SMALL = 12
_SMALL_PARTICLES = 1000


def merged(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Return mappings merged key by key, later ones on top."""
    result: dict[str, Any] = {}
    for layer in layers:
        for key, value in layer.items():
            below = result.get(key)
            both = isinstance(below, Mapping) and isinstance(value, Mapping)
            result[key] = merged(below, value) if both else deepcopy(value)  # type: ignore[arg-type]
    return result


def search_case(
    name: str,
    values: Mapping[str, Any],
    most_measurements: int,
    preset: str = 'paper',
    small: bool = False,
    runs: int | None = None,
) -> Case:
    """Return a case that is a search; robots stop at each waypoint, as in the papers.

    `values` is the content of a scenario file, `most_measurements` the cap on those of all robots;
    a small case has few measurements and particles.
    """
    if small:
        most_measurements = min(most_measurements, _SMALL)
        values = merged(values, {'filter': {'particles': _SMALL_PARTICLES}})
    stopping = {robot: {'motion': {'arrival_radius': 0.0}} for robot in values['robots']}
    values = merged({'robots': stopping}, values, {'filter': {'threads': 1}})
    scenario = scenario_from_values(values, name)
    settings = {'scenario': scenario.content(), 'most_measurements': most_measurements}
    return Case(name, settings, preset, runs)  # type: ignore[arg-type]


def run_search(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a search of a case and return its results."""
    scenario = scenario_from_content(settings['scenario'], 'settings')
    result = search(scenario, seed, settings['most_measurements'])
    return outcome_of(result, settings['most_measurements'], scenario.limits.time)


def outcome_of(result: SearchResult, most_measurements: int | None, time_limit: float) -> Outcome:
    """Return the results of a search."""
    progress = result.progress
    complete = next(
        (item for item in progress if len(result.truth) and item.true_found == len(result.truth)),
        None,
    )
    names = sorted(result.measurements)
    columns: dict[str, Any] = {
        'step': [item.step for item in progress],
        'time': [item.time for item in progress],
        'measurements': [item.measurements for item in progress],
        'found': [item.found for item in progress],
        'true_found': [item.true_found for item in progress],
        'rmse': [item.rmse for item in progress],
    }
    for name in names:
        places = np.array([item.positions[name] for item in progress]).reshape(-1, 3)
        for axis, values in zip('xyz', places.T):
            columns[f'{name}_{axis}'] = values
        columns[f'{name}_measures'] = [name in item.members for item in progress]
    filter_time, planning_time = sum(result.filter_times), sum(result.planning_times)
    return Outcome(
        summary={
            'end_reason': result.end_reason,
            'measurements_to_find_all': complete.measurements if complete else None,
            'time_to_find_all': complete.time if complete else None,
            'limit': most_measurements,
            'time_limit': time_limit,
            'targets': len(result.truth),
            'found': len(result.truth) - result.missed,
            'false_found': result.false_found,
            'rmse': result.rmse,
            'measurements': result.total_measurements,
            'decisions': len(result.decisions),
            'distance': sum(result.distance.values()),
        },
        columns=columns,
        details={
            'truth': result.truth.tolist(),
            'found': [target.position.tolist() for target in result.found_targets],
        },
        timing={
            'filter_time': filter_time / max(len(result.filter_times), 1),
            'planning_time': planning_time / max(len(result.planning_times), 1),
            'step_time': (filter_time + planning_time) / max(result.total_measurements, 1),
        },
    )


def run_exploring(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a search and measure the explored share of the environment, the mean of 1 - e.

    Column 'explored' is after each measurement batch, that of the summary at the end.
    """
    outcome = run_search(settings, seed)
    scenario = scenario_from_content(settings['scenario'], 'settings')
    bounds = scenario.environment.array()
    exploration = UnexploredMap(bounds, float((bounds[:, 1] - bounds[:, 0]).max()) / 26.0)
    columns = {name: np.asarray(values, float) for name, values in outcome.columns.items()}
    detections = {
        name: robot.sensor.build(name, scenario.dimension).detection
        for name, robot in scenario.robots.items()
    }
    explored = []
    for row in range(len(columns['step'])):
        for name, detection in detections.items():
            if columns[f'{name}_measures'][row]:
                place = [columns[f'{name}_{axis}'][row] for axis in 'xyz']
                exploration.update(detection, Pose.from_yaw(place, scenario.robots[name].yaw))
        explored.append(exploration.explored_fraction())
    outcome.columns = {**outcome.columns, 'explored': explored}
    outcome.summary['explored'] = explored[-1] if explored else 0.0
    return outcome


def run_among_obstacles(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a search and measure the clearance, straight from one measurement to the next."""
    outcome = run_search(settings, seed)
    scenario = settings['scenario']
    nearest = []
    for name, robot in scenario['robots'].items():
        places = np.stack([np.asarray(outcome.columns[f'{name}_{axis}']) for axis in 'xyz'], axis=1)
        places = np.vstack([np.asarray(robot['start'], float), places])
        share = np.linspace(0.0, 1.0, 25)[:, None, None]
        way = (places[:-1] + share * np.diff(places, axis=0)).reshape(-1, 3)
        nearest += [
            float(np.linalg.norm(way - item['centre'], axis=1).min()) - item['radius']
            for item in scenario['environment']['obstacles']
        ]
    outcome.summary['clearance'] = min(nearest) if nearest else None
    return outcome
