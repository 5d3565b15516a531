"""Tables: of our results next to the papers', and of comparisons of searches."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy import stats

from maasi_filter.arrays import FloatArray
from maasi_filter.wording import counted, number
from maasi_sim.experiments.experiment import Quantity, Results, plain
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

VERSION = 1  # version of comparison.json
FEWEST = 10  # bootstrap intervals of fewer pairs are too narrow


def capped(values: FloatArray, limit: float) -> FloatArray:
    """Return durations with what is unfinished (nan) or longer at a limit."""
    return np.minimum(np.where(np.isnan(values), limit, values), limit)


def interval(results: Results, case: str, quantity: Quantity) -> Interval:
    """Return the mean of a quantity over the runs of a case."""
    values = results.values(case, quantity.name)
    if quantity.kind == 'mean':
        return mean_interval(values)
    # All that is censored reached a limit, so that this is the area under the survival curve.
    return mean_interval(capped(values, float(results.values(case, quantity.limit).min())))


def paired(results: Results, first: str, second: str, quantity: Quantity) -> list[FloatArray]:
    """Return a quantity of two cases on the maps of both; durations up to the shortest limit."""
    both = results.pairs(first, second, quantity.name)
    if quantity.kind == 'mean' or not len(both[0]):
        return both
    limit = float(np.min(results.pairs(first, second, quantity.limit)))
    return [capped(one, limit) for one in both]


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


# Of an experiment, next to the paper.


@dataclass(frozen=True)
class Row:
    """One number of ours next to the paper's."""

    case: str
    preset: str
    quantity: Quantity
    runs: int
    finished: int  # runs that have the quantity
    ours: Interval
    median: float  # others count as longest; nan if they are half or more
    paper: Interval | None
    difference: Interval | None  # ours minus the paper's
    note: str

    def cell(self) -> str:
        """Return ours, the paper's and the difference as a cell in Markdown."""
        # Without finished runs the restricted mean is the limit.
        text = shown(self.ours) if self.finished else f'more than {number(self.ours.mean)}'
        if self.quantity.kind == 'restricted' and self.runs > 2 and math.isfinite(self.median):
            text += f' (median {number(self.median)})'
        if 0 < self.finished < self.runs:
            text += f', {counted(self.finished, "run")}'
        if self.paper is not None:
            note = f' ({self.note})' if self.note else ''
            text += f'<br>paper {shown(self.paper)}{note}'
        if self.difference is not None:
            text += f'<br>difference {shown(self.difference, sign=True)}'
        return text


def rows(results: Results) -> Iterator[Row]:
    """Yield the table of an experiment: every quantity of every case."""
    experiment = results.experiment
    for name in results.names():
        preset = results.case(name).preset
        for quantity in experiment.quantities:
            values = results.values(name, quantity.name)
            finished = int((~np.isnan(values)).sum())
            if not finished and quantity.kind != 'restricted':
                continue
            ours = interval(results, name, quantity)
            middle = median(values, quantity) if finished else math.nan
            theirs = experiment.published_of(quantity.name).get(name)
            paper = gap = None
            if theirs is not None:
                paper = from_published(theirs.value, theirs.half_width, theirs.runs)
                gap = independent_difference(ours, paper) if finished else None
            note = theirs.note if theirs else ''
            number = len(values)
            yield Row(name, preset, quantity, number, finished, ours, middle, paper, gap, note)


def pairs(results: Results) -> Iterator[tuple[str, str, Quantity, Interval]]:
    """Yield the paired differences of the experiment: two cases, first minus second."""
    for item in results.experiment.comparisons:
        quantity = results.experiment.quantity(item.quantity)
        both = paired(results, item.first, item.second, quantity)
        if len(both[0]):
            yield item.first, item.second, quantity, paired_difference(*both)


def close(text: str) -> str:
    """Return a cell for a page, with the half widths next to their means."""
    return text.replace(' ± ', '±')


def shown(value: Interval, sign: bool = False) -> str:
    """Return a mean with its half width."""
    if not math.isfinite(value.mean):
        return '-'
    text = ('+' if sign and value.mean > 0.0 else '') + number(value.mean)
    return f'{text} ± {number(value.half_width)}' if math.isfinite(value.half_width) else text


def case_cells(results: Results) -> dict[str, dict[str, str]]:
    """Return the cells of each case by the heads of their columns."""
    cells: dict[str, dict[str, str]] = {}
    for row in rows(results):
        name = row.case if row.preset == 'paper' else f'{row.case} (recommended)'
        cells.setdefault(name, {'runs': str(row.runs)})[row.quantity.title()] = row.cell()
    return cells


def pair_cells(results: Results) -> list[list[str]]:
    """Return the cells of each paired difference."""
    return [
        [f'{first} minus {second}', quantity.title(), str(gap.number), shown(gap, sign=True)]
        for first, second, quantity, gap in pairs(results)
    ]


def beside_paper(cases: dict[str, dict[str, str]], paired: list[list[str]]) -> list[str]:
    """Return the tables of `case_cells` and `pair_cells` in Markdown."""
    heads = list(dict.fromkeys(head for cells in cases.values() for head in cells))
    lines = [[name, *(cells.get(head, '-') for head in heads)] for name, cells in cases.items()]
    tables = [
        [['case', *heads], *lines],
        [['paired on the same maps', 'measured', 'maps', 'difference'], *paired],
    ]
    return [markdown_table(table) for table in tables if len(table) > 1]


def table_text(results: Results) -> str:
    """Return the table of ours against the paper's as CSV, in full precision."""

    def numbers(item: Interval | None) -> list[float | None]:
        return [None, None] if item is None else [item.mean, item.half_width]

    head = 'case preset quantity unit runs finished ours ours_95 ours_median paper paper_95'
    table: list[list[object]] = [[*head.split(), 'difference', 'difference_95', 'note']]
    for row in rows(results):
        first = [row.case, row.preset, row.quantity.name, row.quantity.unit, row.runs, row.finished]
        cells = [*numbers(row.ours), row.median, *numbers(row.paper), *numbers(row.difference)]
        table.append([*first, *cells, row.note])
    for one, other, quantity, gap in pairs(results):
        first = [f'{one} - {other}', 'paired', quantity.name, quantity.unit, gap.number]
        table.append([*first, *[None] * 6, *numbers(gap), 'paired on the same maps'])
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
    Quantity('distance', 'distance', 'm'),
)
QUANTITIES = (
    *_COMPARED,
    Quantity('half_time', 'time to find half', 's'),
    Quantity('most_time', 'time to find 90 %', 's'),
    Quantity('planning_time', 'decision', 's'),
    Quantity('filter_time', 'filter step', 's'),
    Quantity('processor_time', 'computation of a search', 's'),
)
_SHORT = ('planning_time', 'filter_time')  # shown in milliseconds in Markdown


@dataclass(frozen=True)
class Share:
    """Complete searches of all, with Wilson's 95 % interval of their share; nan without any."""

    number: int
    low: float
    high: float


class SearchTable:
    """Means of each case of a comparison, and differences to the first one that has searches.

    All are by case and name of the quantity; differences are on the seeds of both, `median_time` is
    nan if half of the searches did not find all.
    """

    def __init__(self, results: Results) -> None:
        self.results = results
        self.name = results.experiment.name
        self.cases = results.names()
        self.means = {
            case: {item.name: interval(results, case, item) for item in QUANTITIES}
            for case in self.cases
        }
        self.differences = {
            case: {
                item.name: bootstrap_difference(*results.pairs(case, self.cases[0], item.name))
                for item in QUANTITIES
            }
            for case in self.cases[1:]
        }
        self.complete = {case: self._share(case) for case in self.cases}
        self.median_time = {
            case: median(results.values(case, _TIME_FOUND.name), _TIME_FOUND) for case in self.cases
        }

    def _share(self, case: str) -> Share:
        finished = self.results.values(case, COMPLETE.name)
        complete = round(float(finished.sum()))
        span = stats.binomtest(complete, len(finished)).proportion_ci(LEVEL, method='wilson')
        return Share(complete, float(span.low), float(span.high))

    def verdicts(self) -> list[str]:
        """Return a sentence on the time to find all for each case but the first one."""
        return [
            verdict(case, self.cases[0], gaps[TIME.name]) for case, gaps in self.differences.items()
        ]

    def markdown(self) -> str:
        """Return the tables: of cases, and of differences to the first one."""
        heads = [item.title('ms' if item.name in _SHORT else None) for item in QUANTITIES]
        table = [['case', 'seeds', 'complete', 'median time [s]', *heads[1:]]]
        for case, means in self.means.items():
            part = self.complete[case]
            share = f'{part.number} ({100 * part.low:.0f} to {100 * part.high:.0f} %)'
            cells = [case, str(means[COMPLETE.name].number), share]
            spans = [_mean(means[item.name], item.name in _SHORT) for item in QUANTITIES[1:]]
            table.append([*cells, _digits(self.median_time[case]), *spans])
        text = markdown_table(table)
        if self.differences:
            table = [[f'minus {self.cases[0]}', 'seeds', *heads[: len(_COMPARED)]]]
            for case, gaps in self.differences.items():
                spans = [
                    f'{_digits(gap.mean, "+")} [{_digits(gap.low, "+")}, {_digits(gap.high, "+")}]'
                    for gap in (gaps[item.name] for item in _COMPARED)
                ]
                table.append([case, str(gaps[COMPLETE.name].number), *spans])
            text += '\n' + markdown_table(table)
        return text

    def lines(self) -> Iterator[list[Any]]:
        """Yield the rows of the CSV: scenario, case, minus, and of each quantity all numbers."""
        for case in self.cases:
            for item in QUANTITIES:
                one = self.means[case][item.name]
                bounds = [one.mean - one.half_width, one.mean + one.half_width]
                middle = math.nan
                if item is COMPLETE:
                    bounds = [self.complete[case].low, self.complete[case].high]
                if item is TIME:
                    middle = self.median_time[case]
                elif one.number:
                    middle = median(self.results.values(case, item.name), item)
                cells = [one.number, one.mean, *bounds, middle, None]
                yield [self.name, case, '', item.name, item.unit, *cells]
        for case, gaps in self.differences.items():
            for item in QUANTITIES:
                gap = gaps[item.name]
                cells = [gap.number, gap.mean, gap.low, gap.high, gap.median, gap.needed]
                yield [self.name, case, self.cases[0], item.name, item.unit, *cells]

    def facts(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        differences = []
        for case, gaps in self.differences.items():
            for item in QUANTITIES:
                gap = gaps[item.name]
                what = {'case': case, 'minus': self.cases[0]}
                what |= {'quantity': item.name, 'unit': item.unit}
                differences.append(what | asdict(gap) | {'told_from_zero': gap.excludes_zero})
        cases = {case: self._facts_of(case) for case in self.cases}
        return {'cases': cases, 'differences': differences, 'verdicts': self.verdicts()}

    def _facts_of(self, case: str) -> dict[str, Any]:
        settings = self.results.case(case).settings['scenario']
        means = self.means[case]
        return {
            'planner': settings['planner']['name'],
            'filter': settings['filter']['method'],
            'time_limit': settings['limits']['time'],
            'searches': means[COMPLETE.name].number,
            'complete': asdict(self.complete[case]),
            'median_time': self.median_time[case],
            'means': {
                item.name: asdict(means[item.name]) | {'unit': item.unit} for item in QUANTITIES[1:]
            },
            'runs': [
                {'seed': run.seed, **{item.name: run.value(item.name) for item in QUANTITIES}}
                for run in self.results.runs[case]
            ],
        }


def verdict(case: str, other: str, gap: Difference) -> str:
    """Return in words whether the time to find all differs, and the seeds needed to show it."""
    who = f'{case} minus {other}: '
    if gap.number < 2:
        return f'{who}{gap.number} seed on which both ran, too few for an interval.'
    if gap.low == gap.high == 0.0:
        return f'{who}no difference on any of {gap.number} seeds.'
    span = f'{gap.mean:+.1f} s, 95 % from {gap.low:+.1f} to {gap.high:+.1f} s'
    if gap.excludes_zero:
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


def _mean(mean: Interval, short: bool) -> str:
    scale = 1e3 if short else 1.0
    half = f' ± {_digits(scale * mean.half_width)}' if mean.number > 1 else ''
    return _digits(scale * mean.mean) + half


def compared_page(tables: Sequence[SearchTable], seeds: Sequence[int]) -> str:
    """Return the page of a comparison in Markdown."""
    text = (
        f"# Comparison of searches\n\nSeeds {seeds[0]} to {seeds[-1]}. Means with Student's "
        "95 % interval, the share of complete searches with\nWilson's; differences on the same "
        'seeds with bootstrap intervals. A search that did not\nfind all counts with the time '
        'limit.\n'
    )
    for table in tables:
        text += f'\n## {table.name}\n\n{table.markdown()}\n'
        text += ''.join(f'- {line}\n' for line in table.verdicts())
    return text + '\n![Share of searches that miss targets, and differences](comparison.png)\n'


def compared_text(tables: Sequence[SearchTable]) -> str:
    """Return all means and differences as CSV, a row each, in full precision."""
    head = 'scenario case minus quantity unit seeds mean low high median needed'
    return csv_text([head.split(), *(line for table in tables for line in table.lines())])


def compared_facts(tables: Sequence[SearchTable], seeds: Sequence[int]) -> dict[str, Any]:
    """Return a comparison as plain values: searches, means, differences; none is infinite."""
    values: dict[str, Any] = plain(
        {
            'version': VERSION,
            'seeds': list(seeds),
            'code': code_digest(),
            'machine': this_machine(),
            'scenarios': {table.name: table.facts() for table in tables},
        }
    )
    return values
