"""000: multi-agent active multi-target search with intermittent measurements."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from maasi_sim.experiments import figures, paper_000_floor
from maasi_sim.experiments.cases import Case, Comparison
from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.printed import printed
from maasi_sim.experiments.searches import (
    FALSE,
    FILTER_TIME,
    FOUND,
    MEASUREMENTS,
    NEVER_DONE,
    PERFECT_ODOMETRY,
    PLANNING_TIME,
    RMSE,
    STEP_TIME,
    TAKEN,
    TIME,
    merged,
    run_search,
    search_case,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Long enough for the lawnmower to cover the cube.
_CAP = 900
_PARTICLES = (2000, 4000, 6000, 8000, 10000, 15000, 20000)
_WEIGHTS = (0.05, 0.5, 0.75, 2.5, 5.0)


_DEGREES = {
    'range': 1.5,
    'bearing': 0.175,
    'elevation': 0.295,
    'as': 'variance',
    'angles': 'degrees',
}
PAPER_FILTER = {'preset': 'paper_000', 'particles': 10000}
RECOMMENDED_FILTER = {'method': 'pmb'}
_GRID = {'grid': [3, 3, 3], 'spacing': 120.0, 'corner': [10.0, 10.0, 10.0]}
_RING = {'ring': 6, 'distance': 12.0}


def drone(start: list[float], candidates: dict[str, Any]) -> dict[str, Any]:
    """Return a drone that measures each second, or at its waypoints if those are around it."""
    return {
        'type': 'ranging_drone',
        'start': start,
        'candidates': candidates,
        'motion': {'speed': 12.0, 'acceleration': None, 'tolerance': 0.01},
        # Ready at each step where the planner measures on arrival only.
        'sensor': {'period': 0.1 if 'ring' in candidates else 1.0, 'noise': _DEGREES},
        'odometry': PERFECT_ODOMETRY,
    }


def cube(
    planner: dict[str, Any],
    candidates: dict[str, Any] | None = None,
    agents: int = 1,
    search_filter: dict[str, Any] | None = None,
    start: float = 1.0,
) -> dict[str, Any]:
    """Return the scenario of 000, sections 5.1 and 7.1, with a planner."""
    places = [[start] * 3, [250.0] * 3][:agents]
    return {
        'version': 1,
        'environment': {'bounds': [[0.0, 260.0]] * 3},
        'step': 0.1,
        'targets': {'count': 12, 'distribution': 'uniform'},
        'robots': {
            f'drone{index + 1}': drone(place, candidates or _GRID)
            for index, place in enumerate(places)
        },
        'filter': search_filter or PAPER_FILTER,
        'planner': merged(NEVER_DONE, planner),
        'scoring': {'radius': 5.0},
        'limits': {'time': 3000.0},
    }


def asi(alpha: float = 0.75, beta: float = 0.75, name: str = 'asi') -> dict[str, Any]:
    """Return ASI, or MAASI, as the paper has it."""
    return {
        'name': name,
        'objective': 'paper',
        'alpha': alpha,
        'beta': beta,
        'control_weight': 0.0,
    }


_RECOMMENDED = {'name': 'asi', 'objective': 'information'}
_LAWNMOWER = {'name': 'lawnmower', 'lane_spacing': 48.0, 'layer_spacing': 48.0, 'margin': 10.0}


def _methods(cap: int, small: bool, recommended: bool = True) -> list[Case]:
    def case(name: str, values: dict[str, Any], preset: str = 'paper') -> Case:
        return search_case(name, values, cap, preset, small)

    cases = [
        case('lawnmower', cube(_LAWNMOWER, start=10.0)),
        case('MI only', cube({'name': 'mutual_information'}, _RING)),
        case('Sung and Tokekar', cube({'name': 'nearest_widest'})),
        case('AS', cube({'name': 'as', 'alpha': 5.0}, _RING)),
        case('ASI', cube(asi())),
    ]
    if recommended:
        cases.append(
            case(
                'ASI, recommended',
                cube(_RECOMMENDED, search_filter=RECOMMENDED_FILTER),
                'recommended',
            )
        )
    return cases


_FIG4_STYLES = {
    'lawnmower': 'lawnmower',
    'MI only': 'mutual',
    'Sung and Tokekar': 'sung',
    'AS': 'as',
    'ASI': 'asi',
    'ASI, recommended': 'recommended',
}


def _draw_fig4(figure: Figure, results: Results) -> None:
    figure.set_size_inches(8.0, 5.0)
    axes = figure.add_subplot()
    figures.curves(axes, results, _FIG4_STYLES, end=650.0)
    figures.published_marks(axes, results, _FIG4_STYLES)


def _fig4() -> Experiment:
    return Experiment(
        name='000-fig4',
        title='One drone, 12 targets in a cube: ASI against four other methods',
        cases=lambda small: _methods(_CAP, small),
        run=run_search,
        quantities=(MEASUREMENTS, FOUND, FALSE, RMSE, STEP_TIME),
        draw=_draw_fig4,
        comparisons=(
            Comparison('ASI, recommended', 'ASI', MEASUREMENTS.name),
            Comparison('ASI', 'AS', MEASUREMENTS.name),
            Comparison('ASI', 'Sung and Tokekar', MEASUREMENTS.name),
            Comparison('ASI', 'lawnmower', MEASUREMENTS.name),
        ),
        seconds=1.5,
        maps='000, one drone',
        **printed('000-fig4'),
    )


def _paths_of(names: tuple[str, ...]) -> Any:
    def draw(figure: Figure, results: Results) -> None:
        figures.paths(figure, results, names)

    return draw


def _fig5_cases(small: bool) -> list[Case]:
    nothing = merged(cube(asi()), {'targets': {'count': 0}, 'stop': 'planner_done'})
    return [
        *_methods(_CAP, small, recommended=False),
        search_case('ASI, no targets', nothing, 400, small=small),
    ]


def _fig5() -> Experiment:
    names = ('lawnmower', 'MI only', 'Sung and Tokekar', 'AS', 'ASI', 'ASI, no targets')
    return Experiment(
        name='000-fig5',
        title='Paths of the five methods on one map, and of ASI where there is no target',
        cases=_fig5_cases,
        run=run_search,
        quantities=(MEASUREMENTS, FOUND, FALSE, RMSE),
        draw=_paths_of(names),
        runs=1,
        seconds=1.0,
        maps='000, one drone',
        **printed('000-fig5'),
    )


def _weights_name(alpha: float, beta: float) -> str:
    return f'alpha {alpha:g}, beta {beta:g}'


def _weights_table(number: int, agents: int) -> Experiment:
    method = 'ASI' if agents == 1 else 'MAASI'

    def cases(small: bool) -> list[Case]:
        weights = (0.05, 5.0) if small else _WEIGHTS
        name = method.lower()
        return [
            search_case(
                _weights_name(alpha, beta),
                cube(asi(alpha, beta, name), agents=agents),
                _CAP,
                small=small,
            )
            for alpha in weights
            for beta in weights
        ]

    def draw(figure: Figure, results: Results) -> None:
        names = [[_weights_name(alpha, beta) for beta in _WEIGHTS] for alpha in _WEIGHTS]
        heads = [f'{weight:g}' for weight in _WEIGHTS]
        columns = [f'beta {head}' for head in heads]
        figures.table_of(figure, results, names, heads, columns, 'alpha', MEASUREMENTS.name)

    return Experiment(
        name=f'000-table{number}',
        title=f'Weights alpha and beta of {method}',
        cases=cases,
        run=run_search,
        quantities=(MEASUREMENTS, FALSE),
        draw=draw,
        runs=5,
        seconds=0.6 if agents == 1 else 1.0,
        maps=f'000, tables of {method}',
        **printed(f'000-table{number}'),
    )


def _particles_name(number: int) -> str:
    return f'{number} particles'


def _particles_table(number: int, agents: int) -> Experiment:
    method, weight = ('ASI', 0.75) if agents == 1 else ('MAASI', 0.5)

    def cases(small: bool) -> list[Case]:
        listed = []
        for particles in (2000, 4000) if small else _PARTICLES:
            scale = particles / 10000
            search_filter = {
                **PAPER_FILTER,
                'particles': particles,
                'particles_per_target': round(1000 * scale),
                'particles_minimum': round(500 * scale),
                'birth_particles': round(500 * scale),
            }
            values = cube(
                asi(weight, weight, method.lower()), agents=agents, search_filter=search_filter
            )
            listed.append(search_case(_particles_name(particles), values, _CAP, small=small))
        return listed

    def draw(figure: Figure, results: Results) -> None:
        names = [[_particles_name(particles)] for particles in _PARTICLES]
        rows = [str(particles) for particles in _PARTICLES]
        figure.set_size_inches(5.0, 4.5)
        figures.table_of(
            figure, results, names, rows, ['measurements to find all'], '', MEASUREMENTS.name
        )

    return Experiment(
        name=f'000-table{number}',
        title=f'Number of particles of {method}',
        cases=cases,
        run=run_search,
        quantities=(MEASUREMENTS, FALSE, FILTER_TIME, PLANNING_TIME),
        draw=draw,
        runs=5,
        seconds=0.8 if agents == 1 else 1.2,
        maps=f'000, tables of {method}',
        **printed(f'000-table{number}'),
    )


def _triggered(planner: dict[str, Any], trigger: str) -> dict[str, Any]:
    if trigger == 'absolute':
        return {
            **planner,
            'measurement': 'event',
            'trigger': 'absolute',
            'threshold': 4.0,
            'gamma': 1000.0,
        }
    return {**planner, 'measurement': 'event', 'trigger': 'relative', 'threshold': 0.8}


def _trigger_cases(small: bool, agents: int, runs: int | None = None) -> list[Case]:
    method, weight = ('ASI', 0.75) if agents == 1 else ('MAASI', 0.5)
    planner = asi(weight, weight, method.lower())
    best = {'name': method.lower(), 'objective': 'information'}

    def case(name: str, chosen: dict[str, Any], preset: str = 'paper') -> Case:
        search_filter = PAPER_FILTER if preset == 'paper' else RECOMMENDED_FILTER
        values = cube(chosen, agents=agents, search_filter=search_filter)
        return search_case(f'{method}, {name}', values, _CAP, preset, small, runs)

    return [
        case('periodic', planner),
        case('event-triggered', _triggered(planner, 'absolute')),
        case('event-triggered, relative', _triggered(planner, 'relative')),
        case('recommended, periodic', best, 'recommended'),
        case('recommended, event-triggered', _triggered(best, 'relative'), 'recommended'),
    ]


def _trigger_figure(number: int, agents: int) -> Experiment:
    method = 'ASI' if agents == 1 else 'MAASI'
    styles = {
        f'{method}, periodic': 'asi',
        f'{method}, event-triggered': 'event',
        f'{method}, event-triggered, relative': 'as',
        f'{method}, recommended, periodic': 'recommended',
        f'{method}, recommended, event-triggered': 'sung',
    }

    def draw(figure: Figure, results: Results) -> None:
        figures.curves(figure.add_subplot(), results, styles, by='time', label='time [s]')

    return Experiment(
        name=f'000-fig{number}',
        title=f'{method} with periodic and with event-triggered measurements',
        cases=lambda small: _trigger_cases(small, agents),
        run=run_search,
        quantities=(TIME, TAKEN, FOUND, FALSE),
        draw=draw,
        comparisons=tuple(
            Comparison(f'{method}, {name}', f'{method}, {other}', quantity)
            for name, other in (
                ('event-triggered', 'periodic'),
                ('event-triggered, relative', 'periodic'),
                ('recommended, event-triggered', 'recommended, periodic'),
            )
            for quantity in (TAKEN.name, TIME.name)
        ),
        seconds=0.8 if agents == 1 else 1.2,
        maps='000, one drone' if agents == 1 else '000, two drones',
        **printed(f'000-fig{number}'),
    )


def _fig7() -> Experiment:
    names = ('ASI, periodic', 'ASI, event-triggered', 'ASI, event-triggered, relative')
    return Experiment(
        name='000-fig7',
        title='Where ASI measures, periodically and event-triggered, on one map',
        cases=lambda small: _trigger_cases(small, 1)[:3],
        run=run_search,
        quantities=(TIME, TAKEN, FOUND),
        draw=_paths_of(names),
        runs=1,
        seconds=1.0,
        maps='000, one drone',
        **printed('000-fig7'),
    )


_FIG11_STYLES = {
    'Sung and Tokekar': 'sung',
    'MAAS': 'as',
    'MAASI': 'asi',
    'MAASI, recommended': 'recommended',
}


def _fig11_cases(small: bool) -> list[Case]:
    def case(name: str, values: dict[str, Any], preset: str = 'paper') -> Case:
        return search_case(name, values, _CAP, preset, small)

    return [
        case('Sung and Tokekar', cube({'name': 'nearest_widest'}, agents=2)),
        case('MAAS', cube({'name': 'maas', 'alpha': 5.0}, _RING, agents=2)),
        case('MAASI', cube(asi(0.5, 0.5, 'maasi'), agents=2)),
        case(
            'MAASI, recommended',
            cube(
                {'name': 'maasi', 'objective': 'information'},
                agents=2,
                search_filter=RECOMMENDED_FILTER,
            ),
            'recommended',
        ),
    ]


def _fig11() -> Experiment:

    def draw(figure: Figure, results: Results) -> None:
        figures.curves_and_path(
            figure, results, _FIG11_STYLES, 'MAASI', label='measurements of both drones'
        )

    return Experiment(
        name='000-fig11',
        title='Two drones, 12 targets in a cube: MAASI against two other methods',
        cases=_fig11_cases,
        run=run_search,
        quantities=(MEASUREMENTS, FOUND, FALSE, RMSE, STEP_TIME),
        draw=draw,
        comparisons=(
            Comparison('MAASI, recommended', 'MAASI', MEASUREMENTS.name),
            Comparison('MAASI', 'MAAS', MEASUREMENTS.name),
            Comparison('MAASI', 'Sung and Tokekar', MEASUREMENTS.name),
        ),
        seconds=1.2,
        maps='000, two drones',
        **printed('000-fig11'),
    )


def experiments() -> list[Experiment]:
    """Return the experiments of 000."""
    return [
        _fig4(),
        _fig5(),
        _weights_table(1, 1),
        _particles_table(2, 1),
        _trigger_figure(6, 1),
        _fig7(),
        paper_000_floor.fig9(),
        _fig11(),
        _weights_table(3, 2),
        _particles_table(4, 2),
        _trigger_figure(12, 2),
        paper_000_floor.fig13(),
        paper_000_floor.fig15(),
    ]
