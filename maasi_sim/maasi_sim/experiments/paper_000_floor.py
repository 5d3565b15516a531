"""000 on the floor: a drone alone, and with a ground robot (sections 5.2, 7.1.3 and 7.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from maasi_sim.experiments import figures
from maasi_sim.experiments.cases import Case, Comparison
from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.floors import (
    MAMBO_MOTION,
    MAMBO_SENSOR,
    TURTLEBOT_SENSOR,
    floor,
    floor_filter,
)
from maasi_sim.experiments.printed import printed
from maasi_sim.experiments.searches import (
    FALSE,
    FOUND,
    MEASUREMENTS,
    PERFECT_ODOMETRY,
    RMSE,
    TIME,
    run_search,
    search_case,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FLOOR_FILTER = floor_filter('paper_000', particles=10000, found_radius=0.02, removal_distance=0.05)
_RECOMMENDED_FILTER = {'method': 'pmb'}


def _asi(alpha: float, name: str) -> dict[str, Any]:
    return {
        'name': name,
        'objective': 'paper',
        'alpha': alpha,
        'beta': alpha,
        'control_weight': 0.01,
    }


def _fig9_cases(small: bool) -> list[Case]:
    bounds = [[0.0, 2.0], [0.0, 2.0]]

    def robots(candidates: dict[str, Any], period: float) -> dict[str, Any]:
        return {
            'mambo': {
                'type': 'mambo',
                'start': [0.1, 0.1, 1.0],
                'candidates': candidates,
                'motion': MAMBO_MOTION,
                'sensor': {**MAMBO_SENSOR, 'period': period},
            }
        }

    def case(
        name: str,
        planner: dict[str, Any],
        candidates: dict[str, Any],
        preset: str = 'paper',
        period: float = MAMBO_SENSOR['period'],
    ) -> Case:
        search_filter = _FLOOR_FILTER if preset == 'paper' else _RECOMMENDED_FILTER
        values = floor(bounds, robots(candidates, period), planner, search_filter)
        return search_case(name, values, 1500, preset, small)

    wide = {'grid': [3, 3], 'spacing': 0.9, 'corner': [0.1, 0.1]}
    ring = {'ring': 8, 'distance': 0.2}
    fine = {'grid': [6, 6], 'spacing': 0.34, 'corner': [0.15, 0.15]}
    return [
        case('lawnmower', {'name': 'lawnmower', 'lane_spacing': 0.2, 'margin': 0.1}, wide),
        case('AS', {'name': 'as', 'alpha': 5.0}, ring),
        case('ASI', _asi(0.75, 'asi'), wide),
        case('ASI, as far apart as AS', _asi(0.75, 'asi'), wide, period=0.6),
        case('ASI, recommended', {'name': 'asi', 'objective': 'information'}, fine, 'recommended'),
    ]


def fig9() -> Experiment:
    """Figure 9 of 000."""
    styles = {'lawnmower': 'lawnmower', 'AS': 'as', 'ASI': 'asi', 'ASI, recommended': 'recommended'}

    def draw(figure: Figure, results: Results) -> None:
        figures.curves_and_path(figure, results, styles, 'ASI')

    return Experiment(
        name='000-fig9',
        title='A Mambo over a floor with 12 markers (simulated hardware)',
        cases=_fig9_cases,
        run=run_search,
        quantities=(MEASUREMENTS, TIME, FOUND, FALSE, RMSE),
        draw=draw,
        comparisons=(
            *(
                Comparison('ASI', other, quantity.name)
                for other in ('AS', 'lawnmower')
                for quantity in (MEASUREMENTS, TIME)
            ),
            Comparison('ASI, as far apart as AS', 'AS', MEASUREMENTS.name),
            Comparison('ASI, recommended', 'lawnmower', MEASUREMENTS.name),
        ),
        seconds=3.0,
        **printed('000-fig9'),
    )


_OBSTACLES = [
    {'centre': [0.65, 1.55], 'radius': 0.08},
    {'centre': [1.25, 0.75], 'radius': 0.1},
    {'centre': [1.75, 1.45], 'radius': 0.12},
    {'centre': [0.55, 0.55], 'radius': 0.06},
]
_FLOOR_BOUNDS = [[-0.3, 2.4], [-0.3, 2.4]]
_WIDE = {'grid': [3, 3], 'spacing': 0.6}
_FINE = {'grid': [8, 8], 'spacing': 0.25}
_RING_4 = {'ring': 4, 'distance': 0.25}
# Grids of waypoints of drone and ground robot from which every place of the floor is seen.
_SEEING = (
    {'grid': [7, 7], 'spacing': 0.384, 'corner': [-0.1, -0.1]},
    {'grid': [10, 10], 'spacing': 0.25, 'corner': [0.0, 0.0]},
)


def _pair_of_fig13(ring: bool) -> dict[str, Any]:
    def sensor(size: float, spread: tuple[float, float], period: float) -> dict[str, Any]:
        return {
            'period': 0.05 if ring else period,
            'detection': {'kind': 'exponential', 'probability': 0.98, 'size': [size, size]},
            'noise': {
                'range': spread[0],
                'bearing': spread[1],
                'as': 'deviation',
                'angles': 'radians',
            },
        }

    return {
        'mambo': {
            'type': 'ranging_drone',
            'start': [0.1, 0.1, 1.0],
            'radius': 0.09,
            'candidates': _RING_4 if ring else _WIDE,
            'motion': {
                'model': 'mambo',
                'speed': 0.4,
                'acceleration': None,
                'tilt': 0.1,
                'tolerance': 0.05,
                'clearance': 0.12,
                **MAMBO_MOTION,
            },
            'sensor': sensor(0.3, (0.016, 0.052), 0.6),
            'odometry': PERFECT_ODOMETRY,
        },
        'turtlebot': {
            'type': 'ranging_drone',
            'start': [0.0, 0.0, 0.0],
            'radius': 0.11,
            'candidates': _RING_4 if ring else _FINE,
            'motion': {
                'model': 'unicycle',
                'speed': 0.2,
                'acceleration': 0.5,
                'yaw_rate': 1.8,
                'tolerance': 0.05,
                'heading': 'travel',
                'clearance': 0.12,
            },
            'sensor': sensor(0.15, (0.011, 0.0311), 1.2),
            'odometry': PERFECT_ODOMETRY,
        },
    }


def _fig13_cases(small: bool) -> list[Case]:
    def case(
        name: str,
        planner: dict[str, Any],
        ring: bool,
        preset: str = 'paper',
        grids: tuple[dict[str, Any], dict[str, Any]] | None = None,
    ) -> Case:
        search_filter = _FLOOR_FILTER if preset == 'paper' else _RECOMMENDED_FILTER
        robots = _pair_of_fig13(ring)
        if grids is not None:
            robots['mambo']['candidates'], robots['turtlebot']['candidates'] = grids
        values = floor(_FLOOR_BOUNDS, robots, planner, search_filter)
        values['environment'] = {'bounds': _FLOOR_BOUNDS, 'obstacles': _OBSTACLES}
        return search_case(name, values, 400, preset, small)

    return [
        case('MAAS', {'name': 'maas', 'alpha': 5.0}, True),
        case('MAASI', _asi(0.5, 'maasi'), False),
        case('MAASI, all places in view', _asi(0.5, 'maasi'), False, grids=_SEEING),
        case(
            'MAASI, recommended',
            {'name': 'maasi', 'objective': 'information'},
            False,
            'recommended',
        ),
    ]


def fig13() -> Experiment:
    """Figure 13 of 000."""
    styles = {'MAAS': 'as', 'MAASI': 'asi', 'MAASI, recommended': 'recommended'}

    def draw(figure: Figure, results: Results) -> None:
        figures.curves_and_path(
            figure, results, styles, 'MAASI', label='measurements of both robots'
        )

    return Experiment(
        name='000-fig13',
        title='Drone and ground robot among obstacles, in simulation',
        cases=_fig13_cases,
        run=run_search,
        quantities=(MEASUREMENTS, TIME, FOUND, FALSE, RMSE),
        draw=draw,
        comparisons=(
            *(
                Comparison(name, 'MAAS', quantity.name)
                for name in ('MAASI', 'MAASI, all places in view')
                for quantity in (MEASUREMENTS, TIME)
            ),
            Comparison('MAASI, recommended', 'MAASI', MEASUREMENTS.name),
        ),
        seconds=4.0,
        **printed('000-fig13'),
    )


_APART = 'MAASI, all places in view, as far apart as MAAS'


def _fig15_cases(small: bool) -> list[Case]:
    def robots(
        candidates: tuple[dict[str, Any], dict[str, Any]], periods: tuple[float, float]
    ) -> dict[str, Any]:
        return {
            'mambo': {
                'type': 'mambo',
                'start': [1.9, 1.9, 1.0],
                'candidates': candidates[0],
                'motion': MAMBO_MOTION,
                'sensor': {**MAMBO_SENSOR, 'period': periods[0]},
            },
            'turtlebot': {
                'type': 'turtlebot3_burger',
                'start': [0.0, 0.0, 0.0],
                'candidates': candidates[1],
                'sensor': {**TURTLEBOT_SENSOR, 'period': periods[1]},
            },
        }

    def case(
        name: str,
        planner: dict[str, Any],
        candidates: tuple[dict[str, Any], dict[str, Any]],
        preset: str = 'paper',
        periods: tuple[float, float] = (MAMBO_SENSOR['period'], TURTLEBOT_SENSOR['period']),
    ) -> Case:
        search_filter = _FLOOR_FILTER if preset == 'paper' else _RECOMMENDED_FILTER
        leaves = [{'at': 210.0, 'robot': 'mambo', 'do': 'leave'}]
        values = floor(
            _FLOOR_BOUNDS, robots(candidates, periods), planner, search_filter, 900.0, events=leaves
        )
        return search_case(name, values, 3000, preset, small)

    lanes = {'name': 'lawnmower', 'lane_spacing': 0.25, 'margin': 0.1}
    return [
        case('lawnmower', lanes, (_WIDE, _FINE)),
        case('MAAS', {'name': 'maas', 'alpha': 5.0}, (_RING_4, _RING_4)),
        case('MAASI', _asi(0.5, 'maasi'), (_WIDE, _FINE)),
        case('MAASI, all places in view', _asi(0.5, 'maasi'), _SEEING),
        case(_APART, _asi(0.5, 'maasi'), _SEEING, periods=(0.75, 1.4)),
        case(
            'MAASI, recommended',
            {'name': 'maasi', 'objective': 'information'},
            _SEEING,
            'recommended',
        ),
    ]


def fig15() -> Experiment:
    """Figure 15 of 000."""
    styles = {
        'lawnmower': 'lawnmower',
        'MAAS': 'as',
        'MAASI': 'asi',
        'MAASI, recommended': 'recommended',
    }

    def draw(figure: Figure, results: Results) -> None:
        figures.curves_and_path(
            figure, results, styles, 'MAASI', label='measurements of both robots'
        )

    return Experiment(
        name='000-fig15',
        title='Mambo and TurtleBot over a floor with 12 markers (simulated hardware)',
        cases=_fig15_cases,
        run=run_search,
        quantities=(MEASUREMENTS, TIME, FOUND, FALSE, RMSE),
        draw=draw,
        comparisons=(
            *(
                Comparison(name, other, quantity.name)
                for name in ('MAASI', 'MAASI, all places in view', _APART)
                for other in ('MAAS', 'lawnmower')
                for quantity in (MEASUREMENTS, TIME)
            ),
            Comparison('MAASI, recommended', 'lawnmower', MEASUREMENTS.name),
        ),
        seconds=6.0,
        **printed('000-fig15'),
    )
