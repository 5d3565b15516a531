"""003: exploration-based search for an unknown number of targets using a UAV."""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING, Any

import numpy as np

from maasi_sim.experiments import figures
from maasi_sim.experiments.cases import Case, Choice, Comparison, Outcome, Published
from maasi_sim.experiments.experiment import Experiment, Results
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
from maasi_sim.experiments.terrain import HURST, chunk, littered
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

CHOICES = (
    Choice(
        'noise, sigma^2',
        '0.3 m^2 and 0.3 deg^2',
        'Not given, one number for both. T_W is then as many deviations of the range as in 000; '
        'with 1 m^2 no cluster gets below T_W in passing, a lawnmower finds none.',
    ),
    Choice(
        'weight alpha of exploration',
        '0.5',
        'Not given. Mutual information is at most log 2, so that both terms count; with the 5 of '
        '001 exploration decides alone, and fewer are found (on other maps).',
    ),
    Choice(
        'motion',
        '9 m in a step, straight',
        'The backstepping controller reaches each waypoint before the next is planned, so that '
        'the planner only sees positions.',
    ),
    Choice(
        'filter',
        'preset paper_003, but births where each measurement points, as in 000',
        'The printed Gaussian over all measurements together puts most of its particles between '
        'the targets; it is run as a case of its own. T_m = 0.5 and a jitter: '
        'docs/filter_presets.md has each with its reason.',
    ),
    Choice(
        'mutual information',
        'of the Poisson set of the clusters, each with 5 points for its spread',
        'The paper refers to Dames and Kumar. Planner and filter are two nodes here, and the '
        'planner is told clusters, not particles.',
    ),
    Choice(
        'lanes of the lawnmower',
        '43 m apart',
        'Not given; the widest that cover the area within the 240 steps of figure 4.',
    ),
    Choice(
        'expected targets N0 of births and of the recommended planner',
        '18, the true number of 003-fig4',
        'Not given; a number that a search does not know. N0 = 1 and 100 are run beside it.',
    ),
    Choice(
        'a found target counts',
        'within T_z = 4 m of a true one, one to one',
        'The paper does not say when a found target is right.',
    ),
)


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
        published=(
            Published(_OURS, FOUND.name, 18.0, runs=1, note='240 steps'),
            Published('lawnmower', FOUND.name, 18.0, runs=1, note='240 steps'),
        ),
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
        choices=(
            *CHOICES,
            Choice(
                'targets', 'three clusters of six', 'Placed by hand in the paper too, not given.'
            ),
            Choice('runs', '10', 'The paper has one; each has its own noise, on the same map.'),
        ),
        causes='pi = 0.98 exp(-d^2 / 450 m^2) ends at about 40 m: what counts is how soon the '
        'robot comes near a cluster. One step ahead the planner lingers where all neighbours are '
        'explored, far from what is still unseen.',
        seconds=2.5,
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
        choices=(
            *CHOICES,
            Choice(
                'terrain',
                f'generated, self-affine with H = {HURST}, 12 km wide, 150 m deviation',
                "The paper's six areas of a geographical data base are not named. Real terrain has "
                'a fractal dimension of about 2.2, which is this H. Heights only say where the '
                'targets are.',
            ),
            Choice(
                'targets',
                'seven around the lowest and seven around the highest place, 15 m deviation',
                'Placed by hand in the paper, at low and at high elevations.',
            ),
        ),
        causes='As in 003-fig4. 100 steps of 9 m are not enough to come by everywhere.',
        runs=6,
        seconds=1.0,
        note='The terrain is not that of the paper, which is not to be had: it is generated.',
    )


def experiments() -> list[Experiment]:
    """Return the experiments of 003."""
    return [_fig4(), _fig5()]
