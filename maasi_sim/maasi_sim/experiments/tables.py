"""Tables of our results beside the papers'."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from maasi_sim.experiments.cases import Quantity
from maasi_sim.experiments.experiment import Results
from maasi_sim.experiments.results import csv_text
from maasi_sim.experiments.statistics import (
    Interval,
    array,
    from_published,
    independent_difference,
    mean_interval,
    paired_difference,
    restricted_mean,
)


@dataclass(frozen=True)
class Row:
    """One number of ours beside the paper's.

    Attributes
    ----------
    case, preset : str
        Of the case.
    quantity : Quantity
        Measured quantity.
    runs, finished : int
        Number of runs, and of runs that have the quantity.
    ours : Interval
        Our mean.
    median : float
        Of our runs; unfinished ones count as longest, nan if they are half or more.
    paper, difference : Interval or None
        Mean of the paper, and ours minus it.
    note : str
        Its place in the paper.
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


@dataclass(frozen=True)
class Paired:
    """A paired difference on the same maps."""

    first: str
    second: str
    quantity: Quantity
    difference: Interval


def interval(results: Results, case: str, quantity: Quantity) -> Interval:
    """Return the mean of a quantity over the runs of a case."""
    values = array(results.values(case, quantity.name))
    if quantity.kind == 'mean':
        return mean_interval(values)
    limits = array(results.values(case, quantity.limit))
    return restricted_mean(
        np.where(np.isnan(values), limits, values), ~np.isnan(values), float(limits.min())
    )


def median(values: np.ndarray, quantity: Quantity) -> float:
    """Return the median of a quantity; unfinished durations count as longest."""
    if quantity.kind == 'restricted':
        middle = float(np.median(np.where(np.isnan(values), np.inf, values)))
        return middle if math.isfinite(middle) else math.nan
    return float(np.nanmedian(values))


def rows(results: Results) -> list[Row]:
    """Return the table of an experiment: every quantity of every case."""
    experiment = results.experiment
    published = {(item.case, item.quantity): item for item in experiment.published}
    table = []
    for name in results.names():
        for quantity in experiment.quantities:
            values = array(results.values(name, quantity.name))
            finished = int((~np.isnan(values)).sum())
            if finished == 0 and quantity.kind == 'mean':
                continue
            ours = interval(results, name, quantity)
            theirs = published.get((name, quantity.name))
            paper = difference = None
            if theirs is not None:
                paper = from_published(theirs.value, theirs.half_width, theirs.runs)
                if finished:
                    difference = independent_difference(ours, paper)
            table.append(
                Row(
                    name,
                    results.case(name).preset,
                    quantity,
                    len(values),
                    finished,
                    ours,
                    median(values, quantity),
                    paper,
                    difference,
                    theirs.note if theirs is not None else '',
                )
            )
    return table


def paired_rows(results: Results) -> list[Paired]:
    """Return the paired differences of the experiment's comparisons."""
    table = []
    for item in results.experiment.comparisons:
        pairs = results.pairs(item.first, item.second)
        if not pairs:
            continue
        quantity = results.experiment.quantity(item.quantity)
        first, second = (array([pair[i].value(item.quantity) for pair in pairs]) for i in (0, 1))
        if quantity.kind == 'restricted':
            limits = [array([pair[i].value(quantity.limit) for pair in pairs]) for i in (0, 1)]
            limit = float(min(values.min() for values in limits))
            first, second = (
                np.minimum(np.where(np.isnan(values), limit, values), limit)
                for values in (first, second)
            )
        table.append(Paired(item.first, item.second, quantity, paired_difference(first, second)))
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


def _label(quantity: Quantity) -> str:
    return f'{quantity.label} [{quantity.unit}]' if quantity.unit else quantity.label


def markdown(results: Results) -> str:
    """Return the tables in Markdown."""
    lines = [
        '| case | measured | runs | ours | paper | difference |',
        '|---|---|---|---|---|---|',
    ]
    for row in rows(results):
        runs = str(row.runs)
        if row.quantity.kind == 'restricted' or row.finished < row.runs:
            runs = f'{row.finished} of {row.runs}'
        paper = shown(row.paper)
        if row.note:
            paper += f' ({row.note})'
        name = row.case if row.preset == 'paper' else f'{row.case} (recommended)'
        # Without finished runs the restricted mean is the limit.
        ours = shown(row.ours) if row.finished else f'more than {number(row.ours.mean)}'
        if row.quantity.kind == 'restricted' and row.runs > 2 and math.isfinite(row.median):
            ours += f' (median {number(row.median)})'
        lines.append(
            f'| {name} | {_label(row.quantity)} | {runs} | {ours} | {paper} | '
            f'{shown(row.difference, sign=True)} |'
        )
    pairs = paired_rows(results)
    if pairs:
        lines += [
            '',
            '| paired on the same maps | measured | maps | difference |',
            '|---|---|---|---|',
        ]
        lines += [
            f'| {pair.first} minus {pair.second} | {_label(pair.quantity)} | '
            f'{pair.difference.number} | {shown(pair.difference, sign=True)} |'
            for pair in pairs
        ]
    return '\n'.join(lines) + '\n'


def table_text(results: Results) -> str:
    """Return the table of ours against the paper's as CSV, in full precision."""

    def pair(item: Interval | None) -> list[float | None]:
        return [None, None] if item is None else [item.mean, item.half_width]

    head = 'case preset quantity unit runs finished ours ours_95 ours_median paper paper_95'
    table: list[list[object]] = [[*head.split(), 'difference', 'difference_95', 'note']]
    for row in rows(results):
        first = [row.case, row.preset, row.quantity.name, row.quantity.unit, row.runs, row.finished]
        cells = [*pair(row.ours), row.median, *pair(row.paper), *pair(row.difference)]
        table.append([*first, *cells, row.note])
    for item in paired_rows(results):
        first = [f'{item.first} - {item.second}', 'paired', item.quantity.name, item.quantity.unit]
        cells = [item.difference.number, *[None] * 6, *pair(item.difference)]
        table.append([*first, *cells, 'paired on the same maps'])
    return csv_text(table)
