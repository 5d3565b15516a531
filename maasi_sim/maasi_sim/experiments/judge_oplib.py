"""Instances of OPLib for orienteering: the planner's paths next to EA4OP's solutions."""

import re
from collections.abc import Sequence
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_planner.planners.orienteering import plan_routes
from maasi_sim.experiments.tables import markdown_table

Array = NDArray[Any]
Result = dict[str, Any]

EFFORTS = (0.5, 5.0)
# Classes by the number of nodes; instances with more are not evaluated.
CLASSES = (200, 1100)
_SUFFIX = '.oplib'


def instances(data: Path) -> dict[str, Path]:
    """Return the instances of a clone of OPLib by name."""
    return {path.stem: path for path in sorted(data.glob(f'instances/*/*{_SUFFIX}'))}


def read_instance(path: Path) -> tuple[Array, Array, float]:
    """Return the nodes (n, 2), of which the first is start and end, their scores and the limit.

    ValueError is raised for what cannot be read, and where distances are not Euclidean.
    """
    text = path.read_text(encoding='ascii')
    head = dict(re.findall(r'^(\w+)\s*:\s*(\S+)', text, re.MULTILINE))
    if (kind := head.get('EDGE_WEIGHT_TYPE')) != 'EUC_2D':
        raise ValueError(f'EDGE_WEIGHT_TYPE: read {kind}, allowed is EUC_2D')
    rows = [_section(text, f'{name}_SECTION') for name in ('NODE_COORD', 'NODE_SCORE')]
    number, limit = int(head.get('DIMENSION', 0)), float(head.get('COST_LIMIT', 'nan'))
    if [row.shape for row in rows] != [(number, 3), (number, 2)] or not limit > 0.0:
        raise ValueError('DIMENSION, COST_LIMIT and the sections do not fit')
    return rows[0][:, 1:], rows[1][:, 1], limit


def euclidean(known: dict[str, Path]) -> list[Path]:
    """Return the instances that are evaluated unless others are named."""
    chosen = []
    for path in known.values():
        try:
            if len(read_instance(path)[0]) <= CLASSES[-1]:
                chosen.append(path)
        except ValueError:
            continue
    return chosen


def _section(text: str, name: str) -> Array:
    lines = text.partition(f'\n{name}')[2].splitlines()[1:]
    rows: list[list[float]] = []
    for line in lines:
        if re.match(r'[A-Za-z]|-1\s*$', line):
            break
        rows.append([float(word) for word in line.split()])
    return np.array(rows)


def evaluate_instance(path: Path, efforts: Sequence[float]) -> Result:
    """Return scores and times [s] of an instance, or as `refused` the reason that there are none.

    `gaps` are those to EA4OP's score [%], with the efforts as keys; the path is within the limit
    by distances that are not rounded.
    """
    result: Result = {'instance': path.stem, 'generation': path.parent.name}
    solution = path.parents[2] / 'solutions' / 'ea4op' / path.parent.name / f'{path.stem}.sol'
    try:
        nodes, scores, limit = read_instance(path)
        text = solution.read_text(encoding='ascii')
        theirs = float(re.findall(r'^ROUTE_SCORE\s*:\s*(\S+)', text, re.MULTILINE)[0])
    except FileNotFoundError as error:
        return result | {'refused': f'{Path(error.filename).name} is missing'}
    except (ValueError, IndexError) as error:
        return result | {'refused': str(error) or 'wrong format'}
    result |= {'nodes': len(nodes), 'ea4op': theirs, 'gaps': {}, 'seconds': {}}
    # Compiles what is not compiled yet.
    plan_routes(nodes[1:4], np.ones(len(nodes[1:4])), nodes[:1], np.array([limit]), nodes[:1])
    for effort in efforts:
        begun = process_time()
        [order] = plan_routes(
            nodes[1:], scores[1:], nodes[:1], np.array([limit]), nodes[:1], effort=effort
        )
        result['seconds'][f'{effort:g}'] = process_time() - begun
        path_of = np.vstack([nodes[:1], nodes[1:][order], nodes[:1]])
        length = float(np.linalg.norm(np.diff(path_of, axis=0), axis=1).sum())
        if len(set(order)) < len(order) or length > limit * (1.0 + 1e-9):
            return result | {'refused': f'path of {length:g}, allowed up to {limit:g}'}
        score = float(scores[0] + scores[1:][order].sum())
        result['gaps'][f'{effort:g}'] = 100.0 * (score / theirs - 1.0)
    return result


def oplib_page(results: Sequence[Result], efforts: Sequence[float]) -> str:
    """Return the tables in Markdown: by generation and class, then the worst instances."""
    evaluated = [one for one in results if 'refused' not in one]
    rows = [['generation', 'nodes', 'instances']]
    for effort in efforts:
        rows[0] += [f'{text}, effort {effort:g}' for text in ('mean [%]', 'worst [%]', 'time [s]')]
    for generation in sorted({one['generation'] for one in evaluated}):
        for least, most in zip((0, *CLASSES), (*CLASSES, np.inf)):
            group = [
                one
                for one in evaluated
                if one['generation'] == generation and least < one['nodes'] <= most
            ]
            if not group:
                continue
            sizes = [one['nodes'] for one in group]
            rows.append([generation, f'{min(sizes)} to {max(sizes)}', f'{len(group)}'])
            for effort in efforts:
                gaps, times = (
                    [one[key][f'{effort:g}'] for one in group] for key in ('gaps', 'seconds')
                )
                rows[-1] += [f'{np.mean(gaps):+.1f}', f'{min(gaps):+.1f}', f'{np.mean(times):.2f}']
    last = f'{efforts[-1]:g}'
    worst = sorted(evaluated, key=lambda one: float(one['gaps'][last]))[:3]
    names = ', '.join(f'{one["instance"]} {one["gaps"][last]:+.1f}' for one in worst)
    refused = [
        f'Not evaluated: {one["instance"]}, {one["refused"]}' for one in results if 'refused' in one
    ]
    head = f'{len(evaluated)} instances. Score against EA4OP, mean times of one core:\n'
    return '\n'.join(
        [head, markdown_table(rows), f'Worst, effort {last} [%]: {names}.\n', *refused]
    )
