"""Searches in one process as experiments: cases, runs and measured quantities."""

import hashlib
import inspect
import math
import pkgutil
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose
from maasi_filter.settings import FILTERS
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.settings import PLANNERS
from maasi_sim.experiments.experiment import Case, Experiment, Outcome, Quantity
from maasi_sim.experiments.figures import draw_comparison
from maasi_sim.experiments.tables import SearchTable
from maasi_sim.machine import code_digest
from maasi_sim.run.buildings.scenario import is_cuboid_scenario
from maasi_sim.run.log import RunLog
from maasi_sim.scenario.layering import Key, ScenarioError, merged
from maasi_sim.scenario.loading import (
    find_scenario,
    load_scenario,
    read_scenario,
    scenario_from_values,
)
from maasi_sim.scenario.schema import Scenario
from maasi_sim.search import check_events, search
from maasi_sim.simulation.world import noise_stream

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
    Quantity('lanes', 'share of the path in lanes'),
    Quantity('clearance', 'smallest distance to an obstacle', 'm'),
)

# A lane is at least this share of the longest side, and straight to this share of each step.
_LANE = 0.5
_STRAIGHT = 0.99
# Measurements, and particles, of a small case.
_SMALL = 12
_SMALL_PARTICLES = 1000
# Self-affine with Hurst's exponent of real terrain, about 0.8 (a fractal dimension of 2.2); the
# deviation of heights over the whole map is that of hills.
HURST = 0.8
MAP_SIZE = 12_000.0
MAP_NODES = 1024
DEVIATION = 150.0


def search_case(
    name: str,
    values: Mapping[str, Any],
    most_measurements: int,
    preset: str = 'paper',
    small: bool = False,
    runs: int | None = None,
) -> Case:
    """Return a search with stops at waypoints, of few measurements, and few particles if small."""
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
    scenario = scenario_from_values(settings['scenario'], 'settings')
    result = search(scenario, seed, settings['most_measurements'])
    return outcome_of(result, settings['most_measurements'], scenario.limits.time)


def outcome_of(result: RunLog, most_measurements: int | None, time_limit: float) -> Outcome:
    """Return the results of a search."""
    progress = result.progress
    complete = next(
        (item for item in progress if len(result.truth) and item.true_found == len(result.truth)),
        None,
    )
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
        columns=result.columns(),
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


def lane_share(places: FloatArray, side: float) -> float:
    """Return the share of a path (n, 3) that is straight along an axis over half of `side` [m]."""
    steps = np.diff(places, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    steps, lengths = steps[lengths > 0.0], lengths[lengths > 0.0]
    if not len(steps):
        return 0.0
    # 1 to 6 along an axis, 0 askew.
    axis = np.abs(steps).argmax(axis=1)
    along = steps[np.arange(len(steps)), axis]
    heading = np.where(np.abs(along) >= _STRAIGHT * lengths, 2 * axis + 1 + (along > 0.0), 0)
    turns = np.flatnonzero(np.diff(heading)) + 1
    legs = zip(np.split(heading, turns), np.split(lengths, turns))
    lanes = [leg.sum() for axis, leg in legs if axis[0] and leg.sum() >= _LANE * side]
    return float(sum(lanes) / lengths.sum())


def run_exploring(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a search and measure the explored share (mean of 1 - e) after each batch, and lanes."""
    outcome = run_search(settings, seed)
    scenario = scenario_from_values(settings['scenario'], 'settings')
    bounds = scenario.environment.array()
    side = float((bounds[:, 1] - bounds[:, 0]).max())
    exploration = UnexploredMap(bounds, side / 26.0)
    columns = outcome.columns
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
    outcome.columns = {**columns, 'explored': explored}
    outcome.summary['explored'] = explored[-1] if explored else 0.0
    paths = [np.stack([columns[f'{name}_{axis}'] for axis in 'xyz'], 1) for name in detections]
    outcome.summary['lanes'] = float(np.mean([lane_share(path, side) for path in paths]))
    return outcome


def run_among_obstacles(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a search and measure the least distance of a robot's centre to an obstacle."""
    scenario = scenario_from_values(settings['scenario'], 'settings')
    result = search(scenario, seed, settings['most_measurements'])
    outcome = outcome_of(result, settings['most_measurements'], scenario.limits.time)
    area = Area(scenario.environment)
    share = np.linspace(0.0, 1.0, 5)[:, None, None]
    paths = [
        (path[:-1, 1:] + share * np.diff(path[:, 1:], axis=0)).reshape(-1, 3)
        for path in result.trajectories.values()
    ]
    nearest = [area.distances(place).min(initial=np.inf) for path in paths for place in path]
    outcome.summary['clearance'] = float(min(nearest)) if scenario.environment.obstacles else None
    return outcome


# Random terrain with the statistics of real terrain, as that of the paper is not available.


def chunk(generator: np.random.Generator, size: float, nodes: int) -> FloatArray:
    """Return the heights of an area of `size` metres in a map of 12 km, (nodes, nodes) [m].

    The power of a wave number k falls with k^-(2 H + 2), so that the mean square difference of
    two heights grows with their distance to the power 2 H. The map is periodic.
    """
    shape = MAP_NODES, MAP_NODES
    spectrum = np.fft.rfft2(generator.standard_normal(shape))
    waves = np.hypot(np.fft.fftfreq(MAP_NODES)[:, None], np.fft.rfftfreq(MAP_NODES)[None, :])
    waves[0, 0] = np.inf
    heights = np.fft.irfft2(spectrum * waves ** -(HURST + 1.0), s=shape)
    heights = DEVIATION * ((heights - heights.mean()) / heights.std())
    corner = generator.uniform(0.0, MAP_NODES, size=2)
    along = np.linspace(0.0, size * MAP_NODES / MAP_SIZE, nodes)
    places = np.meshgrid(corner[0] + along, corner[1] + along, indexing='ij')
    return np.asarray(ndimage.map_coordinates(heights, places, order=3, mode='grid-wrap'))


def littered(
    heights: FloatArray,
    bounds: FloatArray,
    number: int,
    spread: float,
    margin: float,
    generator: np.random.Generator,
) -> FloatArray:
    """Return targets in two clusters: each the lowest (highest) of ten places at an extreme."""
    nodes = heights.shape[0]
    low, high = bounds[:, 0] + margin, bounds[:, 1] - margin
    sides = [np.linspace(bounds[axis, 0], bounds[axis, 1], nodes) for axis in (0, 1)]
    inside = ((sides[0] >= low[0]) & (sides[0] <= high[0]))[:, None] & (
        (sides[1] >= low[1]) & (sides[1] <= high[1])
    )[None, :]
    targets = []
    for sign in (1.0, -1.0):
        signed = np.where(inside, sign * heights, np.inf)
        row, column = np.unravel_index(int(np.argmin(signed)), signed.shape)
        centre = np.array([sides[0][row], sides[1][column]])
        for _ in range(number // 2):
            places = centre + generator.normal(0.0, spread, (10, 2))
            # Reflected at the bounds, so that targets do not accumulate along them.
            places = np.where(places < low, 2.0 * low - places, places)
            places = np.where(places > high, 2.0 * high - places, places)
            places = np.clip(places, low, high)
            index = (places - bounds[:, 0]) / (bounds[:, 1] - bounds[:, 0]) * (nodes - 1)
            found = ndimage.map_coordinates(heights, index.T, order=1)
            targets.append(places[int(np.argmin(sign * found))])
    return np.array(targets)


def run_on_terrain(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a search for 14 targets at a low and a high place of terrain made from the seed."""
    generator = noise_stream(seed, purpose='terrain')
    bounds = np.array(settings['scenario']['environment']['bounds'], float)
    heights = chunk(generator, float(bounds[0, 1] - bounds[0, 0]), 57)
    targets = littered(heights, bounds, 14, 15.0, 10.0, generator)
    content = deepcopy(settings)
    content['scenario']['targets'] = {'positions': targets.tolist()}
    outcome = run_search(content, seed)
    outcome.details['heights'] = heights[::2, ::2].round(2).tolist()
    return outcome


# Comparisons of planners and filters on the same seeds.


def comparison_of(name: str, cases: Sequence[Case]) -> Experiment:
    """Return searches, of `search_settings`, as an experiment; the first case is compared with."""
    return Experiment(
        name=name,
        title='Searches on the same seeds',
        cases=lambda small: list(cases),
        run=run_compared,
        quantities=(),
        draw=lambda figure, results: draw_comparison(figure, [SearchTable(results)]),
        compared=True,
    )


def search_settings(scenario: Scenario, planner: str | None = None) -> dict[str, Any]:
    """Return the settings of a case; `planner`, `module:function`, makes planners for `search`."""
    return {'scenario': scenario.content(), 'planner': planner, 'code': code_of(scenario)}


def code_of(scenario: Scenario) -> str:
    """Return a hash of the code of a search, with the files of a user's own planner and filter."""
    chosen = (PLANNERS, scenario.planner.name), (FILTERS, scenario.filter.method)
    classes = [group.load(name) for group, name in chosen if name not in group.built_in]
    if not classes:
        return code_digest()
    files = filter(None, map(inspect.getsourcefile, classes))
    own = b''.join(Path(file).read_bytes() for file in files)
    return f'{code_digest()} {hashlib.sha256(own).hexdigest()[:16]}'


def run_compared(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a search of a case; RuntimeError if the code differs from that of the settings."""
    scenario = scenario_from_values(settings['scenario'], 'settings')
    if settings['code'] != code_of(scenario):
        raise RuntimeError('this worker has another version of the code')
    limit = scenario.limits.time
    planner = settings['planner'] and pkgutil.resolve_name(settings['planner'])
    result = search(scenario, seed, planner=planner)
    outcome = outcome_of(result, None, limit)
    times = find_times(result, limit)
    complete = outcome.summary['time_to_find_all']
    outcome.summary['complete'] = complete is not None
    outcome.summary['time'] = limit if complete is None else complete
    outcome.summary['mean_time'] = float(times.mean()) if len(times) else None
    for name, share in (('half_time', 0.5), ('most_time', 0.9)):
        place = math.ceil(share * len(times)) - 1
        outcome.summary[name] = float(np.sort(times)[place]) if len(times) else None
    outcome.timing['slowest_decision'] = max(result.planning_times, default=0.0)
    return outcome


def find_times(result: RunLog, limit: float) -> FloatArray:
    """Return when the first, second and so on of n targets was found, or the limit [s]."""
    times = np.full(len(result.truth), limit)
    for item in reversed(result.progress):
        times[: item.true_found] = np.minimum(times[: item.true_found], item.time)
    return times


def compared(
    scenario: str | Path,
    planners: Sequence[str] = (),
    filters: Sequence[str] = (),
    time_limit: float | None = None,
) -> Experiment:
    """Return the comparison of planners and filters in a scenario, by default its own ones."""
    path = find_scenario(scenario)
    if is_cuboid_scenario(read_scenario(path)):
        raise ScenarioError(f'{path}: is a search of buildings, allowed are searches for targets')
    cases = []
    for method in filters or (None,):
        for planner in planners or (None,):
            # Many searches run in parallel; results do not depend on the number of threads.
            overrides: dict[str, tuple[Key, Any]] = {'one process': (('filter', 'threads'), 1)}
            if planner is not None:
                overrides['--planner'] = ('planner', 'name'), planner
            if method is not None:
                overrides['--filter'] = ('filter', 'method'), method
            if time_limit is not None:
                overrides['--time-limit'] = ('limits', 'time'), time_limit
            loaded = load_scenario(path, overrides)
            try:
                check_events(loaded)
            except ValueError as error:
                raise ScenarioError(f'{path}: {error}') from None
            names = [planner or loaded.planner.name]
            if len(filters) > 1:
                names.append(str(method))
            cases.append(Case(', '.join(names), search_settings(loaded)))
    return comparison_of(path.stem, cases)
