"""004: distributed search planning in 3D with a dynamically varying number of agents."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from maasi_planner.buildings import (
    Mission,
    plan_mission,
)
from maasi_sim.buildings.picture import draw_mission, legend
from maasi_sim.experiments.building_runs import (
    ACTIVE,
    CENTRALIZED,
    COLLISIONS,
    COMPLETE,
    COVERAGE,
    CUBOIDS,
    DISTRIBUTED,
    LEAST,
    RECHARGES,
    SOLVE,
    STEPS,
    mission_settings,
    run_mission,
    run_timing,
)
from maasi_sim.experiments.cases import Case, Comparison
from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.printed import printed
from maasi_sim.experiments.results import Run
from maasi_sim.experiments.statistics import array, mean_interval

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIZE = [60.0, 60.0, 60.0]
_BUILDING = {'centre': [175.0, 130.0], 'size': _SIZE}
_TWO = [_BUILDING, {'centre': [175.0, 320.0], 'size': _SIZE}]
_AREA_3 = [[0.0, 300.0], [0.0, 300.0], [0.0, 80.0]]
_AREA_4 = [[0.0, 250.0], [0.0, 400.0], [0.0, 80.0]]
_AREA_5 = [[0.0, 500.0], [0.0, 400.0], [0.0, 80.0]]
_AREA_6 = [[0.0, 400.0], [0.0, 400.0], [0.0, 80.0]]
_STARTS_4 = {
    'purple': [166.0, 235.0, 5.0],
    'red': [185.0, 235.0, 5.0],
    'green': [165.0, 215.0, 5.0],
    'blue': [185.0, 215.0, 5.0],
}
_OBJECT_5 = {'centre': [285.0, 215.0], 'size': _SIZE}
_OBSTACLES_5 = [
    {'centre': [170.0, 215.0], 'size': [20.0, 120.0, 80.0]},
    {'centre': [400.0, 215.0], 'size': [20.0, 120.0, 30.0]},
]

PAPER, OURS = 'as printed', 'recommended settings'
_PRINTED: dict[str, Any] = {'discount': 1.0, 'assignment': 'printed'}
_OURS: dict[str, Any] = {'discount': 0.95, 'assignment': 'predicted'}


def _mission_of(run: Run, results: Results) -> Mission:
    settings = results.case(run.case).settings
    return plan_mission(mission_settings(settings), settings['area'])


def _paths(run: Run, until: int | None = None) -> dict[str, np.ndarray]:
    names = [name[:-2] for name in run.columns if name.endswith('_x')]
    end = None if until is None else until + 1
    return {
        name: np.stack([run.columns[f'{name}_{axis}'] for axis in 'xyz'], axis=1)[:end]
        for name in names
    }


def _draw_run(figure: Figure, place: Any, run: Run, results: Results, step: int | None) -> None:
    axes = figure.add_subplot(place, projection='3d')
    shots = [s for s in run.details['snapshots'] if step is None or s['step'] <= step]
    plans = None if step is None else run.details['plans'].get(str(step))
    draw_mission(
        axes, _mission_of(run, results), _paths(run, step), {s['cuboid'] for s in shots}, plans
    )
    when = run.columns['step'][-1] if step is None else step
    axes.set_title(f'{run.case}, step {when:.0f}', fontsize=9)
    legend(axes)


def _both(settings: dict[str, Any], small: bool, runs: int | None = None) -> list[Case]:
    """Return a case with the objective as printed, and one as we would have it."""
    cases = []
    for name, change, preset in ((PAPER, _PRINTED, 'paper'), (OURS, _OURS, 'recommended')):
        mission = {**settings['mission'], **change}
        if small:
            mission['horizon'] = 6
        cases.append(
            Case(name, {**settings, 'mission': mission}, preset, runs)  # type: ignore[arg-type]
        )
    return cases


# ---- figure 3 --------------------------------------------------------------------------------


def _cases_3(small: bool) -> list[Case]:
    single = {
        'mission': {'objects': [_BUILDING], 'detection_probability': 0.53 if small else 1.0},
        'area': _AREA_3,
        'starts': {'red': [160.0, 200.0, 5.0]},
        'keep': [11],
    }
    cases = _both(single, small, 1)
    if small:
        return cases
    for probability in (0.88, 0.53):
        mission = {'objects': [_BUILDING], 'detection_probability': probability}
        name = f'p_d = {probability}'
        cases.append(Case(name, {**single, 'mission': mission}, 'recommended', 1))
    return cases


def _draw_3(figure: Figure, results: Results) -> None:
    names = results.names()
    grid = figure.add_gridspec(1, 2)
    run = results.runs[OURS if OURS in names else names[0]][0]
    _draw_run(figure, grid[0], run, results, 11)
    _draw_run(figure, grid[1], run, results, None)


# ---- figures 4 and 5 -------------------------------------------------------------------------


def _cases_4(small: bool) -> list[Case]:
    return _both(
        {
            'mission': {'objects': _TWO, 'detection_probability': 0.53 if small else 0.88},
            'area': _AREA_4,
            'starts': _STARTS_4,
            'hazard': {'failures': True, 'alpha': 100.0},
        },
        small,
    )


def _cases_5(small: bool) -> list[Case]:
    return _both(
        {
            'mission': {
                'objects': [_OBJECT_5],
                'obstacles': _OBSTACLES_5,
                'detection_probability': 0.53 if small else 0.88,
            },
            'area': _AREA_5,
            'starts': {'red': [85.0, 215.0, 5.0], 'blue': [485.0, 215.0, 5.0]},
            'hazard': {'failures': True, 'alpha': 100.0},
        },
        small,
    )


def _draw_missions(figure: Figure, results: Results) -> None:
    names = results.names()
    grid = figure.add_gridspec(1, len(names))
    for index, name in enumerate(names):
        _draw_run(figure, grid[index], results.runs[name][0], results, None)


# ---- figure 6 --------------------------------------------------------------------------------

_PROFILES = {1: [20.0, 40.0], 2: [70.0, 90.0]}


def _name_6(profile: int, reach: int, agents: int) -> str:
    return f'profile {profile}, C_R {reach} m, {agents} agents'


def _cases_6(small: bool) -> list[Case]:
    sizes = (3,) if small else (3, 5, 7, 9, 11)
    ranges = (50, 250) if small else (50, 100, 250)
    cases = []
    for profile, alphas in _PROFILES.items():
        for reach in ranges:
            for agents in sizes:
                mission: dict[str, Any] = {
                    'objects': _TWO,
                    'detection_probability': 0.53 if small else 0.88,
                    'communication_range': float(reach),
                }
                if small:
                    mission['horizon'] = 5
                settings = {
                    'mission': mission,
                    'area': _AREA_6,
                    'agents': agents,
                    'alpha_range': alphas,
                    'hazard': {'failures': True, 'beta': 0.3, 'recharge_steps': [5, 10]},
                }
                cases.append(Case(_name_6(profile, reach, agents), settings, 'recommended'))
    return cases


def _draw_6(figure: Figure, results: Results) -> None:
    places = figure.subplots(1, 3)
    names = results.names()
    for axes, profile in zip(places, _PROFILES):
        for reach in (50, 100, 250):
            points = []
            for agents in (3, 5, 7, 9, 11):
                name = _name_6(profile, reach, agents)
                if name in names:
                    limits = [run.value('limit') or 0.0 for run in results.runs[name]]
                    values = results.values(name, 'steps')
                    times = [v if v is not None else m for v, m in zip(values, limits)]
                    points.append((agents, float(np.mean(times))))
            if points:
                axes.plot(*zip(*points), 'o-', ms=4, label=f'C_R = {reach} m')
        axes.set_title(f'battery profile {profile}', fontsize=10)
        axes.set_xlabel('agents')
        axes.set_ylabel('mission time [s]')
        axes.set_ylim(bottom=0.0)
        axes.legend(fontsize=8, frameon=False)
    for profile in _PROFILES:
        for agents, line in ((3, '--'), (11, '-')):
            runs = results.runs.get(_name_6(profile, 50, agents), [])
            if runs:
                _plot_mean(places[2], runs, 'active', line, f'profile {profile}, {agents} agents')
    places[2].set_xlabel('step')
    places[2].set_ylabel('robots that search')
    places[2].legend(fontsize=8, frameon=False)


def _plot_mean(axes: Any, runs: list[Run], column: str, line: str, label: str) -> None:
    """Draw the mean of a column over the runs, each held at its last value."""
    length = max(len(run.columns[column]) for run in runs)
    table = np.array(
        [
            np.concatenate(
                [run.columns[column], np.full(length - len(run.columns[column]), np.nan)]
            )
            for run in runs
        ]
    )
    with np.errstate(all='ignore'):
        axes.plot(np.nanmean(table, axis=0), line, label=label)


# ---- figure 7 --------------------------------------------------------------------------------

_CONFIGURATIONS_7 = ((50.0, 10.0), (50.0, 20.0), (250.0, 10.0), (250.0, 20.0))


def _cases_7(small: bool) -> list[Case]:
    cases = []
    for reach, alpha in _CONFIGURATIONS_7[1::2] if small else _CONFIGURATIONS_7:
        mission: dict[str, Any] = {
            'objects': _TWO,
            'detection_probability': 0.88,
            'communication_range': reach,
        }
        if small:
            mission['horizon'] = 5
        settings = {
            'mission': mission,
            'area': _AREA_4,
            'starts': _STARTS_4,
            'hazard': {'failures': True, 'alpha': alpha, 'beta': 0.3, 'recharge_steps': [1, 5]},
        }
        cases.append(Case(f'C_R {reach:.0f} m, alpha_1 {alpha:.0f}', settings, 'recommended'))
    return cases


def _draw_7(figure: Figure, results: Results) -> None:
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
        right.step(range(len(runs[0].columns['active'])), runs[0].columns['active'], label=name)
    left.set_xlabel('step')
    left.set_ylabel('cuboids visited [%]')
    left.legend(fontsize=8, frameon=False)
    right.set_xlabel('step')
    right.set_ylabel('robots that search, first map')


# ---- figure 8 --------------------------------------------------------------------------------

_SCHEMES = ('distributed', 'sequential', 'centralized')


def _cases_8(small: bool) -> list[Case]:
    cases = []
    base: dict[str, Any] = {
        'mission': {
            'objects': [_BUILDING],
            'detection_probability': 0.53 if small else 0.88,
            'communication_range': 430.0,
            'alpha': 1.5,
            'beta': 1.0,
        },
        'area': _AREA_3,
        'hazard': {'failures': False},
    }
    if small:
        base['mission']['horizon'] = 5
    for agents in (3,) if small else (3, 5):
        for scheme in _SCHEMES:
            settings = {**base, 'agents': agents, 'scheme': scheme}
            cases.append(Case(f'{scheme}, {agents} agents', settings, 'recommended'))
    for name, change in (
        ('as printed', _PRINTED),
        ('assignment as printed', {**_OURS, 'assignment': 'printed'}),
    ):
        mission = {**base['mission'], **change}
        settings = {**base, 'mission': mission, 'agents': 3}
        cases.append(Case(f'distributed, 3 agents, {name}', settings, 'paper'))
    # What would have to be otherwise for the paper's times.
    for name, key, value in (('no gravity', 'gravity', 0.0), ('70 N', 'force', 70.0)):
        for scheme in ('distributed', 'centralized'):
            settings = {**base, 'agents': 3, 'scheme': scheme, 'dynamics': {key: value}}
            cases.append(Case(f'{scheme}, 3 agents, {name}', settings, 'recommended'))
    return cases


def _draw_8(figure: Figure, results: Results) -> None:
    axes = figure.subplots()
    names = results.names()
    times = [
        mean_interval([value or np.nan for value in results.values(name, 'steps')])
        for name in names
    ]
    places = np.arange(len(names))
    errors = [0.0 if np.isnan(t.half_width) else t.half_width for t in times]
    axes.barh(places, [t.mean for t in times], xerr=errors, color='#56B4E9')
    axes.set_yticks(places, names, fontsize=8)
    axes.invert_yaxis()
    for value, scheme in ((24.4, 'distributed'), (21.8, 'sequential'), (20.9, 'centralized')):
        axes.axvline(value, color='#D62728', lw=0.8, ls='--', label=f'paper, 3 agents, {scheme}')
    axes.set_xlabel('mission time [s]')
    axes.legend(fontsize=7, frameon=False)


# ---- table I ---------------------------------------------------------------------------------


def _name_table(agents: int, horizon: int) -> str:
    return f'{agents} agents, T = {horizon}'


def _cases_table(small: bool) -> list[Case]:
    cases = []
    for agents in (3,) if small else (3, 5):
        for horizon in (3,) if small else (3, 7):
            settings = {
                'mission': {
                    'objects': _TWO,
                    'detection_probability': 0.88,
                    'horizon': horizon,
                    'guidance_step': min(3, horizon - 1),
                    'discount': 1.0,
                    'communication_range': 100.0,
                },
                'area': _AREA_4,
                'agents': agents,
                'spawn': [[165.0, 185.0], [215.0, 235.0], [5.0, 5.0]],
            }
            cases.append(Case(_name_table(agents, horizon), settings, 'paper'))
    return cases


def _draw_table(figure: Figure, results: Results) -> None:
    axes = figure.subplots()
    names = results.names()
    places = np.arange(len(names))
    for offset, quantity in ((-0.2, 'centralized'), (0.2, 'distributed')):
        ours = [float(np.mean(array(results.values(name, quantity)))) for name in names]
        axes.bar(places + offset, ours, 0.35, label=f'{quantity}, ours')
        theirs = {p.case: p.value for p in results.experiment.published if p.quantity == quantity}
        axes.plot(
            places + offset,
            [theirs.get(name, np.nan) for name in names],
            '_',
            ms=22,
            color='#D62728',
            label=f'{quantity}, paper',
        )
    axes.set_yscale('log')
    axes.set_xticks(places, names)
    axes.set_ylabel('mean time of a decision [s]')
    axes.legend(fontsize=8, frameon=False)


def experiments() -> list[Experiment]:
    """Return the experiments of 004."""
    common = (STEPS, COMPLETE, COLLISIONS, CUBOIDS)
    return [
        Experiment(
            '004-fig3',
            'One robot around one building: cuboids by probability, and its spiral',
            _cases_3,
            run_mission,
            (STEPS, CUBOIDS, COVERAGE, COMPLETE, COLLISIONS, LEAST, SOLVE),
            _draw_3,
            runs=1,
            **printed('004-fig3'),
        ),
        Experiment(
            '004-fig4',
            'Four robots and two buildings',
            _cases_4,
            run_mission,
            (*common, LEAST, SOLVE),
            _draw_missions,
            comparisons=(Comparison(PAPER, OURS, 'steps'),),
            runs=20,
            **printed('004-fig4'),
        ),
        Experiment(
            '004-fig5',
            'Two robots and one building between two obstacles',
            _cases_5,
            run_mission,
            (*common, LEAST, SOLVE),
            _draw_missions,
            runs=5,
            **printed('004-fig5'),
        ),
        Experiment(
            '004-fig6',
            'Mission time by number of agents, range of communication and battery',
            _cases_6,
            run_mission,
            (*common, ACTIVE, RECHARGES, SOLVE),
            _draw_6,
            runs=50,
            **printed('004-fig6'),
        ),
        Experiment(
            '004-fig7',
            'Cuboids visited and robots that search, over time, with failing batteries',
            _cases_7,
            run_mission,
            (*common, ACTIVE, RECHARGES, SOLVE),
            _draw_7,
            runs=10,
            **printed('004-fig7'),
        ),
        Experiment(
            '004-fig8',
            'Distributed, sequential and centralized planning',
            _cases_8,
            run_mission,
            (*common, SOLVE),
            _draw_8,
            comparisons=tuple(
                Comparison('distributed, 3 agents', f'{scheme}, 3 agents', 'steps')
                for scheme in _SCHEMES[1:]
            ),
            runs=50,
            **printed('004-fig8'),
        ),
        Experiment(
            '004-table1',
            'Time of a decision, centralized and distributed',
            _cases_table,
            run_timing,
            (CENTRALIZED, DISTRIBUTED, CUBOIDS),
            _draw_table,
            runs=20,
            **printed('004-table1'),
        ),
    ]
