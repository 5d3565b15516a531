"""002: multi-agent exploration-based search for an unknown number of targets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from maasi_sim.experiments import figures
from maasi_sim.experiments.cases import Case, Comparison
from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.printed import printed
from maasi_sim.experiments.searches import (
    FALSE,
    FOUND,
    MEASUREMENTS,
    NEVER_DONE,
    PERFECT_ODOMETRY,
    RMSE,
    STEP_TIME,
    merged,
    run_search,
    search_case,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOW, _HIGH = -30.0, 300.0
# 120 and 320 steps of both agents.
_HOMOGENEOUS, _HETEROGENEOUS = 240, 640
_PAPER_FILTER = {'preset': 'paper_002', 'particles': 10000}
_RECOMMENDED_FILTER = {'method': 'pmb'}
_GRID = {'grid': [5, 5], 'spacing': 72.5, 'corner': [-10.0, -10.0]}
_CENTRALIZED, _INDEPENDENT = 'centralized', 'independent'
_SHARED = 'centralized, one exploration'
_STYLES = {
    'lawnmower': 'lawnmower',
    _INDEPENDENT: 'as',
    _CENTRALIZED: 'asi',
    'MAASI, recommended': 'recommended',
}


def agent(
    start: list[float],
    candidates: dict[str, Any],
    move: float,
    view: float,
    period: float,
    accuracy: float = 1.0,
) -> dict[str, Any]:
    """Return an agent.

    Parameters
    ----------
    start : list of two numbers
        [m].
    candidates : dict
        Waypoints.
    move : float
        In a step [m].
    view : float
        F of its sensor [m].
    period : float
        Of possible measurements [s].
    accuracy : float
        Factor on the deviations of its noise.
    """
    return {
        'type': 'ranging_drone',
        'start': [*start, 0.0],
        'candidates': candidates,
        'motion': {'speed': move, 'acceleration': None, 'tolerance': 0.001 * move},
        'sensor': {
            # Ready at each step where the planner measures on arrival only.
            'period': period,
            'detection': {'kind': 'exponential', 'probability': 0.98, 'size': [view, view]},
            'noise': {
                'range': 1.5 * accuracy**2,
                'bearing': 0.175 * accuracy**2,
                'as': 'variance',
                'angles': 'degrees',
            },
        },
        'odometry': PERFECT_ODOMETRY,
    }


def square(
    robots: dict[str, Any], planner: dict[str, Any], search_filter: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return the scenario of section 5 with robots and a planner."""
    return {
        'version': 1,
        'environment': {'bounds': [[_LOW, _HIGH]] * 2},
        'step': 0.1,
        'targets': {'count': 12, 'distribution': 'uniform'},
        'robots': robots,
        'filter': search_filter or _PAPER_FILTER,
        'planner': merged(NEVER_DONE, planner),
        'scoring': {'radius': 5.0},
        'limits': {'time': 2000.0},
    }


def _planner(coordination: str) -> dict[str, Any]:
    return {'name': 'maas', 'alpha': 5.0, 'coordination': coordination}


_LAWNMOWER = {'name': 'lawnmower', 'lane_spacing': 55.0, 'margin': 27.5}
_RECOMMENDED = {'name': 'maasi', 'objective': 'information'}


def _homogeneous(small: bool) -> list[Case]:
    def pair(
        candidates: dict[str, Any], starts: list[list[float]], period: float
    ) -> dict[str, Any]:
        return {
            f'agent{index + 1}': agent(start, candidates, 8.0, 25.0, period)
            for index, start in enumerate(starts)
        }

    ring = {'ring': 8, 'distance': 8.0}
    together = [[0.0, 0.0], [0.0, 0.0]]
    corners = [[_LOW, _LOW], [_HIGH, _HIGH]]

    def case(name: str, values: dict[str, Any], preset: str = 'paper') -> Case:
        return search_case(name, values, _HOMOGENEOUS, preset, small)

    return [
        case('lawnmower', square(pair(ring, corners, 1.0), _LAWNMOWER)),
        case(_INDEPENDENT, square(pair(ring, together, 0.1), _planner('independent'))),
        case(_CENTRALIZED, square(pair(ring, together, 0.1), _planner('centralized'))),
        case(
            _SHARED,
            square(
                pair(ring, together, 0.1),
                {**_planner('centralized'), 'agent_exploration': 'shared'},
            ),
        ),
        case(
            'MAASI, recommended',
            square(pair(_GRID, together, 1.0), _RECOMMENDED, _RECOMMENDED_FILTER),
            'recommended',
        ),
    ]


def _fig5() -> Experiment:
    def draw(figure: Figure, results: Results) -> None:
        figures.curves(figure.add_subplot(), results, _STYLES)

    return Experiment(
        name='002-fig5',
        title='Two equal agents: independent and centralized planner against a lawnmower',
        cases=_homogeneous,
        run=run_search,
        quantities=(MEASUREMENTS, FOUND, FALSE, RMSE),
        draw=draw,
        comparisons=(
            Comparison(_CENTRALIZED, 'lawnmower', FOUND.name),
            Comparison(_CENTRALIZED, _INDEPENDENT, FOUND.name),
            Comparison(_CENTRALIZED, _INDEPENDENT, MEASUREMENTS.name),
            Comparison(_CENTRALIZED, _SHARED, MEASUREMENTS.name),
            Comparison('MAASI, recommended', _CENTRALIZED, MEASUREMENTS.name),
        ),
        seconds=1.5,
        maps='002, equal agents',
        **printed('002-fig5'),
    )


def _fig7() -> Experiment:
    names = ('lawnmower', _INDEPENDENT, _CENTRALIZED)

    def draw(figure: Figure, results: Results) -> None:
        figures.paths(figure, results, names)

    return Experiment(
        name='002-fig7',
        title='Paths of the two planners, and of the lawnmower (figure 6), on one map',
        cases=lambda small: [case for case in _homogeneous(small) if case.name in names],
        run=run_search,
        quantities=(FOUND, FALSE, RMSE),
        draw=draw,
        runs=1,
        seconds=1.5,
        maps='002, equal agents',
        **printed('002-fig7'),
    )


def _heterogeneous(small: bool) -> list[Case]:
    def pair(ring: bool) -> dict[str, Any]:
        def around(distance: float) -> dict[str, Any]:
            return {'ring': 4, 'distance': distance} if ring else _GRID

        period = 0.1 if ring else 1.0
        return {
            'rov': agent([0.0, 0.0], around(4.0), 4.0, 15.0, period, 0.5),
            'uav': agent([0.0, 0.0], around(12.0), 12.0, 60.0, period),
        }

    return [
        search_case(
            _CENTRALIZED, square(pair(True), _planner('centralized')), _HETEROGENEOUS, small=small
        ),
        search_case(
            'MAASI, recommended',
            square(pair(False), _RECOMMENDED, _RECOMMENDED_FILTER),
            _HETEROGENEOUS,
            'recommended',
            small,
        ),
    ]


def _fig9() -> Experiment:
    styles = {_CENTRALIZED: 'asi', 'MAASI, recommended': 'recommended'}

    def draw(figure: Figure, results: Results) -> None:
        figures.curves_and_path(figure, results, styles, _CENTRALIZED)

    return Experiment(
        name='002-fig9',
        title='A fast agent with a wide view and a slow one with a narrow view',
        cases=_heterogeneous,
        run=run_search,
        quantities=(MEASUREMENTS, FOUND, FALSE, RMSE, STEP_TIME),
        draw=draw,
        comparisons=(Comparison('MAASI, recommended', _CENTRALIZED, MEASUREMENTS.name),),
        seconds=1.5,
        maps='002, different agents',
        **printed('002-fig9'),
    )


def experiments() -> list[Experiment]:
    """Return the experiments of 002."""
    return [_fig5(), _fig7(), _fig9()]
