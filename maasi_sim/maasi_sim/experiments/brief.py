"""The short tables of the page of experiments, made from the stored cells of each."""

import re
from collections.abc import Mapping, Sequence

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
    differences that are claims are on their page; several to one case are a column.
    """
    heads = list(dict.fromkeys(head for cells in cases.values() for head in cells))
    columns = [
        head for head in heads[1:] if head in _titles(experiment) and not _alike(head, cases)
    ]
    columns = columns or heads[1:2]
    times = {item.title() for item in experiment.quantities if item.name in _COMPUTATION}
    others = [_range(head, cases) for head in heads[1:] if head not in {*columns, *times}]
    others = [text for text in others if not text.endswith(' 0')]
    if len({cells['runs'] for cells in cases.values()}) > 1:
        columns.insert(0, 'runs')
    everywhere = all(name.endswith(_RECOMMENDED) for name in cases)
    table = {
        _case(name, everywhere): [brief_cell(cells.get(head, '-')) for head in columns]
        for name, cells in cases.items()
    }
    rest = _unclaimed(experiment, pairs)
    rows = _matrix(table, columns[0]) if len(columns) == 1 else []
    if not rows:
        names = [name.removesuffix(_RECOMMENDED) for name in cases]
        added, rest = _as_columns(rest, names, len(columns) > 1)
        rows = [['case', *columns, *added]]
        for (name, cells), case in zip(table.items(), names):
            rows.append([name, *cells, *(column.get(case, '') for column in added.values())])
    words = 'All cases have the recommended settings. ' if everywhere else ''
    words += f'Other means: {"; ".join(others)}.' if others else ''
    return [close(markdown_table(rows)), words.strip() + '\n' if words else '', _paired(rest)]


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
    texts = [cells[head] for cells in cases.values() if head in cells]
    never = 'more than ' if all(text.startswith('more than ') for text in texts) else ''
    numbers = [re.split('[ ,<]', text.removeprefix('more than '))[0] for text in texts]
    low, high = (pick(numbers, key=float) for pick in (min, max))
    label, _, unit = head.removesuffix(']').partition(' [')
    span = low if float(low) == float(high) else f'{low} to {high}'
    printed = [cells[head].split('<br>paper ') for cells in cases.values() if head in cells]
    paper = next(
        (f' (paper {re.split("[ <]", parts[1])[0]})' for parts in printed if parts[1:]), ''
    )
    return f'{label} {never}{span} {unit}'.strip() + (paper if len(set(numbers)) == 1 else '')


def _matrix(table: Mapping[str, Sequence[str]], title: str) -> list[list[str]]:
    """Return a table of one quantity by the first and the other parts of the names, or []."""
    if len(table) < _MATRIX:
        return []
    for split in (lambda name: name.rpartition(', ')[::2], lambda name: name.partition(', ')[::-2]):
        keys = {split(name): cells[0] for name, cells in table.items()}
        lines, heads = (list(dict.fromkeys(part)) for part in zip(*keys))
        if (
            len(heads) > 1
            and len(heads) < len(lines) + 1
            and len(keys) > 0.6 * len(lines) * len(heads)
        ):
            cells = [[keys.get((line, head), '') for head in heads] for line in lines]
            return [[title, *heads], *([line, *row] for line, row in zip(lines, cells))]
    return []


Row = Sequence[str]  # first minus second, quantity, maps, difference


def _unclaimed(experiment: Experiment, pairs: Sequence[Row]) -> list[Row]:
    claimed = {
        (f'{item.first} minus {item.second}', experiment.quantity(item.quantity).title())
        for item in experiment.claims
        if not item.case
    }
    return [row for row in pairs if (row[0], row[1]) not in claimed]


def _as_columns(
    rows: Sequence[Row], names: Sequence[str], several: bool
) -> tuple[dict[str, dict[str, str]], list[Row]]:
    """Return differences of several cases to one as columns, and the other rows."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row[0].split(' minus ')[1], row[1]), []).append(row)
    columns: dict[str, dict[str, str]] = {}
    rest: list[Row] = []
    for (second, quantity), group in groups.items():
        firsts = [row[0].split(' minus ')[0] for row in group]
        if len(group) > 1 and set(firsts) <= set(names) and len({row[2] for row in group}) == 1:
            head = f'{quantity}, minus {second}' if several else f'minus {second}'
            columns[head] = {name: _ZERO_WIDTH.sub('', row[3]) for name, row in zip(firsts, group)}
        else:
            rest += group
    return columns, rest


def _paired(rows: Sequence[Row]) -> str:
    if not rows:
        return ''
    heads = list(dict.fromkeys(row[1] for row in rows))
    counts: dict[str, str] = {}
    gaps: dict[str, dict[str, str]] = {}
    for name, head, count, gap in rows:
        counts[name] = count
        gaps.setdefault(name, {})[head] = _ZERO_WIDTH.sub('', gap)
    differ = len(set(counts.values())) > 1
    table = [['paired difference', *(['runs'] if differ else []), *heads]]
    for name, cells in gaps.items():
        runs = [counts[name]] if differ else []
        table.append([name, *runs, *(cells.get(head, '') for head in heads)])
    return close(markdown_table(table))
