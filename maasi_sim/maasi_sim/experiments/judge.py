"""External benchmarks: SAREnv's evaluator, terrains and victims, its planners next to ours."""

import argparse
import json
import logging
import multiprocessing
import random
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from shapely.errors import ShapelyError

from maasi_planner.planners.orienteering import plan_routes
from maasi_sim.arguments import Parser, count, positive, whole
from maasi_sim.experiments.campaign import DONE, SOME_FAILED, WRONG_INPUT
from maasi_sim.experiments.claims import with_summary
from maasi_sim.experiments.experiment import WrongInput
from maasi_sim.experiments.judge_oplib import (
    EFFORTS,
    euclidean,
    evaluate_instance,
    instances,
    oplib_page,
)
from maasi_sim.experiments.runs import NoRoom, write_file
from maasi_sim.experiments.tables import markdown_table

Array = NDArray[Any]
Result = dict[str, Any]

DRONES, SIZE = 5, 'medium'
BASELINES = ('Greedy', 'Spiral', 'Concentric', 'Pizza')
FREE, CENTRE, BOUND = 'maasi, free start', 'maasi, from the centre', 'best squares of the heatmap'
# What SAREnv has published for five drones: means [%] of the baselines by class and budget [km].
PUBLISHED = {
    'flat, temperate': {100.0: (49.2, 63.1, 63.7, 58.7), 300.0: (79.9, 97.9, 100.0, 100.0)},
    'flat, dry': {100.0: (40.3, 45.2, 41.8, 36.7), 300.0: (64.5, 99.0, 97.8, 97.8)},
    'mountainous, temperate': {100.0: (22.3, 19.7, 19.5, 22.9), 300.0: (47.7, 64.7, 62.7, 64.2)},
    'mountainous, dry': {100.0: (18.5, 19.0, 19.9, 16.9), 300.0: (42.2, 56.5, 56.6, 56.5)},
}
GOALS = {100.0: 10.0, 300.0: 5.0}  # points of a free start above the best baseline, by budget [km]
FLOOR = 0.02  # share of the victims that may be anywhere, as in the planner's prior
_FEATURES, _HEATMAP = 'features.geojson', 'heatmap.npy'
_KEYS = ('center_point', 'meter_per_bin', 'bounds', 'climate', 'environment_type', 'features')


def toolkit() -> Any:
    """Return the module of SAREnv's evaluator; WrongInput is raised where it is not installed."""
    try:
        module = import_module('sarenv.analytics.evaluator')
    except ImportError as error:
        raise WrongInput(f'SAREnv is not installed ({error}); docs/judge.md says how') from None
    logging.getLogger('sarenv').setLevel(logging.ERROR)
    return module


def disc_cells(heat: Array, bounds: Sequence[float], side: float) -> tuple[Array, Array]:
    """Return the cells of a terrain's disc: centres (n, 2) [m] and prior (n,), of sum 1.

    `heat` has a row for each northing, from the south, and fills `bounds` [m]: west, south, east,
    north. The prior is the heat, and everywhere in the disc the floor.
    """
    low, high = np.reshape(bounds, (2, 2))
    rows, columns = (_axis(low[axis], high[axis], heat.shape[1 - axis], side) for axis in (1, 0))
    disc = np.hypot(rows[0][:, None], columns[0]) <= (high[0] - low[0]) / 2.0
    prior = (1.0 - FLOOR) * heat / heat.sum() + FLOOR * disc / disc.sum()
    in_cells = rows[2] @ prior @ columns[2].T
    middles = np.stack(np.meshgrid(columns[1], rows[1]), axis=-1) + (low + high) / 2.0
    return middles[in_cells > 0.0], in_cells[in_cells > 0.0]


def _axis(low: float, high: float, cells: int, side: float) -> tuple[Array, Array, Array]:
    """Return the centres of heat cells and disc cells [m], and each heat cell's shares in them."""
    edges = np.linspace(low - high, high - low, cells + 1) / 2.0
    number = int(np.ceil((high - low) / side))
    borders = side * (np.arange(number + 1) - number / 2.0)
    left = np.maximum(borders[:-1, None], edges[:-1])
    right = np.minimum(borders[1:, None], edges[1:])
    shares = np.maximum(right - left, 0.0) / np.diff(edges)
    return edges[:-1] + np.diff(edges) / 2.0, borders[:-1] + side / 2.0, shares


def our_routes(swath: float, free: bool, **task: Any) -> list[Any]:
    """Return our routes as one of SAREnv's path generators, of which `task` has the arguments.

    With `free` one route is cut into equal parts, else all begin at the middle of the disc. Nodes
    are one swath [m] apart, or closer where the budget suffices to see each cell as a whole.
    """
    drones, budget, line = task['num_drones'], task['budget'], toolkit().LineString
    apart = np.pi * task['max_radius'] ** 2 / budget
    side = float(np.clip(apart, swath / np.sqrt(2.0), swath))
    nodes, prizes = disc_cells(task['probability_map'], task['bounds'], side)
    # GEOS cannot unite swaths with edges that are equal but for rounding.
    nodes = nodes.round(3)
    if free:
        [order] = plan_routes(nodes, prizes, None, np.array([budget]))
        return list(toolkit().paths.split_path_for_drones(line(nodes[order]), drones))
    middle = np.reshape(task['bounds'], (2, 2)).mean(axis=0)
    starts = np.tile(middle, (drones, 1))
    orders = plan_routes(nodes, prizes, starts, np.full(drones, budget / drones))
    return [line(np.vstack([middle, nodes[order]])) for order in orders if len(order)]


class Terrain:
    """A terrain in SAREnv's own evaluator, with seeded victims, and ours among its planners."""

    def __init__(self, folder: Path, victims: int, seed: int) -> None:
        _check_files(folder)
        tools, self._seed = toolkit(), seed
        # SAREnv draws victims from the two global generators, which imports use too.
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002
        evaluator = tools.ComparativeEvaluator(str(folder), [SIZE], DRONES, victims)
        item, points = (evaluator.environments[SIZE][key] for key in ('item', 'victims'))
        if len(points) == 0:
            raise ValueError(f'{_FEATURES}: no victim can be drawn from it')
        self._evaluator, self._config = evaluator, evaluator.path_generator_config
        half_angle = np.radians(self._config.fov_degrees / 2.0)
        self._swath = float(2.0 * self._config.altitude_meters * np.tan(half_angle))
        known, make = evaluator.path_generators, tools.PathGenerator
        ours = {name: partial(our_routes, self._swath, name == FREE) for name in (FREE, CENTRE)}
        evaluator.path_generators = {name: known[name] for name in BASELINES} | {
            name: make(name, function, self._config) for name, function in ours.items()
        }
        self._kind = f'{item.environment_type}, {item.environment_climate}'
        middles, self._prior = disc_cells(item.heatmap, item.bounds, self._swath)
        xy = np.column_stack([points.geometry.x, points.geometry.y])
        self._cell_of_victim = cKDTree(middles).query(xy)[1]

    def evaluate(self, budgets: Sequence[float]) -> Result:
        """Return the shares [%] of victims; `unpromised` of those with less heat than floor."""
        promised = self._prior[self._cell_of_victim]
        return {
            'class': self._kind,
            'victims': len(promised),
            'unpromised': 100.0 * float(np.mean(promised < 2.0 * FLOOR * self._prior.mean())),
            'found': {f'{budget:g}': self._found(budget) for budget in budgets},
        }

    def _found(self, budget: float) -> dict[str, float]:
        self._config.budget = 1000.0 * budget
        make = np.random.default_rng
        # Greedy breaks ties by a generator of its own.
        with patch.object(np.random, 'default_rng', lambda *given: make(*given or [self._seed])):
            table, _ = self._evaluator.run_baseline_evaluations()
        names, lengths = table['Algorithm'], table['Total Path Length (km)']
        if longest := [name for name, km in zip(names, lengths) if km > 1.0001 * budget]:
            raise ValueError(f'{", ".join(longest)}: routes longer than {budget:g} km')
        # The area that is swept by straight lines, which no other routes exceed.
        number = int(np.ceil(self._config.budget / self._swath + DRONES * np.pi / 4.0))
        best = np.argsort(-self._prior, kind='stable')[:number]
        share = 100.0 * float(np.isin(self._cell_of_victim, best).mean())
        return dict(zip(names, map(float, table['Victims Found (%)']))) | {BOUND: share}


def _check_files(folder: Path) -> None:
    """Raise ValueError for files that SAREnv cannot read, or of which the shapes do not fit."""
    for name in (_FEATURES, _HEATMAP):
        with (folder / name).open('rb') as stream:
            if b'git-lfs' in stream.read(40):
                raise ValueError(f'{name} is a large-file pointer; `git lfs pull` brings the file')
    facts = json.loads((folder / _FEATURES).read_text(encoding='utf-8'))
    missing = [key for key in _KEYS if key not in facts]
    if missing:
        raise ValueError(f'{_FEATURES} lacks {", ".join(missing)}')
    heat = np.load(folder / _HEATMAP)
    low, high = np.reshape(facts['bounds'], (2, 2))
    wanted = ((high - low) / facts['meter_per_bin'])[::-1]
    if heat.ndim != 2 or np.any(np.abs(heat.shape - wanted) > 1.0):
        need = tuple(wanted.round().astype(int).tolist())
        raise ValueError(f'{_HEATMAP}: read shape {heat.shape}, its bounds need {need}')
    if not (np.all(heat >= 0.0) and 0.0 < heat.sum() < np.inf):
        raise ValueError(f'{_HEATMAP}: allowed are finite numbers from 0, not all of them 0')


def assess_terrain(folder: Path, budgets: Sequence[float], victims: int, seed: int) -> Result:
    """Return what was measured on one terrain, or as `refused` why nothing was."""
    try:
        result = Terrain(folder, victims, seed).evaluate(budgets)
    except FileNotFoundError as error:
        result = {'refused': f'{Path(error.filename).name} is missing'}
    except (OSError, ValueError, LookupError, ShapelyError) as error:
        result = {'refused': str(error)}
    return {'terrain': folder.name, **result}


def class_means(evaluated: Sequence[Result], budget: float) -> dict[str, float]:
    """Return each row's share [%]: the mean over classes of the means over their terrains."""
    kinds: dict[str, list[dict[str, float]]] = {}
    for one in evaluated:
        kinds.setdefault(one['class'], []).append(one['found'][f'{budget:g}'])
    return {
        name: float(np.mean([np.mean([found[name] for found in kind]) for kind in kinds.values()]))
        for name in (*BASELINES, FREE, CENTRE, BOUND)
    }


def page(results: Sequence[Result], budgets: Sequence[float], seed: int) -> str:
    """Return the tables in Markdown: means over the classes of terrain, then each terrain."""
    evaluated = [one for one in results if 'refused' not in one]
    kinds = [one['class'] for one in evaluated]
    numbers = '; '.join(f'{kinds.count(kind)} {kind}' for kind in sorted(set(kinds)))
    rows = [['routes'], *([name] for name in (*BASELINES, FREE, CENTRE, BOUND))]
    parts = []
    for budget in budgets:
        means = class_means(evaluated, budget)
        rows[0] += [f'{budget:g} km, published', f'{budget:g} km, measured']
        for row in rows[1:]:
            row += [_published(budget, row[0], set(kinds)), f'{means[row[0]]:.1f}']
        parts += [_verdict(budget, means), _each(evaluated, budget)]
    parts += [
        f'Not evaluated: {one["terrain"]}, {one["refused"]}' for one in results if 'refused' in one
    ]
    victims = min(one['victims'] for one in evaluated)
    head = (
        f'{len(evaluated)} terrains ({numbers}),\n{victims} victims on each, seed {seed}. '
        'Share of victims found [%], mean over the classes of terrain:\n'
    )
    return '\n'.join([head, markdown_table(rows), *parts])


def _published(budget: float, name: str, kinds: set[str]) -> str:
    rows = [PUBLISHED.get(kind, {}).get(budget) for kind in kinds]
    if name not in BASELINES or None in rows:
        return ''
    return f'{np.mean([row[BASELINES.index(name)] for row in rows if row]):.1f}'


def _verdict(budget: float, means: dict[str, float]) -> str:
    best = max(means[name] for name in BASELINES)
    gaps = ', '.join(f'{name} {means[name] - best:+.1f}' for name in (FREE, CENTRE))
    goal = GOALS.get(budget, -np.inf)
    met = f'; goal {goal:g}: {"met" if means[FREE] - best >= goal else "missed"}'
    return f'{budget:g} km, points above the best baseline: {gaps}{met * (budget in GOALS)}.\n'


def _each(evaluated: Sequence[Result], budget: float) -> str:
    rows = [['terrain', 'class', 'best baseline', FREE, CENTRE, BOUND, 'unpromised', 'lost']]
    for one in evaluated:
        found = one['found'][f'{budget:g}']
        best = max(BASELINES, key=lambda name: found[name])
        shares = [found[best], found[FREE], found[CENTRE], found[BOUND], one['unpromised']]
        lost = f'to {best}' if found[FREE] < found[best] else ''
        rows.append([one['terrain'], one['class'], *(f'{share:.1f}' for share in shares), lost])
    return markdown_table(rows)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = Parser(
        prog='judge',
        description="Evaluate the tour planner's paths with SAREnv (its evaluator, terrains, "
        'victims and baseline planners) or on the instances of OPLib.',
        epilog='Exit codes: 0 all evaluated, 1 some refused, 2 wrong input.',
    )
    add = parser.add_argument
    add('judge', choices=['sarenv', 'oplib'], help='external benchmark')
    add(
        '--data',
        type=Path,
        required=True,
        metavar='FOLDER',
        help="SAREnv's folder 'sarenv_dataset', or a clone of OPLib",
    )
    add('--terrains', nargs='+', metavar='NAME', help='folders or instances in it (default: all)')
    add(
        '--budget',
        nargs='+',
        type=positive,
        default=[*GOALS],
        metavar='KM',
        help='total path length of all drones [km] (default: 100 and 300)',
    )
    text = 'factors on the tries of the search, OPLib (default: 0.5 and 5)'
    add('--effort', nargs='+', type=positive, default=[*EFFORTS], metavar='X', help=text)
    text = 'victims on each terrain (default: %(default)s)'
    add('--victims', type=count, default=1000, metavar='N', help=text)
    text = 'random seed of the victims (default: %(default)s)'
    add('--seed', type=whole, default=1, metavar='N', help=text)
    add('--jobs', type=count, default=1, metavar='N', help='run N processes (default: %(default)s)')
    add('--out', type=Path, metavar='DIR', help='write judge.json into this folder')
    add('--document', type=Path, metavar='FILE', help='update the tables in this document')
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    options = build_parser().parse_args(arguments)
    try:
        return judge(options)
    except (WrongInput, NoRoom) as error:
        print(f'error: {error}', file=sys.stderr)
        return WRONG_INPUT


def judge(options: argparse.Namespace) -> int:
    """Evaluate terrains or instances, write what is asked for, and return the exit code."""
    if options.judge == 'oplib':
        folders = _instances(options.data, options.terrains)
        one = partial(evaluate_instance, efforts=options.effort)
    else:
        toolkit()
        folders = _folders(options.data, options.terrains)
        one = partial(
            assess_terrain, budgets=options.budget, victims=options.victims, seed=options.seed
        )
    results = []
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context('spawn')) as pool:
        for result in pool.map(one, folders):
            print(json.dumps(result), file=sys.stderr, flush=True)
            results.append(result)
    refused = [result for result in results if 'refused' in result]
    if len(refused) == len(results):
        raise WrongInput(f'{folders[0]}: {refused[0]["refused"]}; none could be evaluated')
    if options.judge == 'oplib':
        text, name, facts = oplib_page(results, options.effort), 'oplib', {'instances': results}
    else:
        text, name = page(results, options.budget, options.seed), 'judge'
        facts = {'seed': options.seed, 'terrains': results}
    print(text)
    if options.out is not None:
        write_file(options.out / 'judge.json', json.dumps(facts, indent=1) + '\n')
    if options.document is not None:
        before = options.document.read_text(encoding='utf-8')
        write_file(options.document, with_summary(before, text, name))
    return SOME_FAILED if refused else DONE


def _instances(data: Path, names: list[str] | None) -> list[Path]:
    known = instances(data)
    wrong = [name for name in names or [] if name not in known]
    if wrong or not known:
        raise WrongInput(f'{data}: no {", ".join(wrong) or "instances of OPLib"} there')
    # By default those whose distances are Euclidean, of a size that is evaluated.
    return [known[name] for name in names] if names else euclidean(known)


def _folders(data: Path, names: list[str] | None) -> list[Path]:
    known = {path.parent.name: path.parent for path in sorted(data.glob(f'*/{_HEATMAP}'))}
    chosen = names or sorted(known, key=lambda name: (len(name), name))
    wrong = [name for name in chosen if name not in known]
    if wrong or not chosen:
        raise WrongInput(f'{data}: no {_HEATMAP} in {", ".join(wrong) or "any folder there"}')
    return [known[name] for name in chosen]


if __name__ == '__main__':
    sys.exit(main())
