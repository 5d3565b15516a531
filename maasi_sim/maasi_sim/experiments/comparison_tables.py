"""Results of a comparison of searches: as plain values, in Markdown and as CSV."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from scipy import stats

from maasi_sim.experiments.cases import Quantity
from maasi_sim.experiments.experiment import Results
from maasi_sim.experiments.results import csv_text, plain
from maasi_sim.experiments.statistics import LEVEL, Difference, array, bootstrap_difference
from maasi_sim.experiments.tables import interval as interval_of
from maasi_sim.experiments.tables import median
from maasi_sim.machine import code_digest, this_machine

VERSION = 1
# Bootstrap intervals of fewer pairs are too narrow.
FEWEST = 10


COMPLETE = Quantity('complete', 'complete')
TIME = Quantity('time', 'time to find all', 's')
_TIME_FOUND = Quantity('time_to_find_all', 'time to find all', 's', 'restricted')
_OTHERS = (
    Quantity('false_found', 'false found'),
    TIME,
    Quantity('mean_time', 'mean time to find', 's'),
    Quantity('measurements', 'measurements'),
    Quantity('distance', 'way', 'm'),
)
_COMPUTING = (
    Quantity('planning_time', 'decision', 's'),
    Quantity('filter_time', 'filter step', 's'),
    Quantity('processor_time', 'computation of a search', 's'),
)
QUANTITIES = (COMPLETE, *_OTHERS, *_COMPUTING)
# Columns of the table of differences.
_DIFFERENCES = (COMPLETE, *_OTHERS)
# Shown in milliseconds in Markdown.
_SHORT = ('planning_time', 'filter_time')


def share(results: Results, case: str) -> tuple[int, int, float, float]:
    """Return complete searches, searches, and the bounds of Wilson's 95 % interval of the share."""
    finished = results.values(case, COMPLETE.name)
    number = round(sum(value or 0.0 for value in finished))
    if not finished:
        return 0, 0, math.nan, math.nan
    low, high = stats.binomtest(number, len(finished)).proportion_ci(LEVEL, method='wilson')
    return number, len(finished), float(low), float(high)


def median_time(results: Results, case: str) -> float:
    """Return the median of the time to find all [s]; nan if half of the searches did not."""
    return median(array(results.values(case, _TIME_FOUND.name)), _TIME_FOUND)


def difference(results: Results, case: str, other: str, quantity: Quantity) -> Difference:
    """Return the mean of a case minus another one, on the seeds of both."""
    pairs = results.pairs(case, other)
    first, second = (array([pair[i].value(quantity.name) for pair in pairs]) for i in (0, 1))
    return bootstrap_difference(first, second)


def differences(results: Results) -> list[tuple[str, str, Quantity, Difference]]:
    """Return each case minus the first one that has searches, of all quantities."""
    names = results.names()
    return [
        (name, names[0], quantity, difference(results, name, names[0], quantity))
        for name in names[1:]
        for quantity in QUANTITIES
    ]


def verdict(case: str, other: str, gap: Difference) -> str:
    """Return in words whether the time to find all differs, and the seeds needed to show it."""
    who = f'{case} minus {other}: '
    if gap.number < 2:
        return f'{who}{gap.number} seed on which both ran, too few for an interval.'
    if gap.low == gap.high == 0.0:
        return f'{who}no difference on any of {gap.number} seeds.'
    span = f'{gap.mean:+.1f} s, 95 % from {gap.low:+.1f} to {gap.high:+.1f} s'
    if gap.told_from_zero:
        word = 'sooner' if gap.mean < 0.0 else 'later'
        few = ', too few for an interval to trust' if gap.number < FEWEST else ''
        return f'{who}{word}, {span}, on {gap.number} seeds{few}.'
    text = f'{who}{span}: {gap.number} seeds are too few to tell this from no difference'
    if gap.needed is None:
        return text + '.'
    return f'{text}; if it is as large as found, about {gap.needed} would be needed.'


def verdicts(results: Results) -> list[str]:
    """Return a sentence on the time to find all for each case but the first one."""
    return [
        verdict(case, other, gap)
        for case, other, quantity, gap in differences(results)
        if quantity is TIME
    ]


def _digits(value: float, sign: str = '') -> str:
    if not math.isfinite(value):
        return '-'
    size = abs(value)
    return f'{value:{sign}.{0 if size >= 1000.0 else 1 if size >= 10.0 else 2}f}'


def _mean(results: Results, case: str, quantity: Quantity) -> str:
    interval = interval_of(results, case, quantity)
    scale = 1e3 if quantity.name in _SHORT else 1.0
    half = f' ± {_digits(scale * interval.half_width)}' if interval.number > 1 else ''
    return _digits(scale * interval.mean) + half


def _head(quantity: Quantity) -> str:
    unit = 'ms' if quantity.name in _SHORT else quantity.unit
    return f'{quantity.label} [{unit}]' if unit else quantity.label


def markdown(results: Results) -> str:
    """Return the tables of a comparison: of cases, and of differences to the first one."""
    columns = QUANTITIES[1:]
    heads = ['case', 'seeds', 'complete', 'median time [s]', *map(_head, columns)]
    lines = [_row(heads), _row(['---'] * len(heads))]
    for name in results.names():
        number, total, low, high = share(results, name)
        cells = [name, str(total), f'{number} ({100 * low:.0f} to {100 * high:.0f} %)']
        cells.append(_digits(median_time(results, name)))
        cells += [_mean(results, name, quantity) for quantity in columns]
        lines.append(_row(cells))
    names = results.names()
    if len(names) > 1:
        heads = [f'minus {names[0]}', 'seeds', *map(_head, _DIFFERENCES)]
        lines += ['', _row(heads), _row(['---'] * len(heads))]
        for name in names[1:]:
            gaps = [difference(results, name, names[0], item) for item in _DIFFERENCES]
            cells = [
                f'{_digits(gap.mean, "+")} [{_digits(gap.low, "+")}, {_digits(gap.high, "+")}]'
                for gap in gaps
            ]
            lines.append(_row([name, str(gaps[0].number), *cells]))
    return '\n'.join(lines) + '\n'


def _row(cells: Sequence[str]) -> str:
    return f'| {" | ".join(cells)} |'


def document(every: Sequence[Results], seeds: Sequence[int]) -> str:
    """Return the page of a comparison in Markdown."""
    text = f"# Comparison of searches\n\nSeeds {seeds[0]} to {seeds[-1]}. Means with Student's "
    text += (
        "95 % interval, the share of complete searches with\nWilson's; differences on the same "
        'seeds with bootstrap intervals. A search that did not\nfind all counts with the time '
        'limit.\n'
    )
    for results in every:
        text += f'\n## {results.experiment.name}\n\n{markdown(results)}\n'
        text += ''.join(f'- {line}\n' for line in verdicts(results))
    return text + '\n![Share of searches that miss targets, and differences](comparison.png)\n'


def table_text(every: Sequence[Results]) -> str:
    """Return all means and differences as CSV, a row each, in full precision."""
    head = 'scenario case minus quantity unit seeds mean low high median needed'
    rows: list[list[Any]] = [head.split()]
    for results in every:
        scenario = results.experiment.name
        for name in results.names():
            for quantity in QUANTITIES:
                one = interval_of(results, name, quantity)
                bounds = [one.mean - one.half_width, one.mean + one.half_width]
                middle = math.nan
                if quantity is COMPLETE:
                    bounds = list(share(results, name)[2:])
                if quantity is TIME:
                    middle = median_time(results, name)
                elif one.number:
                    middle = median(array(results.values(name, quantity.name)), quantity)
                cells = [one.number, one.mean, *bounds, middle, None]
                rows.append([scenario, name, '', quantity.name, quantity.unit, *cells])
        for name, other, quantity, gap in differences(results):
            cells = [gap.number, gap.mean, gap.low, gap.high, gap.median, gap.needed]
            rows.append([scenario, name, other, quantity.name, quantity.unit, *cells])
    return csv_text(rows)


def facts(every: Sequence[Results], seeds: Sequence[int]) -> dict[str, Any]:
    """Return a comparison as plain values: searches, means, differences; none is infinite."""
    values: dict[str, Any] = plain(
        {
            'version': VERSION,
            'seeds': list(seeds),
            'code': code_digest(),
            'machine': this_machine(),
            'scenarios': {results.experiment.name: _scenario(results) for results in every},
        }
    )
    return values


def _scenario(results: Results) -> dict[str, Any]:
    cases: dict[str, Any] = {}
    for name in results.names():
        number, total, low, high = share(results, name)
        settings = results.case(name).settings['scenario']
        cases[name] = {
            'planner': settings['planner']['name'],
            'filter': settings['filter']['method'],
            'time_limit': settings['limits']['time'],
            'searches': total,
            'complete': {'number': number, 'low': low, 'high': high},
            'median_time': median_time(results, name),
            'means': {
                item.name: asdict(interval_of(results, name, item)) | {'unit': item.unit}
                for item in QUANTITIES[1:]
            },
            'runs': [
                {'seed': run.seed, **{item.name: run.value(item.name) for item in QUANTITIES}}
                for run in results.runs[name]
            ],
        }
    return {
        'cases': cases,
        'differences': [
            {
                'case': name,
                'minus': other,
                'quantity': quantity.name,
                'unit': quantity.unit,
                **asdict(gap),
                'told_from_zero': gap.told_from_zero,
            }
            for name, other, quantity, gap in differences(results)
        ],
        'verdicts': verdicts(results),
    }
