"""003: exploration-based search for an unknown number of targets using a UAV."""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING, Any

import numpy as np

from maasi_sim.experiments import figures
from maasi_sim.experiments.cases import Case, Comparison, Outcome
from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.printed import printed
from maasi_sim.experiments.searches import (
    FALSE,
    FOUND,
    MEASUREMENTS,
    NEVER_DONE,
    PERFECT_ODOMETRY,
    RMSE,
    merged,
    run_search,
    search_case,
)
from maasi_sim.experiments.terrain import chunk, littered
from maasi_sim.world.noise_streams import noise_stream

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PRINTED_FILTER = {'preset': 'paper_003', 'particles': 10000}
_PAPER_FILTER = {
    **_PRINTED_FILTER,
    'births': 'measurement',
    'birth_particles': 500,
    'expected_targets': 18.0,
}
_RECOMMENDED_FILTER = {'method': 'pmb', 'expected_targets': 18.0}
_TRUE_NUMBER = 18
_RING = {'ring': 8, 'distance': 9.0}
_OURS = 'MI with exploration'
_PRINTED = 'MI with exploration, births as printed'
_STYLES = {
    'lawnmower': 'lawnmower',
    'MI only': 'mutual',
    _OURS: 'asi',
    _PRINTED: 'as',
    'ASI, recommended': 'recommended',
}
# Three clusters of six, as figure 4 of the paper has them, by hand.
_CLUSTERS = ([60.0, 200.0], [200.0, 190.0], [180.0, 50.0])
_AROUND = ((0.0, 0.0), (14.0, 3.0), (-11.0, 8.0), (5.0, -13.0), (-7.0, -10.0), (9.0, 13.0))


def area(
    high: float,
    planner: dict[str, Any],
    candidates: dict[str, Any] | None = None,
    search_filter: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the scenario of section 5 on [-30, high]^2, without its targets."""
    underway = planner['name'] not in ('as', 'mutual_information')
    return {
        'version': 1,
        'environment': {'bounds': [[-30.0, high]] * 2},
        'step': 0.1,
        'targets': {'count': 0},
        'robots': {
            'uav': {
                'type': 'ranging_drone',
                'start': [10.0, 10.0, 0.0],
                'candidates': candidates or _RING,
                'motion': {'speed': 9.0, 'acceleration': None, 'tolerance': 0.01},
                'sensor': {
                    # Ready at each step where the planner measures on arrival only.
                    'period': 1.0 if underway else 0.1,
                    'detection': {'kind': 'gaussian', 'probability': 0.98, 'size': [15.0, 15.0]},
                    'noise': {
                        'range': 0.3,
                        'bearing': 0.3,
                        'as': 'variance',
                        'angles': 'degrees',
                    },
                },
                'odometry': PERFECT_ODOMETRY,
            }
        },
        'filter': search_filter or _PAPER_FILTER,
        'planner': merged(NEVER_DONE, planner),
        'scoring': {'radius': 4.0},
        'limits': {'time': 1500.0},
    }


_LAWNMOWER = {'name': 'lawnmower', 'lane_spacing': 43.0, 'margin': 21.5}
_EXPLORER = {'name': 'as', 'alpha': 0.5, 'refinement': 'mutual_information'}
_RECOMMENDED = {'name': 'asi', 'objective': 'information', 'expected_targets': 18.0}


def _grid(high: float) -> dict[str, Any]:
    return {'grid': [7, 7], 'spacing': (high + 10.0) / 6.0, 'corner': [-20.0, -20.0]}


def _methods(
    high: float, targets: dict[str, Any], steps: int, small: bool, informed: bool
) -> list[Case]:
    def case(name: str, values: dict[str, Any], preset: str = 'paper') -> Case:
        return search_case(name, {**values, 'targets': targets}, steps, preset, small)

    cases = [case('lawnmower', area(high, _LAWNMOWER))]
    if informed:
        cases.append(case('MI only', area(high, {'name': 'mutual_information'})))
    return [
        *cases,
        case(_OURS, area(high, _EXPLORER)),
        case(_PRINTED, area(high, _EXPLORER, search_filter=_PRINTED_FILTER)),
        *(
            case(
                'ASI, recommended' + (f', N0 = {number}' if number != _TRUE_NUMBER else ''),
                area(
                    high,
                    {**_RECOMMENDED, 'expected_targets': float(number)},
                    _grid(high),
                    {**_RECOMMENDED_FILTER, 'expected_targets': float(number)},
                ),
                'recommended',
            )
            for number in (_TRUE_NUMBER, 1, 100)
        ),
    ]


def _fig4() -> Experiment:
    positions = [[centre[0] + x, centre[1] + y] for centre in _CLUSTERS for x, y in _AROUND]

    def draw(figure: Figure, results: Results) -> None:
        figures.curves_and_path(figure, results, _STYLES, _OURS)

    return Experiment(
        name='003-fig4',
        title='18 targets in three clusters: exploration against a lawnmower',
        cases=lambda small: _methods(270.0, {'positions': positions}, 240, small, False),
        run=run_search,
        quantities=(MEASUREMENTS, FOUND, FALSE, RMSE),
        draw=draw,
        comparisons=(
            Comparison(_OURS, 'lawnmower', FOUND.name),
            Comparison(_PRINTED, _OURS, FOUND.name),
            Comparison('ASI, recommended', _OURS, MEASUREMENTS.name),
            *(
                Comparison(f'ASI, recommended, N0 = {number}', 'ASI, recommended', quantity.name)
                for number in (1, 100)
                for quantity in (FOUND, MEASUREMENTS)
            ),
        ),
        seconds=2.5,
        **printed('003-fig4'),
    )


# Each run puts its own in their place.
_PLACED_LATER = {'count': 14, 'distribution': 'clustered', 'clusters': 2}


def _run_on_terrain(settings: dict[str, Any], seed: int) -> Outcome:
    generator = noise_stream(seed, purpose='terrain')
    bounds = np.array(settings['scenario']['environment']['bounds'], float)
    heights = chunk(generator, float(bounds[0, 1] - bounds[0, 0]), 57)
    targets = littered(heights, bounds, 14, 15.0, 10.0, generator)
    content = deepcopy(settings)
    content['scenario']['targets'] = {'positions': targets.tolist()}
    outcome = run_search(content, seed)
    outcome.details['heights'] = heights[::2, ::2].round(2).tolist()
    return outcome


def _fig5() -> Experiment:
    def draw(figure: Figure, results: Results) -> None:
        figures.curves_and_path(figure, results, _STYLES, _OURS)

    return Experiment(
        name='003-fig5',
        title='14 targets at a low and a high place of generated terrain',
        cases=lambda small: _methods(250.0, _PLACED_LATER, 100, small, True),
        run=_run_on_terrain,
        quantities=(FOUND, FALSE, MEASUREMENTS, RMSE),
        draw=draw,
        comparisons=(
            Comparison(_OURS, 'lawnmower', FOUND.name),
            Comparison(_OURS, 'MI only', FOUND.name),
            Comparison('ASI, recommended', _OURS, FOUND.name),
        ),
        runs=6,
        seconds=1.0,
        **printed('003-fig5'),
    )


def experiments() -> list[Experiment]:
    """Return the experiments of 003."""
    return [_fig4(), _fig5()]
