"""Tables: of our results beside the papers', and of comparisons of searches."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import stats

from maasi_sim.experiments.experiment import Published, Quantity, Results, plain
from maasi_sim.experiments.runs import csv_text
from maasi_sim.experiments.statistics import (
    LEVEL,
    Difference,
    Interval,
    bootstrap_difference,
    from_published,
    independent_difference,
    mean_interval,
    paired_difference,
)
from maasi_sim.machine import code_digest, this_machine

# Version of comparison.json.
VERSION = 1
# Bootstrap intervals of fewer pairs are too narrow.
FEWEST = 10
_NONE = mean_interval([])


def interval(results: Results, case: str, quantity: Quantity) -> Interval:
    """Return the mean of a quantity over the runs of a case."""
    values = results.values(case, quantity.name)
    if quantity.kind == 'mean':
        return mean_interval(values)
    limits = results.values(case, quantity.limit)
    # All that is censored reached a limit, so that this is the area under the survival curve.
    return mean_interval(np.minimum(np.where(np.isnan(values), limits, values), limits.min()))


def median(values: np.ndarray, quantity: Quantity) -> float:
    """Return the median of a quantity; unfinished durations count as longest."""
    if quantity.kind == 'restricted':
        middle = float(np.median(np.where(np.isnan(values), np.inf, values)))
        return middle if math.isfinite(middle) else math.nan
    return float(np.nanmedian(values))


def markdown_table(rows: Iterable[Sequence[str]]) -> str:
    """Return rows in Markdown, the first of which holds the heads."""
    head, *lines = (f'| {" | ".join(cells)} |\n' for cells in rows)
    return f'{head}|{"---|" * (head.count(" | ") + 1)}\n{"".join(lines)}'


# Of an experiment, beside the paper.


@dataclass(frozen=True)
class Row:
    """One number of ours beside the paper's, or a paired difference on the same maps.

    `finished` of the `runs` have the quantity; `median` counts the others as longest, and is nan
    if they are half or more. `difference` is ours minus the paper's, or first minus second.
    """

    case: str
    preset: str
    quantity: Quantity
    runs: int
    finished: int
    ours: Interval
    median: float
    paper: Interval | None
    difference: Interval | None
    note: str


def rows(results: Results) -> list[Row]:
    """Return the table of an experiment: every quantity of every case."""
    experiment = results.experiment
    published = {(item.case, item.quantity): item for item in experiment.published}
    table = []
    for name in results.names():
        preset = results.case(name).preset
        for quantity in experiment.quantities:
            theirs = published.get((name, quantity.name))
            row = _row(results, name, preset, quantity, theirs)
            if row.finished or quantity.kind == 'restricted':
                table.append(row)
    return table


def _row(
    results: Results, case: str, preset: str, quantity: Quantity, theirs: Published | None
) -> Row:
    values = results.values(case, quantity.name)
    finished = int((~np.isnan(values)).sum())
    ours = interval(results, case, quantity)
    paper = difference = None
    if theirs is not None:
        paper = from_published(theirs.value, theirs.half_width, theirs.runs)
        difference = independent_difference(ours, paper) if finished else None
    middle = median(values, quantity) if finished else math.nan
    note = theirs.note if theirs else ''
    return Row(case, preset, quantity, len(values), finished, ours, middle, paper, difference, note)


def paired_rows(results: Results) -> list[Row]:
    """Return the paired differences of the experiment's comparisons."""
    table = []
    for item in results.experiment.comparisons:
        quantity = results.experiment.quantity(item.quantity)
        both = results.pairs(item.first, item.second, item.quantity)
        if not len(both[0]):
            continue
        if quantity.kind == 'restricted':
            limit = float(np.min(results.pairs(item.first, item.second, quantity.limit)))
            both = [np.minimum(np.where(np.isnan(one), limit, one), limit) for one in both]
        gap, who = paired_difference(*both), f'{item.first} minus {item.second}'
        note = 'paired on the same maps'
        row = Row(who, 'paired', quantity, gap.number, gap.number, _NONE, math.nan, None, gap, note)
        table.append(row)
    return table


def number(value: float) -> str:
    """Return a number with three significant digits."""
    if not math.isfinite(value):
        return '-'
    if abs(value) >= 100.0:
        return f'{value:.0f}'
    return f'{value:.3g}' if value else '0'


def shown(value: Interval | None, sign: bool = False) -> str:
    """Return a mean with its half width."""
    if value is None or not math.isfinite(value.mean):
        return '-'
    text = ('+' if sign and value.mean > 0.0 else '') + number(value.mean)
    return f'{text} ± {number(value.half_width)}' if math.isfinite(value.half_width) else text


def table_cells(results: Results) -> list[list[list[str]]]:
    """Return the tables of an experiment as text: of cases, and of paired differences."""
    cases = [['case', 'measured', 'runs', 'ours', 'paper', 'difference']]
    for row in rows(results):
        restricted = row.quantity.kind == 'restricted'
        runs = str(row.runs)
        if restricted or row.finished < row.runs:
            runs = f'{row.finished} of {row.runs}'
        # Without finished runs the restricted mean is the limit.
        ours = shown(row.ours) if row.finished else f'more than {number(row.ours.mean)}'
        if restricted and row.runs > 2 and math.isfinite(row.median):
            ours += f' (median {number(row.median)})'
        paper = shown(row.paper) + (f' ({row.note})' if row.note else '')
        name = row.case if row.preset == 'paper' else f'{row.case} (recommended)'
        gap = shown(row.difference, sign=True)
        cases.append([name, row.quantity.title(), runs, ours, paper, gap])
    pairs = [['paired on the same maps', 'measured', 'maps', 'difference']]
    for row in paired_rows(results):
        gap = shown(row.difference, sign=True)
        pairs.append([row.case, row.quantity.title(), str(row.runs), gap])
    return [table for table in (cases, pairs) if len(table) > 1]


def by_case(table: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return the table of cases of `table_cells` with a row a case and a column a quantity."""
    quantities = list(dict.fromkeys(row[1] for row in table[1:]))
    found: dict[str, dict[str, str]] = {}
    for case, quantity, runs, ours, paper, gap in table[1:]:
        cells = found.setdefault(case, {'runs': runs.rpartition(' of ')[2]})
        finished, _, total = runs.partition(' (')[0].partition(' of ')
        parts = [ours if finished in (total, '0') or not total else f'{ours}, {finished} runs']
        if paper != '-':
            parts.append(f'paper {paper}')
        if gap != '-':
            parts.append(f'difference {gap}')
        cells[quantity] = '<br>'.join(parts)
    columns = ['runs', *quantities]
    rows = [[case, *(cells.get(name, '-') for name in columns)] for case, cells in found.items()]
    return [['case', *columns], *rows]


def table_text(results: Results) -> str:
    """Return the table of ours against the paper's as CSV, in full precision."""

    def pair(item: Interval | None) -> list[float | None]:
        return [None, None] if item is None else [item.mean, item.half_width]

    head = 'case preset quantity unit runs finished ours ours_95 ours_median paper paper_95'
    table: list[list[object]] = [[*head.split(), 'difference', 'difference_95', 'note']]
    for row in [*rows(results), *paired_rows(results)]:
        first = [row.case, row.preset, row.quantity.name, row.quantity.unit, row.runs, row.finished]
        if row.preset == 'paired':
            first[0], first[-1] = row.case.replace(' minus ', ' - '), None
        cells = [*pair(row.ours), row.median, *pair(row.paper), *pair(row.difference)]
        table.append([*first, *cells, row.note])
    return csv_text(table)


# Of a comparison of searches.

COMPLETE = Quantity('complete', 'complete')
TIME = Quantity('time', 'time to find all', 's')
_TIME_FOUND = Quantity('time_to_find_all', 'time to find all', 's', 'restricted')
# Those of the table of differences.
_COMPARED = (
    COMPLETE,
    Quantity('false_found', 'false found'),
    TIME,
    Quantity('mean_time', 'mean time to find', 's'),
    Quantity('measurements', 'measurements'),
    Quantity('distance', 'way', 'm'),
)
QUANTITIES = (
    *_COMPARED,
    Quantity('planning_time', 'decision', 's'),
    Quantity('filter_time', 'filter step', 's'),
    Quantity('processor_time', 'computation of a search', 's'),
)
# Shown in milliseconds in Markdown.
_SHORT = ('planning_time', 'filter_time')


def share(results: Results, case: str) -> tuple[int, int, float, float]:
    """Return complete searches, searches, and the bounds of Wilson's 95 % interval of the share."""
    finished = results.values(case, COMPLETE.name)
    complete = round(float(finished.sum()))
    if not len(finished):
        return 0, 0, math.nan, math.nan
    low, high = stats.binomtest(complete, len(finished)).proportion_ci(LEVEL, method='wilson')
    return complete, len(finished), float(low), float(high)


def median_time(results: Results, case: str) -> float:
    """Return the median of the time to find all [s]; nan if half of the searches did not."""
    return median(results.values(case, _TIME_FOUND.name), _TIME_FOUND)


def difference(results: Results, case: str, quantity: Quantity) -> Difference:
    """Return the mean of a case minus the first one that has searches, on the seeds of both."""
    return bootstrap_difference(*results.pairs(case, results.names()[0], quantity.name))


def verdicts(results: Results) -> list[str]:
    """Return a sentence on the time to find all for each case but the first one."""
    names = results.names()
    return [verdict(name, names[0], difference(results, name, TIME)) for name in names[1:]]


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


def _digits(value: float, sign: str = '') -> str:
    if not math.isfinite(value):
        return '-'
    size = abs(value)
    return f'{value:{sign}.{0 if size >= 1000.0 else 1 if size >= 10.0 else 2}f}'


def _mean(results: Results, case: str, quantity: Quantity) -> str:
    mean = interval(results, case, quantity)
    scale = 1e3 if quantity.name in _SHORT else 1.0
    half = f' ± {_digits(scale * mean.half_width)}' if mean.number > 1 else ''
    return _digits(scale * mean.mean) + half


def _gap(gap: Difference) -> str:
    return f'{_digits(gap.mean, "+")} [{_digits(gap.low, "+")}, {_digits(gap.high, "+")}]'


def compared_markdown(results: Results) -> str:
    """Return the tables of a comparison: of cases, and of differences to the first one."""
    heads = [item.title('ms' if item.name in _SHORT else None) for item in QUANTITIES]
    table = [['case', 'seeds', 'complete', 'median time [s]', *heads[1:]]]
    names = results.names()
    for name in names:
        complete, total, low, high = share(results, name)
        cells = [name, str(total), f'{complete} ({100 * low:.0f} to {100 * high:.0f} %)']
        means = [_mean(results, name, quantity) for quantity in QUANTITIES[1:]]
        table.append([*cells, _digits(median_time(results, name)), *means])
    tables = [table]
    if len(names) > 1:
        tables.append([[f'minus {names[0]}', 'seeds', *heads[: len(_COMPARED)]]])
        for name in names[1:]:
            gaps = [difference(results, name, item) for item in _COMPARED]
            tables[1].append([name, str(gaps[0].number), *map(_gap, gaps)])
    return '\n'.join(map(markdown_table, tables))


def compared_page(every: Sequence[Results], seeds: Sequence[int]) -> str:
    """Return the page of a comparison in Markdown."""
    text = f"# Comparison of searches\n\nSeeds {seeds[0]} to {seeds[-1]}. Means with Student's "
    text += (
        "95 % interval, the share of complete searches with\nWilson's; differences on the same "
        'seeds with bootstrap intervals. A search that did not\nfind all counts with the time '
        'limit.\n'
    )
    for results in every:
        text += f'\n## {results.experiment.name}\n\n{compared_markdown(results)}\n'
        text += ''.join(f'- {line}\n' for line in verdicts(results))
    return text + '\n![Share of searches that miss targets, and differences](comparison.png)\n'


def compared_text(every: Sequence[Results]) -> str:
    """Return all means and differences as CSV, a row each, in full precision."""
    head = 'scenario case minus quantity unit seeds mean low high median needed'
    table: list[list[Any]] = [head.split()]
    for results in every:
        scenario, names = results.experiment.name, results.names()
        for name in names:
            for item in QUANTITIES:
                one = interval(results, name, item)
                bounds = [one.mean - one.half_width, one.mean + one.half_width]
                middle = math.nan
                if item is COMPLETE:
                    bounds = list(share(results, name)[2:])
                if item is TIME:
                    middle = median_time(results, name)
                elif one.number:
                    middle = median(results.values(name, item.name), item)
                cells = [one.number, one.mean, *bounds, middle, None]
                table.append([scenario, name, '', item.name, item.unit, *cells])
        for name in names[1:]:
            for item in QUANTITIES:
                gap = difference(results, name, item)
                cells = [gap.number, gap.mean, gap.low, gap.high, gap.median, gap.needed]
                table.append([scenario, name, names[0], item.name, item.unit, *cells])
    return csv_text(table)


def compared_facts(every: Sequence[Results], seeds: Sequence[int]) -> dict[str, Any]:
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
    names = results.names()
    differences = []
    for name in names[1:]:
        for item in QUANTITIES:
            gap = difference(results, name, item)
            what = {'case': name, 'minus': names[0], 'quantity': item.name, 'unit': item.unit}
            differences.append({**what, **asdict(gap), 'told_from_zero': gap.told_from_zero})
    return {
        'cases': {name: _case(results, name) for name in names},
        'differences': differences,
        'verdicts': verdicts(results),
    }


def _case(results: Results, name: str) -> dict[str, Any]:
    complete, total, low, high = share(results, name)
    settings = results.case(name).settings['scenario']
    return {
        'planner': settings['planner']['name'],
        'filter': settings['filter']['method'],
        'time_limit': settings['limits']['time'],
        'searches': total,
        'complete': {'number': complete, 'low': low, 'high': high},
        'median_time': median_time(results, name),
        'means': {
            item.name: asdict(interval(results, name, item)) | {'unit': item.unit}
            for item in QUANTITIES[1:]
        },
        'runs': [
            {'seed': run.seed, **{item.name: run.value(item.name) for item in QUANTITIES}}
            for run in results.runs[name]
        ],
    }
