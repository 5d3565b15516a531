"""004: distributed search planning in 3D with a dynamically varying number of agents."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from maasi_planner.buildings import (
    CuboidSettings,
    DynamicsSettings,
    HazardSettings,
    Mission,
    plan_mission,
)
from maasi_sim.buildings.mission import CuboidMission, SearchRobot, summary
from maasi_sim.buildings.picture import draw_mission, legend
from maasi_sim.experiments.cases import Case, Choice, Comparison, Outcome, Published, Quantity
from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.results import Run
from maasi_sim.experiments.statistics import array, mean_interval

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LIMIT = 1000
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
_FOR_EVER = 1e9

STEPS = Quantity('steps', 'time until all cuboids are visited', 's', 'restricted')
CUBOIDS = Quantity('cuboids', 'cuboids')
COVERAGE = Quantity('coverage', 'share of the faces that is seen')
COMPLETE = Quantity('complete', 'missions with all cuboids visited')
COLLISIONS = Quantity('collisions', 'steps on which an object was cut')
LEAST = Quantity('least_detection_probability', 'least p_d of a snapshot')
ACTIVE = Quantity('active', 'robots that search, mean over the steps')
RECHARGES = Quantity('recharges', 'batteries that failed')
SOLVE = Quantity('solve_mean', 'time of a decision', 's')

PAPER, OURS = 'as printed', 'recommended settings'
_PRINTED: dict[str, Any] = {'discount': 1.0, 'assignment': 'printed'}
_OURS: dict[str, Any] = {'discount': 0.95, 'assignment': 'predicted'}

CHOICES = (
    Choice(
        'size of a cuboid',
        'cubes of 10 m',
        'The paper does not say. With 5 m a single robot takes far longer than its 75 steps.',
    ),
    Choice(
        'cells of a face',
        'round(L / r)',
        '36, 16 and 4 cuboids only come out so; ceil gives 64, 36 and 16. Strips of the faces stay '
        'unseen then; coverage says how much, and "strict" sees all.',
    ),
    Choice('centre of the objects', '(175, 130), and (175, 320) for the second', 'From 004, VI-B.'),
    Choice(
        'p_b of (3)',
        'a hazard per step since the last recharge, in (11) to (13) too',
        'As a probability that the battery has failed by t it would be drawn once, not each step.',
    ),
    Choice(
        'condition of (13)',
        'p_b(t + T) at most 0.5',
        'As printed, robots with good batteries would never plan what another one plans, and drop '
        'and take up the same cuboid together.',
    ),
    Choice(
        'reward of a visit',
        'both: as printed, and discounted by 0.95 a step, more where it is put off',
        'As printed a visit is worth the same whenever it comes, and is put off while smoother '
        'flight pays: for ever, in some missions.',
    ),
    Choice(
        'distances of the assignment (10)',
        'both: from where robots are, as printed, and from where their plans have them at tau* + 1',
        'A robot alone is drawn to the cuboid nearest to the latter. From where they are, robots '
        'are held back by cuboids that they are about to visit anyway.',
    ),
    Choice(
        'where visits count',
        '1 mm inside the cuboid in plans',
        'An optimum touches the faces; rounding would decide whether it was a visit.',
    ),
    Choice(
        'obstacles and the end of the horizon',
        'kept away from between samples, and with room to brake',
        'As printed (15k) lets robots cut corners, and the next problem may have no solution.',
    ),
)


def _mission_settings(settings: dict[str, Any]) -> CuboidSettings:
    return CuboidSettings.model_validate({'time_limit': _FOR_EVER, **settings['mission']})


def _mission_of(run: Run, results: Results) -> Mission:
    settings = results.case(run.case).settings
    return plan_mission(_mission_settings(settings), settings['area'])


def _robots(settings: dict[str, Any], seed: int) -> dict[str, SearchRobot]:
    """Return the robots of a case: at given places, or at random ones outside of objects."""
    rng = np.random.default_rng(seed)
    hazard = {'failures': False, **settings.get('hazard', {})}
    dynamics = DynamicsSettings.model_validate(settings.get('dynamics', {}))
    starts = settings.get('starts')
    if starts is None:
        box = np.array(settings.get('spawn', settings['area']), dtype=float)
        mission = plan_mission(_mission_settings(settings), settings['area'])
        starts = {}
        while len(starts) < settings['agents']:
            place = rng.uniform(box[:, 0], box[:, 1])
            # A robot needs some air around it.
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
        _mission_settings(settings),
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
                {
                    'cuboid': shot.cuboid,
                    'robot': shot.robot,
                    'step': shot.step,
                    'distance': shot.distance,
                    'detection_probability': shot.detection_probability,
                }
                for shot in record.snapshots
            ],
            'plans': {
                str(step): {name: plan.tolist() for name, plan in plans.items()}
                for step, plans in record.plans.items()
            },
        },
        {'solve_mean': float(record.solve_times.mean()) if len(record.solve_times) else 0.0},
    )


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

CENTRALIZED = Quantity('centralized', 'time of a joint decision, P1', 's')
DISTRIBUTED = Quantity('distributed', 'time of a decision of one robot, P2', 's')
_STEPS_TIMED = 8


def run_timing(settings: dict[str, Any], seed: int) -> Outcome:
    """Time the decisions of both controllers at the first steps of a mission."""
    spent = {}
    visited = {}
    for scheme in ('centralized', 'distributed'):
        mission = CuboidMission(
            _mission_settings(settings),
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


_TABLE = {
    (3, 3): (0.8969, 0.0022),
    (5, 3): (2.1220, 0.0025),
    (3, 7): (11.5956, 0.0756),
    (5, 7): (56.3984, 0.0787),
}


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
            published=(
                Published(PAPER, 'steps', 75.0, runs=1, note='VI-A'),
                Published(OURS, 'steps', 75.0, runs=1, note='VI-A'),
                Published(PAPER, 'cuboids', 36.0, runs=1, note='VI-A'),
                Published('p_d = 0.88', 'cuboids', 16.0, runs=1, note='VI-A'),
                Published('p_d = 0.53', 'cuboids', 4.0, runs=1, note='VI-A'),
            ),
            choices=CHOICES,
            runs=1,
            note='At p_d = 1 the cuboids stand at d_min: in their nearer half p_d is 0 by (4). '
            'The paper counts every visit; the report gives p_d of each snapshot.',
        ),
        Experiment(
            '004-fig4',
            'Four robots and two buildings',
            _cases_4,
            run_mission,
            (*common, LEAST, SOLVE),
            _draw_missions,
            published=(
                Published(PAPER, 'steps', 48.0, runs=1, note='VI-B, one run'),
                Published(OURS, 'steps', 48.0, runs=1, note='VI-B, one run'),
            ),
            comparisons=(Comparison(PAPER, OURS, 'steps'),),
            choices=CHOICES,
            runs=20,
        ),
        Experiment(
            '004-fig5',
            'Two robots and one building between two obstacles',
            _cases_5,
            run_mission,
            (*common, LEAST, SOLVE),
            _draw_missions,
            choices=(
                *CHOICES,
                Choice(
                    'places and widths of object and obstacles',
                    'object at (285, 215), walls of 20 m by 120 m at x = 170 and 400',
                    'Only their heights are given; these leave a gap as in the picture.',
                ),
            ),
            runs=5,
        ),
        Experiment(
            '004-fig6',
            'Mission time by number of agents, range of communication and battery',
            _cases_6,
            run_mission,
            (*common, ACTIVE, RECHARGES, SOLVE),
            _draw_6,
            choices=CHOICES,
            runs=50,
            note='The paper gives curves without numbers.',
        ),
        Experiment(
            '004-fig7',
            'Cuboids visited and robots that search, over time, with failing batteries',
            _cases_7,
            run_mission,
            (*common, ACTIVE, RECHARGES, SOLVE),
            _draw_7,
            choices=CHOICES,
            runs=10,
            note='The paper shows one run of each; these are means.',
        ),
        Experiment(
            '004-fig8',
            'Distributed, sequential and centralized planning',
            _cases_8,
            run_mission,
            (*common, SOLVE),
            _draw_8,
            published=(
                Published('distributed, 3 agents', 'steps', 24.4, runs=50, note='VI-B'),
                Published('distributed, 3 agents, as printed', 'steps', 24.4, runs=50, note='VI-B'),
                Published('sequential, 3 agents', 'steps', 21.8, runs=50, note='VI-B'),
                Published('centralized, 3 agents', 'steps', 20.9, runs=50, note='VI-B'),
            ),
            comparisons=tuple(
                Comparison('distributed, 3 agents', f'{scheme}, 3 agents', 'steps')
                for scheme in _SCHEMES[1:]
            ),
            choices=(
                *CHOICES,
                Choice(
                    'where robots begin',
                    'anywhere in the area, at rest, outside of the object',
                    'Uniformly, says the paper; heights are part of the area.',
                ),
            ),
            causes='Climbing: 35 N lift 3.35 kg by 0.64 m/s^2 at most, and air resistance '
            'ends that at 3.2 m/s. Without gravity, or with 70 N, the same planner comes out at '
            "the paper's times. As printed, the distances of the assignment cost more than that.",
            runs=50,
        ),
        Experiment(
            '004-table1',
            'Time of a decision, centralized and distributed',
            _cases_table,
            run_timing,
            (CENTRALIZED, DISTRIBUTED, CUBOIDS),
            _draw_table,
            published=tuple(
                Published(_name_table(*key), quantity, value, runs=20, note='Table I')
                for key, values in _TABLE.items()
                for quantity, value in zip(('centralized', 'distributed'), values)
            ),
            choices=(
                *CHOICES,
                Choice(
                    'what a time is the mean of',
                    f'the first {_STEPS_TIMED} decisions of a mission',
                    'The paper does not say at which step it was taken. Theirs: Gurobi 9 on a dual '
                    'core of 3.5 GHz.',
                ),
            ),
            runs=20,
        ),
    ]
