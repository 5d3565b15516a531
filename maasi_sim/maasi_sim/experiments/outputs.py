"""The files of an experiment other than its runs, and the page of all experiments."""

from __future__ import annotations

import json
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import yaml

from maasi_sim.experiments.brief import brief_tables
from maasi_sim.experiments.campaign import Campaign, maps_in, plan
from maasi_sim.experiments.claims import Finding, claims_page, findings
from maasi_sim.experiments.experiment import Experiment, OpenPoint, Results
from maasi_sim.experiments.figures import as_png
from maasi_sim.experiments.papers import FOLDER, experiments, named, title_of
from maasi_sim.experiments.runs import runs_text, steps_text, write_file
from maasi_sim.experiments.tables import (
    beside_paper,
    case_cells,
    pair_cells,
    table_text,
)

_PICTURE_DPI = 130
_COLUMNS = 118
EARLIER = ', from an earlier campaign'
EARLIER_ROW = ' (earlier)'


def picture(results: Results, dpi: int = 110) -> bytes:
    """Return the experiment's figure as PNG."""
    return as_png(lambda figure: results.experiment.draw(figure, results), dpi)


def configuration_text(results: Results, seed: int) -> str:
    """Return the configuration as YAML: choices, cases with their settings, seeds."""
    experiment = results.experiment
    content = {
        'experiment': experiment.name,
        'title': experiment.title,
        'seed': seed,
        'maps': {
            number: experiment.seed(number, seed)
            for number in sorted({run.number for run in results.every()})
        },
        'choices': [asdict(item) for item in experiment.choices],
        'cases': {
            case.name: {
                'preset': case.preset,
                'runs': len(results.runs[case.name]),
                'settings': case.settings,
            }
            for case in results.cases
        },
    }
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)


def write_outputs(work: Campaign, seed: int) -> None:
    """Write raw runs, tables, figure and configuration."""
    experiment, results = work.experiment, work.results()
    described = [
        *beside_paper(case_cells(results), pair_cells(results)),
        *_words_of(experiment),
    ]
    parts = [f'# {experiment.name}: {experiment.title}\n', *described, listed(experiment.choices)]
    for name, content in (
        ('steps.csv', steps_text(results.every())),
        ('runs.csv', runs_text(results.every())),
        ('table.csv', table_text(results)),
        ('table.md', '\n'.join(filter(None, parts))),
        ('configuration.yaml', configuration_text(results, seed)),
        ('figure.png', picture(results)),
    ):
        write_file(work.folder / name, content)


def _words_of(experiment: Experiment) -> list[str]:
    parts = [experiment.note and f'{experiment.note}\n']
    if experiment.tested:
        parts.append(f'Tested causes of differences: {experiment.tested}\n')
    return parts


def listed(choices: Sequence[OpenPoint]) -> str:
    """Return open points of the paper as a list in Markdown."""
    return ''.join(
        f'- {item.what}: **{item.taken}**. {item.reason}'.strip() + '\n' for item in choices
    )


@dataclass
class Section:
    """What the page shows of an experiment, in words and cells, stored with its figure."""

    rests: str
    cases: dict[str, dict[str, str]]
    pairs: list[list[str]]
    claims: list[Finding] = field(default_factory=list)

    def complete(self, earlier: Section) -> None:
        """Add the rows of an earlier section that it does not have, marked."""
        for name, cells in earlier.cases.items():
            self.cases.setdefault(name, {**cells, 'runs': _earlier(cells['runs'])})
        known = {tuple(row[:2]) for row in self.pairs}
        for who, what, maps, gap in earlier.pairs:
            if (who, what) not in known:
                self.pairs.append([who, what, _earlier(maps), gap])
        answered = {one.says for one in self.claims}
        self.claims += [one for one in earlier.earlier_claims() if one.says not in answered]

    def earlier_claims(self) -> list[Finding]:
        """Return the claims, marked as of an earlier campaign."""
        return [replace(one, earlier=True) for one in self.claims]


def _earlier(number: str) -> str:
    return number.removesuffix(EARLIER_ROW) + EARLIER_ROW


def section_of(results: Results, every: bool = True) -> Section:
    """Return the section of an experiment; `every`: cases without runs count."""
    shown = [case for case in results.cases if every or results.runs[case.name]]
    experiment = results.experiment
    wanted = [experiment.maps_of(case, experiment.runs) for case in shown]
    made = [len(results.runs[case.name]) for case in shown]
    maps = f'{made[0]}' if len(set(made)) == 1 else f'{min(made)} to {max(made)}'
    rests = f'{maps} run{"" if maps == "1" else "s"} of each case'
    if any(number < least for number, least in zip(made, wanted)):
        rests = f'**not in full: {rests}, the paper has {max(wanted)}**'
    return Section(rests, case_cells(results), pair_cells(results), findings(results))


def stored_section(store: Path) -> Section | None:
    """Return the section in a file, None if there is none."""
    if not store.exists():
        return None
    content = json.loads(store.read_text(encoding='utf-8'))
    content['claims'] = [Finding(**one) for one in content.get('claims', ())]
    return Section(**content)


def page(sections: dict[str, Section]) -> str:
    """Return the page of all experiments, from what is shown of each by its name."""
    introduction = (FOLDER / 'introduction.txt').read_text(encoding='utf-8')
    known: dict[str, list[Experiment]] = {}
    for name, experiment in experiments().items():
        known.setdefault(name[:3], []).append(experiment)
    links = {
        paper: ', '.join(_link(item.name, item.name in sections) for item in items)
        for paper, items in known.items()
    }
    parts = [introduction, ''.join(f'- {named(paper)}: {text}\n' for paper, text in links.items())]
    for paper, items in known.items():
        items = [item for item in items if item.name in sections]
        if not items:
            continue
        parts.append(f'## Paper {paper}\n\n{title_of(paper)}\n')
        # Each open point once, with a number that the experiments name.
        choices = list(dict.fromkeys(choice for item in items for choice in item.choices))
        parts.append('What the paper leaves open, and what is taken here:\n')
        parts.append(''.join(f'{n}. {listed([c])[2:]}' for n, c in enumerate(choices, start=1)))
        for item in items:
            section = sections[item.name]
            numbers = _spans([choices.index(choice) + 1 for choice in item.choices])
            words = f'{item.title}. {section.rests}.'
            words += f' Open points: {numbers}.' if numbers else ''
            words += _verdicts(section.claims)
            parts.append(f'### {item.name}\n\n{words}\n')
            parts.append(f'![Figure {item.name}](reproduction/{item.name}.png)\n')
            parts += brief_tables(item, section.cases, section.pairs)
            parts += _words_of(item)
    return '\n'.join(filter(None, parts))


def _link(name: str, has_runs: bool) -> str:
    return f'[{name}](#{name})' if has_runs else f'{name} (**not run**)'


def _spans(numbers: Sequence[int]) -> str:
    """Return numbers with runs of three and more as spans, such as '1 to 4, 7'."""
    spans: list[list[int]] = []
    for number in sorted(numbers):
        if spans and number == spans[-1][-1] + 1:
            spans[-1].append(number)
        else:
            spans.append([number])
    texts = (f'{s[0]} to {s[-1]}' if len(s) > 2 else ', '.join(map(str, s)) for s in spans)
    return ', '.join(texts)


def _verdicts(found: Sequence[Finding]) -> str:
    count = Counter(one.verdict() for one in found)
    said = ', '.join(f'{verdict} {number}' for verdict, number in count.items())
    return f' [Claims](claims.md): {said}.' if said else ''


def wrapped(text: str) -> str:
    """Return Markdown with long lines of paragraphs and lists wrapped; tables stay."""
    lines = []
    for line in text.split('\n'):
        if len(line) <= _COLUMNS or line.startswith(('|', '#', '!', '    ')):
            lines.append(line)
            continue
        mark = line.split(' ', 1)[0]
        indent = (
            ' ' * (len(mark) + 1)
            if mark == '-' or (mark[-1:] == '.' and mark[:-1].isdecimal())
            else ''
        )
        lines += textwrap.wrap(
            line, _COLUMNS, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        )
    return '\n'.join(lines)


def write_document(
    file: Path, out: Path, seed: int = 1, small: bool = False, rewrite: bool = False
) -> list[str]:
    """Write the pages of the experiments and of the claims; return what has runs in `out`.

    Figures and tables go to `reproduction/` next to the page; those without runs stay. With
    `rewrite`, the pages are written from the stored tables only, which are not marked as earlier
    ones.
    """
    sections: dict[str, Section] = {}
    shown = []
    for name, experiment in experiments().items():
        image = file.parent / 'reproduction' / f'{name}.png'
        store = image.with_suffix('.json')
        earlier = stored_section(store)
        if rewrite:
            sections |= {name: earlier} if earlier else {}
            continue
        results = plan(experiment, out, maps_in(out / name), seed, small).results()
        every = len(results.names()) == len(results.cases)
        if results.names():
            shown.append(name)
            section = section_of(results, every or earlier is None)
            if earlier is not None and not every:
                section.complete(earlier)
            # A figure of all cases is not replaced by one of some.
            if every or not image.exists():
                write_file(image, picture(results, _PICTURE_DPI))
            text = json.dumps(asdict(section), ensure_ascii=False, indent=1)
            write_file(store, f'{text}\n')
            sections[name] = section
        elif earlier is not None:
            earlier.rests += EARLIER
            earlier.claims = earlier.earlier_claims()
            sections[name] = earlier
    write_file(file, wrapped(page(sections)))
    found = {name: section.claims for name, section in sections.items()}
    write_file(file.with_name('claims.md'), claims_text(found, file.name))
    return shown


def claims_text(found: Mapping[str, Sequence[Finding]], file: str = 'reproduction.md') -> str:
    """Return the page of the claims, next to that of the experiments."""
    introduction = (FOLDER / 'claims.txt').read_text(encoding='utf-8')
    return wrapped(claims_page(introduction, experiments(), found, file))
