"""The short tables of the page of experiments, made from the stored cells of each."""

import re
from collections.abc import Mapping, Sequence
from itertools import groupby

from maasi_sim.experiments.experiment import Experiment
from maasi_sim.experiments.tables import close, markdown_table

_RECOMMENDED = ' (recommended)'
_COMPUTATION = ('step_time', 'filter_time', 'planning_time', 'solve_mean')
_MATRIX = 12  # tables of one quantity with as many rows become a matrix where that is possible
_MEDIAN = re.compile(r' \(median ([^)]*)\)')
_ZERO_WIDTH = re.compile(r' ± (0|\d(\.\d+)?e-1\d)(?![\d.])')

Cells = Mapping[str, Mapping[str, str]]


def brief_tables(experiment: Experiment, cases: Cells, pairs: Sequence[Sequence[str]]) -> list[str]:
    """Return the cases and paired differences in Markdown, with what matters only.

    A column stands for a quantity that a claim, a paired difference or a number of the paper uses;
    of the others the range of the means is given, without zeros and computing times. Paired
    differences that are claims are on their page.
    """
    heads = list(dict.fromkeys(head for cells in cases.values() for head in cells))
    columns = [
        head for head in heads[1:] if head in _titles(experiment) and not _alike(head, cases)
    ]
    columns = columns or heads[1:2]
    if len({cells['runs'] for cells in cases.values()}) > 1:
        columns.insert(0, 'runs')
    everywhere = all(name.endswith(_RECOMMENDED) for name in cases)
    table = {
        _case(name, everywhere): [brief_cell(cells.get(head, '-')) for head in columns]
        for name, cells in cases.items()
    }
    rows = _matrix(table, columns[0]) if len(columns) == 1 else []
    rows = rows or [['case', *columns], *([name, *cells] for name, cells in table.items())]
    times = {item.title() for item in experiment.quantities if item.name in _COMPUTATION}
    others = [_range(head, cases) for head in heads[1:] if head not in {*columns, *times}]
    others = [text for text in others if not text.endswith(' 0')]
    words = 'All cases have the recommended settings. ' if everywhere else ''
    words += f'Other means: {"; ".join(others)}.' if others else ''
    return [
        close(markdown_table(rows)),
        words.strip() + '\n' if words else '',
        _paired(experiment, pairs),
    ]


def _titles(experiment: Experiment) -> set[str]:
    used = {item.quantity for item in experiment.claims}
    used |= {item.quantity for item in experiment.comparisons}
    used |= {item.quantity for item in experiment.published} - set(_COMPUTATION)
    used |= {experiment.quantities[0].name, *experiment.shown}
    return {item.title() for item in experiment.quantities if item.name in used}


def _alike(head: str, cases: Cells) -> bool:
    """Return whether ours and the paper's number are the same in all cases."""
    ours = {brief_cell(cells.get(head, '-')).split('<br>')[0] for cells in cases.values()}
    return len(ours) == 1 and not next(iter(ours)).startswith('more')


def _case(name: str, everywhere: bool) -> str:
    short = name.removesuffix(_RECOMMENDED)
    return short if everywhere or 'recommended' in short else name


def brief_cell(text: str) -> str:
    """Return a cell without what its numbers imply.

    A median within the interval of the mean is left out, the paper's number is in bold where the
    interval of the difference excludes zero.
    """
    ours, *rest = _ZERO_WIDTH.sub('', text).split('<br>')
    middle = _MEDIAN.search(ours)
    mean, _, half = _MEDIAN.sub('', ours).split(',')[0].partition(' ± ')
    if middle and abs(float(middle[1]) - float(mean)) <= float(half or 0.0):
        ours = _MEDIAN.sub('', ours)
    ours = re.sub(r'\b1 runs', '1 run', ours)
    if not rest:
        return ours
    paper = rest[0].split(' (')[0]
    gap, _, half = (
        rest[1].removeprefix('difference ').partition(' ± ') if rest[1:] else ('0', '', '')
    )
    apart = half and abs(float(gap)) > float(half)
    paper = paper.removeprefix('paper ')
    return f'{ours}<br>paper **{paper}**' if apart else f'{ours}<br>paper {paper}'


def _range(head: str, cases: Cells) -> str:
    texts = [cells[head].removeprefix('more than ') for cells in cases.values() if head in cells]
    numbers = [re.split('[ ,<]', text)[0] for text in texts]
    low, high = (pick(numbers, key=float) for pick in (min, max))
    label, _, unit = head.removesuffix(']').partition(' [')
    span = low if float(low) == float(high) else f'{low} to {high}'
    printed = [cells[head].split('<br>paper ') for cells in cases.values() if head in cells]
    paper = next(
        (f' (paper {re.split("[ <]", parts[1])[0]})' for parts in printed if parts[1:]), ''
    )
    return f'{label} {span} {unit}'.strip() + (paper if len(set(numbers)) == 1 else '')


def _matrix(table: Mapping[str, Sequence[str]], title: str) -> list[list[str]]:
    """Return a table of one quantity by the first and the last part of the names, or []."""
    parts = [name.rpartition(', ') for name in table]
    lines = {first: [part[2] for part in group] for first, group in groupby(parts, lambda p: p[0])}
    heads = next(iter(lines.values()))
    if len(table) < _MATRIX or any(line != heads for line in lines.values()) or len(heads) < 2:
        return []
    cells = [[table[f'{first}, {head}'][0] for head in heads] for first in lines]
    return [[title, *heads], *([first, *line] for first, line in zip(lines, cells))]


def _paired(experiment: Experiment, pairs: Sequence[Sequence[str]]) -> str:
    claimed = {
        (f'{item.first} minus {item.second}', experiment.quantity(item.quantity).title())
        for item in experiment.claims
        if not item.case
    }
    rows = [row for row in pairs if (row[0], row[1]) not in claimed]
    if not rows:
        return ''
    heads = list(dict.fromkeys(row[1] for row in rows))
    title, others = 'paired difference', {row[0].split(' minus ')[1] for row in rows}
    if len(others) == 1:
        title += f', minus {others.pop()}'
        rows = [(name.split(' minus ')[0], *rest) for name, *rest in rows]
    counts: dict[str, str] = {}
    gaps: dict[str, dict[str, str]] = {}
    for name, head, count, gap in rows:
        counts[name] = count
        gaps.setdefault(name, {})[head] = _ZERO_WIDTH.sub('', gap)
    differ = len(set(counts.values())) > 1
    table = [[title, *(['runs'] if differ else []), *heads]]
    for name, cells in gaps.items():
        runs = [counts[name]] if differ else []
        table.append([name, *runs, *(cells.get(head, '-') for head in heads)])
    return close(markdown_table(table))
