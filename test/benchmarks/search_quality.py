"""Compare the planners in complete searches, and print tables in Markdown.

Conditions are in `test/benchmarks/search_quality.py`, seeds in
`test/benchmarks/quality_conditions.py`. Documents show the seeds of `report`, on which nothing is
tuned. Run the same command again to resume.
"""

import argparse
import dataclasses
import itertools
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import explained_time
from quality_conditions import RADIANS, changed, copies, robots, wanted

from maasi_sim.experiments.campaign import carry_out_all, plan, run_command
from maasi_sim.experiments.experiment import Case
from maasi_sim.experiments.searches import comparison_of, run_compared, search_settings
from maasi_sim.experiments.statistics import bootstrap_difference
from maasi_sim.experiments.tables import SearchTable, markdown_table
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.simulation.world import World

BEGIN, END = '<!-- table: begin -->', '<!-- table: end -->'
BEGIN_SHORT = '<!-- table: begin, short -->'
PAPER = {'objective': 'paper', 'alpha': 0.75, 'beta': 0.75, 'control_weight': 0.0}
CUBE, PAIR = 'ranging_drone_3d', 'ranging_pair_3d'
NEAR_3D, NEAR_FLOOR = {'ring': 6, 'distance': 30.0}, {'ring': 8, 'distance': 0.3}


class Regime(NamedTuple):
    """A kind of search; a run that does not find all counts with `limit` [s]."""

    scenario: str
    limit: float
    # Candidates of planners that measure at waypoints only.
    neighbours: dict[str, Any]
    changes: Sequence[Any] = ()
    # Further ones of the world from which the targets are drawn, where the prior is wrong.
    truth: Sequence[Any] = ()
    runs: int = 64  # most seeds


class Kind(NamedTuple):
    """A planner as it is compared: its settings, and most seeds, fewer where runs take long."""

    planner: dict[str, Any]
    runs: int = 64
    changes: Sequence[Any] = ()
    neighbours: bool = False
    maker: str | None = None


def drones(*starts):
    """Return the change of a scenario to drones that start at these places."""
    return copies('drone1', 'drone', *({'start': [*at]} for at in starts))


REGIMES = {
    'one drone': Regime(CUBE, 400.0, NEAR_3D),
    'two drones': Regime(PAIR, 250.0, NEAR_3D),
    'mambo': Regime('mambo', 150.0, NEAR_FLOOR),
    'demo': Regime('mambo_turtlebot', 200.0, NEAR_FLOOR),
    '1000 m, three drones': Regime(
        PAIR,
        900.0,
        {'ring': 8, 'distance': 50.0},
        [
            {'environment': {'bounds': [[0.0, 1000.0]] * 2}},
            drones((1.0, 1.0, 30.0), (999.0, 1.0, 30.0), (1.0, 999.0, 30.0)),
            robots(
                candidates={'grid': [10, 10], 'spacing': 100.0, 'corner': [50.0, 50.0]},
                sensor={'detection': {'size': [25.0, 25.0]}},
            ),
        ],
    ),
    'ten robots': Regime(
        PAIR,
        100.0,
        NEAR_3D,
        [drones(*[(10.0 + 25.0 * i, 130.0 + 120.0 * (-1) ** i, 1.0) for i in range(10)])],
    ),
    'two clusters': Regime(
        CUBE,
        400.0,
        NEAR_3D,
        [{'targets': {'distribution': 'clustered', 'clusters': 2, 'separation': 5.0}}],
    ),
    'radians': Regime(CUBE, 600.0, NEAR_3D, [RADIANS]),
}


def likely(side, turned=False, shifted=0.0):
    """Return a prior: 58 % of the targets in three squares, 12 % of the area."""
    parts = []
    for x, y, width in ((0.25, 0.3, 0.2), (0.7, 0.2, 0.16), (0.55, 0.8, 0.24)):
        x, y = (1.0 - x, 1.0 - y) if turned else ((x + shifted) % 1.0, y)
        ring = [(x + i * width / 2, y + j * width / 2) for i, j in CORNERS]
        text = ', '.join(f'{side * u:.3f} {side * v:.3f}' for u, v in ring)
        parts.append({'polygon': f'POLYGON (({text}))', 'weight': 10.0})
    return {'environment': {'prior': {'polygons': parts}}}


def large(squares, detection, number, prior='', battery=0.0, **wrong):
    """Return the regime of an area of so many squares of a swath (20 m), and drones at its edge.

    battery: share of a pass by one drone alone that a drone flies before it charges; 0: all.
    """
    side = 20.0 * math.sqrt(squares)
    most = round(side / 20.0)
    starts = [(side * (i + 0.5) / number, 1.0, 30.0) for i in range(number)]
    grid = {'grid': [most, most], 'spacing': side / most, 'corner': [0.5 * side / most] * 2}
    shape = {
        'step': 0.2,
        'environment': {'bounds': [[0.0, side]] * 2},
        'targets': {'separation': 5.0, 'distribution': 'prior' if prior else 'uniform'},
    }
    drone = robots(
        candidates=grid,
        motion={'speed': SPEED, 'acceleration': 5.0},
        sensor={'detection': DETECTIONS[detection]},
        **battery_for(squares, battery),
    )
    priors = [likely(side, **wrong)] if prior else []
    return Regime(
        PAIR,
        60.0 + 24.0 * squares / number,
        {'ring': 8, 'distance': 20.0},
        [shape, drones(*starts), drone, *priors],
        [likely(side)] if wrong else [],
        RUNS[squares],
    )


def battery_for(squares, share):
    """Return a battery that lasts for a share of a pass of so many squares; 0: to the limit."""
    if not share:
        return {'battery': {'capacity': 1e7}}
    power = {'idle_power': 270.0, 'motion_power': 10.0, 'charging_power': 1500.0}
    capacity = share * squares * 20.0 / SPEED * (270.0 + 10.0 * SPEED)
    use = {'per_second': 270.0 / capacity, 'per_metre': 10.0 / capacity, 'reserve': 0.1}
    return {'battery': {'capacity': capacity, **power}, 'endurance': use}


SPEED = 5.0  # of the drones of large areas [m/s]
CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))
# Both see a width of 20 m at 5 m/s, with a measurement each second: the box all of it, the other
# one half.
DETECTIONS = {
    'box': {'kind': 'box', 'lower': [-10.0] * 2, 'upper': [10.0] * 2, 'frame': 'world'},
    'exponential': {'size': [3.0, 3.0]},
}
# Most seeds of an area of so many squares.
RUNS = {30: 64, 100: 24, 300: 16, 1000: 4}
for squares, detection, prior, number in itertools.product(
    (30, 100, 300, 1000), DETECTIONS, ('', ', prior'), (1, 3, 10)
):
    name = f'{squares} squares, {detection}, {number}{prior}'
    REGIMES[name] = large(squares, detection, number, prior)
for squares in (100, 300):
    for wrong in ({'turned': True}, {'shifted': 0.25}):
        name = f'{squares} squares, box, 3, prior {next(iter(wrong))}'
        REGIMES[name] = large(squares, 'box', 3, 'prior', **wrong)
for squares, share, prior, number in itertools.product(
    (100, 300), (0.3, 0.6), ('', ', prior'), (1, 3, 10)
):
    name = f'{squares} squares, box, {number}{prior}, battery {share}'
    REGIMES[name] = large(squares, 'box', number, prior, share)
STOPS = [robots(motion={'arrival_radius': 0.0})]
# What is compared; differences are to the first one.
KINDS = {
    'before': Kind({'name': 'maasi'}, changes=STOPS),
    'lawnmower': Kind({'name': 'lawnmower'}, 16, STOPS),
    'nearest_widest': Kind({'name': 'nearest_widest'}, 32, STOPS),
    'mutual_information': Kind({'name': 'mutual_information'}, 16, STOPS, neighbours=True),
    'paper': Kind({'name': 'maasi', **PAPER}, changes=STOPS),
    'maasi': Kind({'name': 'maasi'}),
    'tour': Kind({'name': 'tour'}),
    'clairvoyant': Kind({'name': 'maasi'}, 32, maker='clairvoyant:clairvoyant'),
}


def prepared(regime, kind):
    """Return the scenario of a regime with a planner."""
    what, how = REGIMES[regime], KINDS[kind]

    def among_neighbours(content, seed):
        for robot in content['robots'].values():
            robot['candidates'] = what.neighbours
        return content

    common = {'limits': {'time': what.limit}, 'filter': {'threads': 1}, 'planner': how.planner}
    choice = [among_neighbours] if how.neighbours else []
    return changed(what.scenario, [*what.changes, common, *choice, *how.changes])


def comparison(regime, kinds):
    """Return the comparison of a regime."""
    what, cases = REGIMES[regime], []
    for kind, how in KINDS.items():
        if kind in kinds:
            settings = search_settings(prepared(regime, kind), how.maker)
            if what.truth:
                truth = changed(what.scenario, [*what.changes, *what.truth])
                settings['truth'] = truth.content()
            cases.append(Case(kind, settings, runs=min(how.runs, what.runs)))
    return dataclasses.replace(comparison_of(regime, cases), run=run_drawn)


def run_drawn(settings, seed):
    """Run a search of a case, with targets that are drawn elsewhere than it believes."""
    if 'truth' in settings:
        truth = scenario_from_values(settings['truth'], 'settings')
        world = World.from_settings(truth.environment, truth.targets, seed)
        told = {**settings['scenario'], 'targets': {'positions': world.targets.tolist()}}
        settings = {**settings, 'scenario': told}
    return run_compared(settings, seed)


def full(works):
    """Return the tables of each regime in Markdown."""
    text = ''
    for name, work in works.items():
        table = SearchTable(work.results()).markdown()
        text += f'\n**{name}** (limit {REGIMES[name].limit:g} s)\n\n{table}'
    return text


def compact(works):
    """Return tables with a row for each regime and a column for each planner, for documents."""
    text, tables = '', {name: SearchTable(work.results()) for name, work in works.items()}
    for key, words in MEANS.items():
        heads = list(dict.fromkeys(case for table in tables.values() for case in table.cases))
        rows, differences = [['regime (limit)', *heads]], [['regime', *heads[1:]]]
        for name, table in tables.items():
            cells = {case: compact_mean(table, case, key) for case in table.cases}
            regime = f'{name} ({REGIMES[name].limit:g} s)'
            rows.append([regime, *(cells.get(case, '-') for case in heads)])
            gaps = {case: gap[key] for case, gap in table.differences.items()}
            spans = {
                case: f'{gap.mean:+.3g} [{gap.low:+.3g}, {gap.high:+.3g}]'
                for case, gap in gaps.items()
            }
            differences.append([name, *(spans.get(case, '-') for case in heads[1:])])
        text += f'\n{words} [s]:\n\n{markdown_table(rows)}'
        if key == 'time' and heads[1:]:
            text += f'\nThe same minus `{heads[0]}` [s]:\n\n{markdown_table(differences)}'
    return text


def compact_mean(table, case, key):
    """Return a mean with its half width, and how many searches were complete if not all were."""
    one = table.means[case][key]
    complete, seeds = table.complete[case].number, table.means[case]['complete'].number
    some = f' ({complete}/{seeds})' if key == 'time' and complete < seeds else ''
    return f'{one.mean:.3g}±{one.half_width:.2g}{some}'


def short(works):
    """Return a table in Markdown with a row for each regime: the times to find of each planner."""
    table = []
    for name, work in works.items():
        results = work.results()
        runs = {case: len(results.runs[case]) for case in results.names()}
        cells = [name, '/'.join(map(str, dict.fromkeys(runs.values())))]
        for case, number in runs.items():
            times = (results.values(case, quantity).mean() for quantity in FOUND)
            left = number - round(results.values(case, 'complete').sum())
            some = f' ({left})' if left else ''
            cells.append('/'.join(f'{time:.0f}' for time in times) + some)
        if 'tour' in runs and 'maasi' in runs:
            ours, theirs = results.pairs('tour', 'maasi', 'most_time')
            gap, one = bootstrap_difference(ours, theirs), theirs.mean() / 100.0
            low, high = gap.low / one, gap.high / one
            cells.append(f'{gap.mean / one:+.0f} % [{low:+.0f}, {high:+.0f}]')
        table.append(cells)
    heads = ['regime', 'runs', *runs, '90 %, `tour` to `maasi`']
    return '\n' + markdown_table([heads[: len(cells)], *table])


FOUND = ('half_time', 'most_time', 'time')  # in each cell
MEANS = {'time': 'Time to find all', 'mean_time': 'Mean time to find a target'}


def main():
    parser = argparse.ArgumentParser(prog='search_quality', description=__doc__)
    kinds = f'planners to compare: {", ".join(KINDS)} (default: all)'
    parser.add_argument(
        '--planner', nargs='*', choices=KINDS, default=list(KINDS), metavar='NAME', help=kinds
    )
    folder = Path('runs/search_quality')
    kept = 'folder of the runs; runs in it are not repeated (default: %(default)s)'
    parser.add_argument('--out', type=Path, default=folder, metavar='DIR', help=kept)
    parser.add_argument('--document', type=Path, metavar='FILE', help='update the tables in FILE')
    brief = 'print one table: times [s] until half, 90 %% and all targets are found'
    parser.add_argument('--short', action='store_true', help=brief)
    why = 'print what the time until 90 %% of the targets are found is spent on'
    parser.add_argument('--explain', action='store_true', help=why)
    options, regimes, seeds = wanted(parser, REGIMES, runs=16, jobs=None)
    if options.explain:
        pairs = itertools.product(regimes, options.planner)
        works = [((regime, kind), prepared(regime, kind)) for regime, kind in pairs]
        table = [explained_time.HEAD, *explained_time.rows(works, seeds, options.jobs)]
        print(markdown_table(table))
        return 0
    plans = {
        regime: plan(comparison(regime, options.planner), options.out, len(seeds), first=seeds[0])
        for regime in regimes
    }
    problems = carry_out_all(list(plans.values()), max(options.jobs, 1))
    head = f'Block `{options.seeds}`, the first {options.runs} seeds (fewer where runs are slow).\n'
    print(head + (short(plans) if options.short else full(plans)))
    if options.document is not None:
        begin = BEGIN_SHORT if options.short else BEGIN
        before, rest = options.document.read_text(encoding='utf-8').split(begin)
        text = head + (short(plans) if options.short else compact(plans))
        page = f'{before}{begin}\n{text}{END}{rest.partition(END)[2]}'
        options.document.write_text(page, encoding='utf-8')
    return 1 if problems else 0


if __name__ == '__main__':
    sys.exit(run_command(main))
