"""001: exploration-based planning for multiple-target search with real-drone results."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from maasi_sim.experiments import figures
from maasi_sim.experiments.cases import Case, Comparison, Outcome, Quantity
from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.floors import (
    MAMBO_MOTION,
    MAMBO_SENSOR,
    floor,
    floor_filter,
)
from maasi_sim.experiments.printed import printed
from maasi_sim.experiments.searches import (
    FALSE,
    FOUND,
    MEASUREMENTS,
    NEVER_DONE,
    PERFECT_ODOMETRY,
    PLANNING_TIME,
    RMSE,
    TIME,
    add_explored_share,
    merged,
    run_search,
    search_case,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EXPLORED = Quantity('explored', 'share explored in the end')
CLEARANCE = Quantity('clearance', 'smallest distance to an obstacle', 'm')

_LONG, _SHORT = 812, 330
_NOISE = {
    'range': 1.9,
    'bearing': 0.25,
    'elevation': 0.41,
    'as': 'variance',
    'angles': 'degrees',
}
_PAPER_FILTER = {'preset': 'paper_001', 'particles': 5000}
_RECOMMENDED_FILTER = {'method': 'pmb'}
_RING = {'ring': 6, 'distance': 12.0}
_GRID = {'grid': [3, 3, 3], 'spacing': 115.0, 'corner': [10.0, 10.0, 10.0]}
_UNIFORM = {'count': 12, 'distribution': 'uniform'}
_CLUSTERED = {'count': 12, 'distribution': 'clustered', 'clusters': 2}


def cube(
    planner: dict[str, Any],
    candidates: dict[str, Any] | None = None,
    search_filter: dict[str, Any] | None = None,
    targets: dict[str, Any] | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Return the scenario of section 5 with a planner."""
    underway = planner['name'] not in ('as', 'mutual_information')
    return {
        'version': 1,
        'environment': {'bounds': [[0.0, 250.0]] * 3},
        'step': 0.1,
        'targets': targets or _UNIFORM,
        'robots': {
            'drone': {
                'type': 'ranging_drone',
                'start': [0.0, 0.0, 0.0],
                'candidates': candidates or _RING,
                'motion': {'speed': 12.0, 'acceleration': None, 'tolerance': 0.01},
                # Ready at each step where the planner measures on arrival only.
                'sensor': {'period': 1.0 if underway else 0.1, 'noise': _NOISE},
                'odometry': PERFECT_ODOMETRY,
            }
        },
        'filter': search_filter or _PAPER_FILTER,
        'planner': merged(NEVER_DONE, planner),
        'scoring': {'radius': 5.0},
        'limits': {'time': 6000.0},
        **more,
    }


def explorer(refinement: str = 'mutual_information', horizon: int = 1) -> dict[str, Any]:
    """Return the paper's planner, (10)."""
    return {'name': 'as', 'alpha': 5.0, 'refinement': refinement, 'horizon': horizon}


_LAWNMOWER = {'name': 'lawnmower', 'lane_spacing': 48.0, 'layer_spacing': 48.0, 'margin': 12.0}
_RECOMMENDED = {'name': 'asi', 'objective': 'information'}
_OURS = 'MI with exploration'
_STYLES = {
    'lawnmower': 'lawnmower',
    'MI only': 'mutual',
    'Sung and Tokekar': 'sung',
    _OURS: 'asi',
    'ASI, recommended': 'recommended',
}


# pi = 0.98 exp(-|zeta|^2 / 2), which ends at about 75 m.
_SHORT_SIGHT = {'robots': {'drone': {'sensor': {'detection': {'kind': 'gaussian'}}}}}
_SHORT_SIGHTED = ', short pi'


def _methods(targets: dict[str, Any], small: bool) -> list[Case]:
    def case(name: str, values: dict[str, Any], preset: str = 'paper') -> Case:
        return search_case(name, merged(values, {'targets': targets}), _LONG, preset, small)

    def short(name: str, values: dict[str, Any]) -> Case:
        return case(name + _SHORT_SIGHTED, merged(values, _SHORT_SIGHT))

    return [
        case('lawnmower', cube(_LAWNMOWER)),
        case('MI only', cube({'name': 'mutual_information'})),
        case('Sung and Tokekar', cube({'name': 'nearest_widest'}, _GRID)),
        case(_OURS, cube(explorer())),
        case(f'{_OURS}, alpha 0.5', cube({**explorer(), 'alpha': 0.5})),
        short('MI only', cube({'name': 'mutual_information'})),
        short('Sung and Tokekar', cube({'name': 'nearest_widest'}, _GRID)),
        short(_OURS, cube(explorer())),
        case(
            'ASI, recommended',
            cube(_RECOMMENDED, _GRID, _RECOMMENDED_FILTER),
            'recommended',
        ),
    ]


def _horizon_name(horizon: int) -> str:
    return f'horizon {horizon}'


def _e1() -> Experiment:
    names = [_horizon_name(horizon) for horizon in (1, 2, 3)]

    def cases(small: bool) -> list[Case]:
        return [
            search_case(name, cube(explorer(horizon=index + 1)), _SHORT, small=small)
            for index, name in enumerate(names)
        ]

    def draw(figure: Figure, results: Results) -> None:
        figures.curves(figure.add_subplot(), results, dict.fromkeys(names, ''))

    return Experiment(
        name='001-e1',
        title='Planning 1, 2 or 3 waypoints ahead',
        cases=cases,
        run=run_search,
        quantities=(FOUND, FALSE, MEASUREMENTS, PLANNING_TIME),
        draw=draw,
        comparisons=tuple(
            Comparison(name, names[0], quantity.name)
            for name in names[1:]
            for quantity in (FOUND, MEASUREMENTS)
        ),
        seconds=3.0,
        maps='001, uniform',
        **printed('001-e1'),
    )


def _comparison_of(number: int) -> Experiment:
    clustered = number == 3
    targets = _CLUSTERED if clustered else _UNIFORM

    def draw(figure: Figure, results: Results) -> None:
        figures.curves_and_path(figure, results, _STYLES, _OURS)

    return Experiment(
        name=f'001-e{number}',
        title='12 targets in 2 clusters: exploration against three other methods'
        if clustered
        else '12 uniform targets: exploration against three other methods',
        cases=lambda small: _methods(targets, small),
        run=run_search,
        quantities=(MEASUREMENTS, TIME, FOUND, FALSE, RMSE, PLANNING_TIME),
        draw=draw,
        comparisons=(
            *(
                Comparison(_OURS, other, quantity.name)
                for other in ('lawnmower', 'Sung and Tokekar', 'MI only')
                for quantity in (MEASUREMENTS, TIME)
            ),
            *(
                Comparison(_OURS + _SHORT_SIGHTED, other + _SHORT_SIGHTED, MEASUREMENTS.name)
                for other in ('Sung and Tokekar', 'MI only')
            ),
            Comparison(f'{_OURS}, alpha 0.5', 'MI only', MEASUREMENTS.name),
            Comparison('ASI, recommended', _OURS, MEASUREMENTS.name),
        ),
        seconds=3.0,
        maps='001, clustered' if clustered else '001, uniform',
        **printed(f'001-e{number}'),
    )


_RADII = tuple(round(0.5 + 0.1 * index, 1) for index in range(20))


def _radius_name(radius: float) -> str:
    return f'T_r = {radius:.1f} m'


def _e4() -> Experiment:
    def cases(small: bool) -> list[Case]:
        return [
            search_case(
                _radius_name(radius),
                cube(explorer(), search_filter={**_PAPER_FILTER, 'found_radius': radius}),
                _LONG,
                small=small,
            )
            for radius in ((0.5, 2.4) if small else _RADII)
        ]

    def draw(figure: Figure, results: Results) -> None:
        names = {_radius_name(radius): radius for radius in _RADII}
        figures.against(figure, results, names, 'T_r [m]', (RMSE, MEASUREMENTS))

    return Experiment(
        name='001-e4',
        title='Threshold of the cluster radius against accuracy and steps',
        cases=cases,
        run=run_search,
        quantities=(RMSE, MEASUREMENTS, FALSE),
        draw=draw,
        comparisons=(
            Comparison(_radius_name(2.4), _radius_name(0.5), RMSE.name),
            Comparison(_radius_name(2.4), _radius_name(0.5), MEASUREMENTS.name),
        ),
        seconds=3.0,
        maps='001, uniform',
        **printed('001-e4'),
    )


def _e5() -> Experiment:
    names = {_OURS: 'mutual_information', 'centre probabilities with exploration': 'centres'}
    centres = 'centre probabilities with exploration'

    def cases(small: bool) -> list[Case]:
        return [
            search_case(name, cube(explorer(refinement)), _SHORT, small=small)
            for name, refinement in names.items()
        ]

    def draw(figure: Figure, results: Results) -> None:
        figures.curves(figure.add_subplot(), results, {_OURS: 'asi', centres: 'event'})

    return Experiment(
        name='001-e5',
        title='Target refinement by mutual information and by centre probabilities',
        cases=cases,
        run=run_search,
        quantities=(FOUND, FALSE, MEASUREMENTS, PLANNING_TIME),
        draw=draw,
        comparisons=(
            Comparison(centres, _OURS, FOUND.name),
            Comparison(centres, _OURS, MEASUREMENTS.name),
        ),
        seconds=2.0,
        maps='001, uniform',
        **printed('001-e5'),
    )


def _run_exploring(settings: dict[str, Any], seed: int) -> Outcome:
    return add_explored_share(settings, run_search(settings, seed))


def _e6() -> Experiment:
    def cases(small: bool) -> list[Case]:
        nothing = {'targets': {'count': 0}, 'stop': 'planner_done'}
        methods = {
            _OURS: cube(explorer()),
            'lawnmower': cube(_LAWNMOWER),
            'ASI, recommended': cube(_RECOMMENDED, _GRID, _RECOMMENDED_FILTER),
        }
        return [
            search_case(
                name,
                merged(values, nothing),
                600,
                'recommended' if name.endswith('recommended') else 'paper',
                small,
            )
            for name, values in methods.items()
        ]

    def draw(figure: Figure, results: Results) -> None:
        figures.paths(figure, results, (_OURS, 'lawnmower', 'ASI, recommended'))

    return Experiment(
        name='001-e6',
        title='The way through the cube where there is no target',
        cases=cases,
        run=_run_exploring,
        quantities=(EXPLORED, FALSE),
        draw=draw,
        runs=1,
        seconds=3.0,
        maps='001, uniform',
        **printed('001-e6'),
    )


_OBSTACLES = [
    {'centre': [60.0, 60.0, 60.0], 'radius': 22.0},
    {'centre': [180.0, 70.0, 120.0], 'radius': 28.0},
    {'centre': [120.0, 180.0, 80.0], 'radius': 18.0},
    {'centre': [70.0, 170.0, 190.0], 'radius': 25.0},
    {'centre': [195.0, 190.0, 185.0], 'radius': 15.0},
]


def _with_term(kind: str) -> dict[str, Any]:
    # The term acts on a flying robot's inputs, so that it has to be one.
    motion = {
        'model': 'mambo',
        'speed': 4.0,
        'acceleration': None,
        'tolerance': 1.0,
        'obstacle_term': kind,
        'obstacle_distance': 11.0,
        'obstacle_gain': 0.09,
    }
    return {'robots': {'drone': {'motion': motion}}}


def _run_among_obstacles(settings: dict[str, Any], seed: int) -> Outcome:
    outcome = run_search(settings, seed)
    scenario = settings['scenario']
    start = np.asarray(scenario['robots']['drone']['start'], float)
    places = np.stack([np.asarray(outcome.columns[f'drone_{axis}']) for axis in 'xyz'], axis=1)
    places = np.vstack([start, places])
    # Straight from one measurement to the next.
    share = np.linspace(0.0, 1.0, 25)[:, None, None]
    way = (places[:-1] + share * np.diff(places, axis=0)).reshape(-1, 3)
    nearest = [
        float(np.sqrt(((way - item['centre']) ** 2).sum(axis=1)).min()) - item['radius']
        for item in scenario['environment']['obstacles']
    ]
    outcome.summary['clearance'] = min(nearest) if nearest else None
    return outcome


def _e7() -> Experiment:
    obstacles = {'environment': {'bounds': [[0.0, 250.0]] * 3, 'obstacles': _OBSTACLES}}

    def cases(small: bool) -> list[Case]:
        values = cube(explorer())
        around = merged(values, obstacles)
        listed = {
            'no obstacles': values,
            'steered around': around,
            'term (15), outwards': merged(around, _with_term('away')),
            'term (15), as printed': merged(around, _with_term('printed')),
        }
        return [search_case(name, content, _LONG, small=small) for name, content in listed.items()]

    def draw(figure: Figure, results: Results) -> None:
        figures.paths(figure, results, tuple(case.name for case in results.cases))

    return Experiment(
        name='001-e7',
        title='Search among obstacles',
        cases=cases,
        run=_run_among_obstacles,
        quantities=(MEASUREMENTS, FOUND, CLEARANCE),
        draw=draw,
        comparisons=(
            Comparison('steered around', 'no obstacles', MEASUREMENTS.name),
            Comparison('term (15), outwards', 'no obstacles', MEASUREMENTS.name),
        ),
        seconds=5.0,
        maps='001, obstacles',
        **printed('001-e7'),
    )


def _fig14_cases(small: bool) -> list[Case]:
    bounds = [[-0.3, 2.0], [-0.3, 2.0]]
    ring = {'ring': 8, 'distance': 0.2}
    fine = {'grid': [7, 7], 'spacing': 0.32}

    def case(
        name: str, planner: dict[str, Any], candidates: dict[str, Any], preset: str = 'paper'
    ) -> Case:
        robots = {
            'mambo': {
                'type': 'mambo',
                'start': [0.0, 0.0, 1.0],
                'candidates': candidates,
                'motion': MAMBO_MOTION,
                'sensor': MAMBO_SENSOR,
            }
        }
        search_filter = (
            floor_filter('paper_001', particles=5000, found_radius=0.1, removal_distance=0.3)
            if preset == 'paper'
            else _RECOMMENDED_FILTER
        )
        return search_case(name, floor(bounds, robots, planner, search_filter), 400, preset, small)

    return [
        case('lawnmower', {'name': 'lawnmower', 'lane_spacing': 0.2, 'margin': 0.1}, ring),
        case('MI only', {'name': 'mutual_information'}, ring),
        case(_OURS, explorer(), ring),
        case('ASI, recommended', _RECOMMENDED, fine, 'recommended'),
    ]


def _fig14() -> Experiment:
    def draw(figure: Figure, results: Results) -> None:
        figures.curves_and_path(figure, results, _STYLES, _OURS)

    return Experiment(
        name='001-fig14',
        title='A Mambo over a floor with 12 markers, 0.2 m at a time (simulated hardware)',
        cases=_fig14_cases,
        run=run_search,
        quantities=(MEASUREMENTS, FOUND, FALSE, RMSE),
        draw=draw,
        comparisons=(
            Comparison(_OURS, 'lawnmower', FOUND.name),
            Comparison(_OURS, 'MI only', FOUND.name),
            Comparison('ASI, recommended', _OURS, MEASUREMENTS.name),
        ),
        seconds=4.0,
        **printed('001-fig14'),
    )


def experiments() -> list[Experiment]:
    """Return the experiments of 001."""
    return [
        _e1(),
        _comparison_of(2),
        _comparison_of(3),
        _e4(),
        _e5(),
        _e6(),
        _e7(),
        _fig14(),
    ]
