"""The papers' claims: what our runs say about each, and a verdict by one rule."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from maasi_filter.wording import number
from maasi_sim.experiments.experiment import Claim, Experiment, Quantity, Results
from maasi_sim.experiments.statistics import (
    LEVEL,
    Interval,
    bootstrap_difference,
    from_published,
    independent_difference,
    mean_interval,
    paired_difference,
    student,
)
from maasi_sim.experiments.tables import (
    close,
    interval,
    markdown_table,
    median,
    paired,
    shown,
)

HOLDS, NOT_SHOWN, NOT_HERE, DIFFERS = 'holds', 'not shown', 'not here', 'differs'
ONE_RUN, NOT_RUN = 'no interval', 'not run'
ALIKE = 0.2  # what is within this share of the other is alike
# A table in a document stands between these lines.
BEGIN, END = '<!-- claims: begin -->\n', '<!-- claims: end -->\n'
_MEDIANS = re.compile(r' \(medians? [^)]*\)')
_WIDTH = re.compile(r' ± \S+')
_WORDS = {'less': 'less', 'greater': 'more', 'alike': 'alike', 'number': ''}


@dataclass(frozen=True)
class Finding:
    """What our runs say about a claim, stored with the figure of its experiment."""

    says: str
    expects: str
    paper: str  # cell of the table
    here: str  # cell of the table
    gap: float  # first minus second, or ours minus the paper's number
    half_width: float | None  # of the 95 % interval; None of one run
    degrees: float  # of Student's distribution
    size: float  # the second, or the paper's number
    earlier: bool = False

    def verdict(self, level: float = LEVEL) -> str:
        """Return the verdict by an interval of this level."""
        if self.half_width is None:
            return ONE_RUN
        half = self.half_width * student(self.degrees, level) / student(self.degrees)
        low, high = self.gap - half, self.gap + half
        if self.expects in ('alike', 'number'):
            if low > 0.0 or high < 0.0:
                return DIFFERS if self.expects == 'number' else NOT_HERE
            return HOLDS if max(-low, high) <= ALIKE * abs(self.size) else NOT_SHOWN
        if self.expects == 'less':
            low, high = -high, -low
        return HOLDS if low > 0.0 else NOT_HERE if high < 0.0 else NOT_SHOWN

    def brief(self) -> str:
        """Return the cell without medians, ratio, and the widths that the difference has."""
        means, *parts = _MEDIANS.sub('', self.here).split('<br>')
        if ' against ' in means:
            means = _WIDTH.sub('', means).replace(' against ', ' and ')
        kept = [means]
        for part in parts:
            counts = [count.split(' of ') for count in part.removeprefix('finished ').split(', ')]
            if not part.startswith('finished'):
                text = part.split(', x ')[0].removeprefix('difference ')
                kept.append(text.replace('none in any', 'no difference in any'))
            elif any(done != every for done, every in counts):
                kept.append('finished ' + ', '.join(map('/'.join, counts)))
        return '<br>'.join(kept)

    def marked(self, level: float) -> str:
        """Return the verdict, in bold if it is the same by an interval of this level."""
        verdict = self.verdict()
        stays = verdict in (HOLDS, NOT_HERE, DIFFERS) and self.verdict(level) == verdict
        return f'**{verdict}**' if stays else verdict


def findings(results: Results) -> list[Finding]:
    """Return what the runs say about each claim of an experiment that has runs for it."""
    found = []
    for claim in results.experiment.claims:
        quantity = results.experiment.quantity(claim.quantity)
        finding = (_number if claim.case else _pair)(results, claim, quantity)
        if finding is not None:
            found.append(finding)
    return found


def _finding(claim: Claim, paper: str, here: Sequence[str], gap: Interval, size: float) -> Finding:
    half = gap.half_width if math.isfinite(gap.half_width) else None
    cell = '<br>'.join(filter(None, here))
    return Finding(claim.says, claim.expects, paper, cell, gap.mean, half, gap.degrees, size)


def _number(results: Results, claim: Claim, quantity: Quantity) -> Finding | None:
    if not results.runs.get(claim.case):
        return None
    ours = interval(results, claim.case, quantity)
    if not ours.number:
        return None
    item = _published(results.experiment, claim.case, claim.quantity)
    assert item is not None, f'{results.experiment.name}: {claim.says} has no published number'
    gap = independent_difference(ours, item)
    values = results.values(claim.case, claim.quantity)
    here = [
        f'{shown(ours)}{_unit(quantity)} (median {number(median(values, quantity))})',
        f'difference {_difference(gap)}',
        _finished(quantity, values),
    ]
    return _finding(claim, _printed(item, quantity), here, gap, item.mean)


def _pair(results: Results, claim: Claim, quantity: Quantity) -> Finding | None:
    names = claim.first, claim.second
    raw = results.pairs(*names, claim.quantity)
    both = paired(results, *names, quantity)
    gap = paired_difference(*both)
    if not gap.number:
        return None
    means = [shown(mean_interval(one)) for one in both]
    medians = [number(median(one, quantity)) for one in raw]
    here = [
        f'{" against ".join(means)}{_unit(quantity)} (medians {", ".join(medians)})',
        f'{_difference(gap)}{_ratio(*both)}',
        _finished(quantity, *raw),
    ]
    printed = [_published(results.experiment, name, claim.quantity) for name in names]
    words = _WORDS[claim.expects]
    if any(printed):
        cells = [_printed(item, quantity) if item else '-' for item in printed]
        words += f': {" against ".join(cells)}'
    return _finding(claim, words, here, gap, float(np.nanmean(both[1])))


def _published(experiment: Experiment, case: str, quantity: str) -> Interval | None:
    item = experiment.published_of(quantity).get(case)
    return from_published(item.value, item.half_width, item.runs) if item else None


def _printed(item: Interval, quantity: Quantity) -> str:
    return f'{shown(item)}{_unit(quantity)}{" (one run)" if item.number == 1 else ""}'


def _unit(quantity: Quantity) -> str:
    return f' {quantity.unit}' if quantity.unit else ''


def _difference(gap: Interval) -> str:
    if gap.mean == gap.half_width == 0.0:
        return f'none in any of {gap.number} runs'
    return shown(gap, sign=True)


def _ratio(first: np.ndarray, second: np.ndarray) -> str:
    known = ~np.isnan(first) & ~np.isnan(second)
    first, second = first[known], second[known]
    if (first <= 0.0).any() or (second <= 0.0).any() or (first == second).all():
        return ''
    gap = bootstrap_difference(np.log(first), np.log(second))
    span = f' [{number(math.exp(gap.low))}, {number(math.exp(gap.high))}]' if gap.number > 1 else ''
    return f', x {number(math.exp(gap.mean))}{span}'


def _finished(quantity: Quantity, *values: np.ndarray) -> str:
    if quantity.kind == 'mean':
        return ''
    parts = [f'{int((~np.isnan(one)).sum())} of {len(one)}' for one in values]
    return f'finished {", ".join(parts)}'


def corrected_level(found: Mapping[str, Sequence[Finding]]) -> tuple[int, float]:
    """Return the number of intervals, and the level of each after Bonferroni's correction."""
    intervals = sum(one.half_width is not None for items in found.values() for one in items)
    return intervals, 1.0 - (1.0 - LEVEL) / max(intervals, 1)


def summary(experiments: Mapping[str, Experiment], found: Mapping[str, Sequence[Finding]]) -> str:
    """Return the verdicts of each paper, counted; in brackets those that the correction leaves."""
    intervals, level = corrected_level(found)
    papers: dict[str, Counter[str]] = {}
    for name, experiment in experiments.items():
        count = papers.setdefault(name[:3], Counter())
        known = {one.says: one for one in found.get(name, ())}
        for claim in experiment.claims:
            one = known.get(claim.says)
            verdict = one.verdict() if one else NOT_RUN
            count.update([verdict, 'claims'])
            count[f'{verdict} left'] += one is not None and one.marked(level) != verdict
    heads = ['paper', 'claims', HOLDS, NOT_SHOWN, f'{NOT_HERE}, or differs', 'one run, or none']
    rows = [heads]
    for paper, count in papers.items():
        against = count[NOT_HERE] + count[DIFFERS]
        left = count[f'{NOT_HERE} left'] + count[f'{DIFFERS} left']
        holds = f'{count[HOLDS]} ({count[f"{HOLDS} left"]})'
        rest = f'{count[ONE_RUN] + count[NOT_RUN]}'
        rows.append(
            [paper, f'{count["claims"]}', holds, f'{count[NOT_SHOWN]}', f'{against} ({left})', rest]
        )
    caption = "Claims of each paper by verdict; in brackets those that Bonferroni's correction for"
    return f'{caption}\n{intervals} intervals leaves as they are.\n\n{markdown_table(rows)}'


def claims_page(
    introduction: str,
    experiments: Mapping[str, Experiment],
    found: Mapping[str, Sequence[Finding]],
    page: str,
) -> str:
    """Return the page of all claims; `page` is the file of the experiments next to it."""
    intervals, level = corrected_level(found)
    text = introduction.format(intervals=intervals, level=f'{100.0 * level:.2f}', page=page)
    parts = [text, summary(experiments, found)]
    papers: dict[str, list[list[str]]] = {}
    for name, experiment in experiments.items():
        known = {one.says: one for one in found.get(name, ())}
        for claim in experiment.claims:
            says = claim.says + (f' ({claim.note})' if claim.note else '')
            row = [f'{says}, [{name}]({page}#{name})']
            one = known.get(claim.says)
            if one is None:
                row += ['', '', NOT_RUN]
            else:
                cause = '' if one.verdict() in (HOLDS, ONE_RUN) else claim.cause
                earlier = ' (earlier)' if one.earlier else ''
                verdict = ': '.join(filter(None, (one.marked(level), cause)))
                paper = one.paper.removesuffix(' against -').replace(' against ', ' and ')
                row += [close(paper), close(one.brief()) + earlier, verdict]
            papers.setdefault(name[:3], []).append(row)
    for paper, rows in papers.items():
        heads = ['claim', 'paper', 'here', 'verdict']
        parts.append(f'## Paper {paper}\n\n{markdown_table([heads, *rows])}')
    return '\n'.join(parts)


def with_summary(text: str, table: str, name: str = 'claims') -> str:
    """Return a document with the summary between its two marks; without marks as it is."""
    before, begin, rest = text.partition(BEGIN.replace('claims', name))
    _, end, after = rest.partition(END.replace('claims', name))
    return f'{before}{begin}\n{table}\n{end}{after}' if begin and end else text
