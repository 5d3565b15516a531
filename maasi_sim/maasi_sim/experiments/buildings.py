"""Searches of buildings as experiments: runs, measured quantities, and the figures of 004."""

from __future__ import annotations

import time
from collections.abc import Sequence
from itertools import product, zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from maasi_planner.buildings.agent import inflated
from maasi_planner.buildings.preplanning import plan_mission
from maasi_planner.buildings.settings import CuboidSettings, SearcherSettings
from maasi_sim.experiments.experiment import Outcome, Quantity, Results
from maasi_sim.experiments.tables import interval
from maasi_sim.run.buildings.mission import CuboidMission
from maasi_sim.run.buildings.picture import draw_mission, legend

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LIMIT = 1000  # largest number of steps of a mission
_FOR_EVER = 1e9  # without a limit on wall time a decision does not depend on the machine [s]

STEPS = Quantity('steps', 'time until all cuboids are visited', 's', 'restricted')
QUANTITIES = (
    STEPS,
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
_PAPER_COLOUR = '#D62728'
_SNAPSHOT = ('cuboid', 'robot', 'step', 'distance', 'detection_probability')


def mission_settings(settings: dict[str, Any]) -> CuboidSettings:
    """Return the settings of the planner of a case."""
    return CuboidSettings.model_validate({'time_limit': _FOR_EVER, **settings['mission']})


def _mission(settings: dict[str, Any], seed: int, scheme: Any) -> CuboidMission:
    search, area = mission_settings(settings), settings['area']
    rng = np.random.default_rng(seed)
    starts = settings.get('starts')
    if starts is None:
        box = np.array(settings.get('spawn', area), dtype=float)
        # Robots start at least 2 m from objects.
        solids = inflated(plan_mission(search, area).solids, 2.0)
        starts = {}
        while len(starts) < settings['agents']:
            place = rng.uniform(box[:, 0], box[:, 1])
            near = (solids[:, :, 0] < place) & (place < solids[:, :, 1])
            if not near.all(axis=1).any():
                starts[f'agent{len(starts) + 1:02d}'] = place.tolist()
    robots = {}
    for name in sorted(starts):
        hazard = {'failures': False, **settings.get('hazard', {})}
        if 'alpha_range' in settings:
            hazard['alpha'] = float(rng.uniform(*settings['alpha_range']))
        robot = {'start': starts[name], 'hazard': hazard}
        robots[name] = SearcherSettings.model_validate(robot)
    return CuboidMission(search, area, robots, seed=seed, scheme=scheme)


def run_mission(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a mission of a case."""
    mission = _mission(settings, seed, settings.get('scheme', 'distributed'))
    limit = settings.get('limit', _LIMIT)
    record = mission.run(limit, tuple(settings.get('keep', ())))
    columns: dict[str, Any] = {
        'step': np.arange(record.steps + 1),
        'visited': record.visited,
        'active': record.active,
    }
    for name, path in record.paths.items():
        columns.update({f'{name}_{letter}': path[:, axis] for axis, letter in enumerate('xyz')})
    shots = [{name: getattr(shot, name) for name in _SNAPSHOT} for shot in record.snapshots]
    return Outcome(
        {
            'steps': record.steps if record.complete else None,
            'limit': limit,
            'complete': record.complete,
            'cuboids': len(record.mission.cells),
            'visited': int(record.visited[-1]),
            'coverage': record.mission.coverage,
            'collisions': record.collisions,
            'outside': record.outside,
            'recharges': record.recharges,
            'active': float(record.active.mean()),
            'least_detection_probability': min(
                (shot['detection_probability'] for shot in shots), default=None
            ),
            'optimal': record.how.get('optimal', 0) / max(sum(record.how.values()), 1),
        },
        columns,
        {'snapshots': shots, 'plans': record.plans},
        {'solve_mean': float(record.solve_times.mean()) if len(record.solve_times) else 0.0},
    )


def run_timing(settings: dict[str, Any], seed: int) -> Outcome:
    """Time the decisions of both controllers at the first steps of a mission."""
    spent: dict[str, float] = {}
    facts: dict[str, Any] = {}
    for scheme in ('centralized', 'distributed'):
        mission = _mission(settings, seed, scheme)
        begun = time.perf_counter()
        record = mission.run(_STEPS_TIMED)
        spent[scheme] = float(record.solve_times.mean())
        spent[f'{scheme}_mission'] = time.perf_counter() - begun
        facts[f'visited_{scheme}'] = int(record.visited[-1])
    facts = {'cuboids': len(mission.mission.cells), **facts}
    return Outcome(facts, {'step': np.arange(_STEPS_TIMED)}, {}, spent)


# Figures.


def draw_missions(
    figure: Figure, results: Results, cases: Sequence[str], step: int | None = None
) -> None:
    """Draw the first run of cases, whole, and with `step` at that step, too."""
    names = [name for name in cases if name in results.names()] or results.names()[:1]
    steps = [None] if step is None else [step, None]
    panels = list(product(names, steps))
    grid = figure.add_gridspec(1, len(panels))
    for index, (name, until) in enumerate(panels):
        axes = figure.add_subplot(grid[index], projection='3d')
        run, settings = results.runs[name][0], results.case(name).settings
        mission = plan_mission(mission_settings(settings), settings['area'])
        last = run.columns['step'][-1] if until is None else until
        robots = [column[:-2] for column in run.columns if column.endswith('_x')]
        end = None if until is None else until + 1
        paths = {
            robot: np.stack([run.columns[f'{robot}_{axis}'] for axis in 'xyz'], axis=1)[:end]
            for robot in robots
        }
        shots = {shot['cuboid'] for shot in run.details['snapshots'] if shot['step'] <= last}
        plans = None if until is None else run.details['plans'].get(str(until))
        draw_mission(axes, mission, paths, shots, plans)
        axes.set_title(f'{name}, step {last:.0f}', fontsize=9)
        legend(axes)


def draw_batteries_and_ranges(figure: Figure, results: Results) -> None:
    """Draw mission time against the number of agents, and robots that search over time."""
    places = figure.subplots(1, 3)
    for axes, profile in zip(places, (1, 2)):
        for reach in (50, 100, 250):
            points = []
            for agents in (3, 5, 7, 9, 11):
                name = f'profile {profile}, C_R {reach} m, {agents} agents'
                if results.runs.get(name):
                    points.append((agents, interval(results, name, STEPS).mean))
            if points:
                axes.plot(*zip(*points), 'o-', ms=4, label=f'C_R = {reach} m')
        _label(axes, 'agents', 'mission time [s]', f'battery profile {profile}')
        axes.set_ylim(bottom=0.0)
        for agents, line in ((3, '--'), (11, '-')):
            runs = results.runs.get(f'profile {profile}, C_R 50 m, {agents} agents')
            if runs:
                searching = [run.columns['active'] for run in runs]
                table = np.array([*zip_longest(*searching, fillvalue=np.nan)], float)
                label = f'profile {profile}, {agents} agents'
                places[2].plot(np.nanmean(table, axis=1), line, label=label)
    _label(places[2], 'step', 'robots that search')


def draw_visits_over_time(figure: Figure, results: Results) -> None:
    """Draw the share of visited cuboids and the robots that search, over time."""
    left, right = figure.subplots(1, 2)
    for name in results.names():
        runs = results.runs[name]
        length = max(len(run.columns['visited']) for run in runs)
        share = [
            np.pad(run.columns['visited'], (0, length - len(run.columns['visited'])), mode='edge')
            / float(run.summary['cuboids'] or 1)
            for run in runs
        ]
        left.plot(100.0 * np.mean(share, axis=0), label=name)
        right.step(range(len(runs[0].columns['active'])), runs[0].columns['active'])
    _label(left, 'step', 'cuboids visited [%]')
    right.set(xlabel='step', ylabel='robots that search, first map')


def draw_mission_times(figure: Figure, results: Results) -> None:
    """Draw the mission time of each case as a bar, the paper's of 3 agents as lines."""
    axes = figure.subplots()
    names = results.names()
    times = [interval(results, name, STEPS) for name in names]
    places = np.arange(len(names))
    errors = np.nan_to_num([time.half_width for time in times])
    axes.barh(places, [time.mean for time in times], xerr=errors, color='#56B4E9')
    axes.set_yticks(places, names, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    for item in results.experiment.published:
        if item.case.count(',') == 1:
            label = f'paper, {item.case}'
            axes.axvline(item.value, color=_PAPER_COLOUR, lw=0.8, ls='--', label=label)
    _label(axes, 'mission time [s]')


def draw_decision_times(figure: Figure, results: Results) -> None:
    """Draw the time of a decision of both controllers next to the paper's."""
    axes = figure.subplots()
    names = results.names()
    places = np.arange(len(names))
    for offset, quantity in ((-0.2, 'centralized'), (0.2, 'distributed')):
        ours = [float(np.mean(results.values(name, quantity))) for name in names]
        axes.bar(places + offset, ours, 0.35, label=f'{quantity}, ours')
        theirs = results.experiment.published_of(quantity)
        axes.plot(
            places + offset,
            [theirs[name].value if name in theirs else np.nan for name in names],
            '_',
            ms=22,
            color=_PAPER_COLOUR,
            label=f'{quantity}, paper',
        )
    axes.set_yscale('log')
    axes.set_xticks(places, names)
    _label(axes, '', 'mean time of a decision [s]')


def _label(axes: Any, across: str, up: str = '', title: str = '') -> None:
    axes.set(xlabel=across, ylabel=up)
    axes.set_title(title, fontsize=10)
    axes.legend(fontsize=8, frameon=False)
