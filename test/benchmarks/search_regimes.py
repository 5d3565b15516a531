"""Regimes and planners whose whole searches are compared, as changes of scenarios."""

from __future__ import annotations

from typing import Any, NamedTuple

from quality_conditions import NOISES

from maasi_sim.experiments.searches import merged
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import Scenario

GRID_2D = {'grid': [10, 10], 'spacing': 100.0, 'corner': [50.0, 50.0]}
NEIGHBOURS_3D = {'ring': 6, 'distance': 30.0}
PAPER = {'objective': 'paper', 'alpha': 0.75, 'beta': 0.75, 'control_weight': 0.0}


class Regime(NamedTuple):
    """A kind of search; a run that does not find all counts with `limit` [s].

    `change` is merged over the scenario, its robots like the first one of the scenario;
    `neighbours` are candidates of planners that measure at waypoints only.
    """

    scenario: str
    limit: float
    change: dict[str, Any]
    neighbours: dict[str, Any]


class Kind(NamedTuple):
    """A planner as it is compared: its settings, and most seeds, fewer where runs take long.

    `stops`: robots stop at every waypoint; `neighbours`: it chooses among a regime's; `maker` makes
    the planner, as of `search`, in place of the scenario's.
    """

    change: dict[str, Any]
    runs: int = 64
    stops: bool = False
    neighbours: bool = False
    maker: str | None = None


def drones(*starts: tuple[float, float, float], **change: Any) -> dict[str, Any]:
    """Return the changes of robots drone1, drone2 and so on."""
    return {f'drone{n}': {'start': list(start), **change} for n, start in enumerate(starts, 1)}


REGIMES: dict[str, Regime] = {
    'one drone': Regime('ranging_drone_3d', 400.0, {}, NEIGHBOURS_3D),
    'two drones': Regime('ranging_pair_3d', 250.0, {}, NEIGHBOURS_3D),
    'mambo': Regime('mambo', 150.0, {}, {'ring': 8, 'distance': 0.3}),
    'demo': Regime('mambo_turtlebot', 200.0, {}, {'ring': 8, 'distance': 0.3}),
    '1000 m, three drones': Regime(
        'ranging_pair_3d',
        900.0,
        {
            'environment': {'bounds': [[0.0, 1000.0]] * 2},
            'robots': drones(
                (1.0, 1.0, 30.0),
                (999.0, 1.0, 30.0),
                (1.0, 999.0, 30.0),
                candidates=GRID_2D,
                sensor={'detection': {'size': [25.0, 25.0]}},
            ),
        },
        {'ring': 8, 'distance': 50.0},
    ),
    'ten robots': Regime(
        'ranging_pair_3d',
        100.0,
        {'robots': drones(*[(10.0 + 25.0 * i, 130.0 + 120.0 * (-1) ** i, 1.0) for i in range(10)])},
        NEIGHBOURS_3D,
    ),
    'two clusters': Regime(
        'ranging_drone_3d',
        400.0,
        {'targets': {'distribution': 'clustered', 'clusters': 2, 'separation': 5.0}},
        NEIGHBOURS_3D,
    ),
    'radians': Regime(
        'ranging_drone_3d',
        600.0,
        {'robots': {'drone': {'sensor': {'noise': NOISES['radians'].model_dump(by_alias=True)}}}},
        NEIGHBOURS_3D,
    ),
}

KINDS: dict[str, Kind] = {
    'lawnmower': Kind({'name': 'lawnmower'}, runs=16, stops=True),
    'nearest_widest': Kind({'name': 'nearest_widest'}, runs=32, stops=True),
    'mutual_information': Kind({'name': 'mutual_information'}, 16, stops=True, neighbours=True),
    'paper': Kind({'name': 'maasi', **PAPER}, stops=True),
    'before': Kind({'name': 'maasi'}, stops=True),
    'maasi': Kind({'name': 'maasi'}),
    'clairvoyant': Kind({'name': 'maasi'}, runs=32, maker='clairvoyant:clairvoyant'),
}


def prepared(regime: str, kind: str) -> Scenario:
    """Return the scenario of a regime with a planner."""
    what, how = REGIMES[regime], KINDS[kind]
    content = load_scenario(what.scenario).model_dump(by_alias=True, exclude_unset=True)
    change = dict(what.change)
    robots = change.pop('robots', {})
    like = next(iter(content['robots'].values()))
    if len(robots) > 1:
        content['robots'] = dict.fromkeys(robots, like)
    limits = {'limits': {'time': what.limit}, 'filter': {'threads': 1}}
    content = merged(content, change, {'robots': robots}, limits)
    # Searches end when all is found or at the limit, not when nothing is left to explore.
    never_done = {'explored_threshold': 1.0, 'gain_threshold': 0.0}
    content['planner'] = merged(content['planner'], never_done, how.change)
    for robot in content['robots'].values():
        if how.neighbours:
            robot['candidates'] = what.neighbours
        if how.stops:
            robot['motion'] = merged(robot['motion'], {'arrival_radius': 0.0})
    return Scenario.model_validate(content)
