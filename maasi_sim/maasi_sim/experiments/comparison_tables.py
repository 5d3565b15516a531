"""What a comparison of searches has come to: as plain values, in Markdown and as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from maasi_sim.experiments.experiment import Results
from maasi_sim.experiments.results import Run
from maasi_sim.experiments.statistics import (
    LEVEL,
    Difference,
    Interval,
    bootstrap_difference,
    mean_interval,
)
from maasi_sim.machine import code_digest, this_machine

VERSION = 1
# Bootstrap intervals of fewer pairs are too narrow.
FEWEST = 10


@dataclass(frozen=True)
class Measure:
    """Something that is measured in each search.

    Attributes
    ----------
    name, label, unit : str
        Key in files, words, unit.
    value : function of a Run
        Returns it; nan where the run has none.
    scale : float
        Of the numbers in Markdown.
    shown_unit : str
        There.
    """

    name: str
    label: str
    unit: str
    value: Callable[[Run], float]
    scale: float = 1.0
    shown_unit: str = ''

    @property
    def head(self) -> str:
        """Label and unit in Markdown."""
        unit = self.shown_unit or self.unit
        return f'{self.label} [{unit}]' if unit else self.label

    def values(self, runs: Sequence[Run]) -> NDArray[np.float64]:
        """Return it in each run."""
        return np.array([self.value(run) for run in runs], dtype=float)


def complete(run: Run) -> bool:
    """Return whether a search found all targets."""
    return run.value('time_to_find_all') is not None


def time_to_find_all(run: Run) -> float:
    """Return when all targets were found, the time limit if they were not [s]."""
    return _or_nan(run.value('time_to_find_all' if complete(run) else 'time_limit'))


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _of(name: str) -> Callable[[Run], float]:
    return lambda run: _or_nan(run.value(name))


COMPLETE = Measure('complete', 'complete', '', lambda run: float(complete(run)))
FALSE = Measure('false_found', 'false found', '', _of('false_found'))
TIME = Measure('time', 'time to find all', 's', time_to_find_all)
MEAN_TIME = Measure('mean_time', 'mean time to find', 's', _of('mean_time_to_find'))
MEASUREMENTS = Measure('measurements', 'measurements', '', _of('measurements'))
WAY = Measure('distance', 'way', 'm', _of('distance'))
DECISION = Measure('planning_time', 'decision', 's', _of('planning_time'), 1e3, 'ms')
STEP = Measure('filter_time', 'filter step', 's', _of('filter_time'), 1e3, 'ms')
PROCESSOR = Measure('processor_time', 'computation of a search', 's', _of('processor_time'))

MEASURES = (COMPLETE, FALSE, TIME, MEAN_TIME, MEASUREMENTS, WAY, DECISION, STEP, PROCESSOR)
# What is worth a column of differences.
_DIFFERENCES = (COMPLETE, FALSE, TIME, MEAN_TIME, MEASUREMENTS, WAY)


def share(results: Results, case: str) -> tuple[int, int, float, float]:
    """Return complete searches, searches, and the bounds of Wilson's 95 % interval of the share."""
    runs = results.runs[case]
    number = sum(complete(run) for run in runs)
    if not runs:
        return 0, 0, math.nan, math.nan
    low, high = stats.binomtest(number, len(runs)).proportion_ci(LEVEL, method='wilson')
    return number, len(runs), float(low), float(high)


def median_time(results: Results, case: str) -> float:
    """Return the median of the time to find all [s]; nan if half of the searches did not."""
    times = [time_to_find_all(run) if complete(run) else math.inf for run in results.runs[case]]
    middle = float(np.median(times)) if times else math.nan
    return middle if math.isfinite(middle) else math.nan


def difference(results: Results, case: str, other: str, measure: Measure) -> Difference:
    """Return the mean of a case minus another one, on the seeds of both."""
    pairs = results.pairs(case, other)
    first, second = (measure.values([pair[i] for pair in pairs]) for i in (0, 1))
    return bootstrap_difference(first, second)


def differences(results: Results) -> list[tuple[str, str, Measure, Difference]]:
    """Return each case minus the first one that has searches, of all measures."""
    names = results.names()
    return [
        (name, names[0], measure, difference(results, name, names[0], measure))
        for name in names[1:]
        for measure in MEASURES
    ]


def verdict(case: str, other: str, gap: Difference) -> str:
    """Return in words whether the time to find all differs, and how many seeds would show it."""
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
        for case, other, measure, gap in differences(results)
        if measure is TIME
    ]


def _digits(value: float, sign: str = '') -> str:
    if not math.isfinite(value):
        return '-'
    size = abs(value)
    return f'{value:{sign}.{0 if size >= 1000.0 else 1 if size >= 10.0 else 2}f}'


def _mean(interval: Interval, scale: float) -> str:
    half = f' ± {_digits(scale * interval.half_width)}' if interval.number > 1 else ''
    return _digits(scale * interval.mean) + half


def markdown(results: Results) -> str:
    """Return the tables of a comparison: of cases, and of differences to the first one."""
    columns = [measure for measure in MEASURES if measure is not COMPLETE]
    heads = ['case', 'seeds', 'complete', 'median time [s]', *(item.head for item in columns)]
    lines = [_row(heads), _row(['---'] * len(heads))]
    for name in results.names():
        runs = results.runs[name]
        number, total, low, high = share(results, name)
        cells = [name, str(total), f'{number} ({100 * low:.0f} to {100 * high:.0f} %)']
        cells.append(_digits(median_time(results, name)))
        cells += [_mean(mean_interval(item.values(runs)), item.scale) for item in columns]
        lines.append(_row(cells))
    names = results.names()
    if len(names) > 1:
        heads = [f'minus {names[0]}', 'seeds', *(item.head for item in _DIFFERENCES)]
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
    out = io.StringIO()
    writer = csv.writer(out, lineterminator='\n')
    writer.writerow(
        [
            'scenario',
            'case',
            'minus',
            'quantity',
            'unit',
            'seeds',
            'mean',
            'low',
            'high',
            'median',
            'needed',
        ]
    )
    for results in every:
        scenario = results.experiment.name
        for name in results.names():
            for measure in MEASURES:
                values = measure.values(results.runs[name])
                one = mean_interval(values)
                bounds = [one.mean - one.half_width, one.mean + one.half_width]
                middle = float(np.nanmedian(values)) if one.number else math.nan
                if measure is COMPLETE:
                    bounds = list(share(results, name)[2:])
                elif measure is TIME:
                    middle = median_time(results, name)
                cells = [one.number, *map(_cell, (one.mean, *bounds, middle)), '']
                writer.writerow([scenario, name, '', measure.name, measure.unit, *cells])
        for name, other, measure, gap in differences(results):
            cells = [gap.number, *map(_cell, (gap.mean, gap.low, gap.high, gap.median))]
            needed = '' if gap.needed is None else gap.needed
            writer.writerow([scenario, name, other, measure.name, measure.unit, *cells, needed])
    return out.getvalue()


def _cell(value: float) -> float | str:
    return value if math.isfinite(value) else ''


def facts(every: Sequence[Results], seeds: Sequence[int]) -> dict[str, Any]:
    """Return a comparison as plain values: searches, means, differences; none is infinite."""
    return _plain(
        {
            'version': VERSION,
            'seeds': list(seeds),
            'code': code_digest(),
            'machine': this_machine(),
            'scenarios': {results.experiment.name: _scenario(results) for results in every},
        }
    )


def _scenario(results: Results) -> dict[str, Any]:
    cases: dict[str, Any] = {}
    for name in results.names():
        runs = results.runs[name]
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
                item.name: asdict(mean_interval(item.values(runs))) | {'unit': item.unit}
                for item in MEASURES
                if item is not COMPLETE
            },
            'runs': [
                {'seed': run.seed, **{item.name: item.value(run) for item in MEASURES}}
                for run in runs
            ],
        }
    return {
        'cases': cases,
        'differences': [
            {
                'case': name,
                'minus': other,
                'quantity': measure.name,
                'unit': measure.unit,
                **asdict(gap),
                'told_from_zero': gap.told_from_zero,
            }
            for name, other, measure, gap in differences(results)
        ],
        'verdicts': verdicts(results),
    }


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
