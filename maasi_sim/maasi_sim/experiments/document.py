"""Writes docs/reproduction.md, the page of all experiments, with its figures."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np

from maasi_sim.experiments.campaign import plan
from maasi_sim.experiments.earlier import EARLIER_ROW, Earlier, completed, earlier_sections
from maasi_sim.experiments.experiment import Experiment, Results
from maasi_sim.experiments.outputs import described, picture
from maasi_sim.experiments.registry import experiments
from maasi_sim.experiments.results import RunFolder, write_file
from maasi_sim.experiments.tables import markdown

_PICTURE_DPI = 130
_COLUMNS = 118

_PAPERS = {
    '000': 'Yousuf, Herzal, Lendek, Buşoniu: Multi-agent active multi-target search with '
    'intermittent measurements, Control Engineering Practice, 2024',
    '001': 'Yousuf, Lendek, Buşoniu: Exploration-based planning for multiple-target search with '
    'real-drone results, Sensors, 2024',
    '002': 'Yousuf, Lendek, Buşoniu: Multi-agent exploration-based search for an unknown number of '
    'targets, IFAC 2023',
    '003': 'Yousuf, Lendek, Buşoniu: Exploration-based search for an unknown number of targets '
    'using a UAV, IFAC 2022',
    '004': 'Papaioannou and others: Distributed search planning in 3D environments with a '
    'dynamically varying number of agents, 2023',
}

_INTRODUCTION = """\
# The papers' experiments, run again

Written by `./scripts/reproduce --document docs/reproduction.md`; do not edit. Each section is one
figure or table of a paper: our numbers beside the paper's, a figure in the form of the printed
one, and the paper's open points with the choices made and their reasons.

    ./scripts/reproduce --list                      # what there is, and what it takes
    ./scripts/reproduce 000-fig4 000-fig11 --runs 30
    ./scripts/reproduce all                         # the same command resumes
    ./scripts/reproduce --document docs/reproduction.md

An experiment without runs in the folder keeps the tables that the page has; these rest on runs
"from an earlier campaign", of an earlier version of the code. So do single cases: their rows are
marked "(earlier)".

Each experiment leaves in `runs/reproduction/NAME/`: `runs/` (one file per run, with a checksum),
`steps.csv` (a row per run and step), `runs.csv` (a row per run), `table.md`, `table.csv`,
`figure.png`, and `configuration.yaml` with every setting and seed.

Other machines take part through Dask: in a clone of the same version on one machine, and on each
that is to work,

    ./scripts/shell dask scheduler
    ./scripts/shell dask worker tcp://SCHEDULER:8786

Then `./scripts/reproduce NAME --cluster tcp://SCHEDULER:8786`. Workers of different processors or
versions are refused, and so are runs that are there from another machine, unless `--mixed-workers`
is given: their numbers may differ ([repeatability](repeatability.md)).

## How to read the tables

- **ours** and **paper** are means with half the width of their 95 % confidence interval (Student's
  t). The papers' intervals are as printed; a number without one is a single run, or was read off
  the text or a figure.
- **difference** is ours minus the paper's. Its interval is Welch's, of both; where the paper gives
  none it is that of ours alone, and too narrow. An interval with 0 in it shows no difference.
- **runs** is how many maps a row rests on. "9 of 10" means that 9 runs got there. A run that did
  not counts with what was tried (restricted mean, the area under Kaplan and Meier's curve), and
  none is dropped. "More than 900" means that no run got there. A median far below the mean says
  that a few runs took very long.
- **paired** differences are of two methods on the same maps with the same seeds, a finer
  comparison than that of two separate intervals.
- **recommended** marks a case with the settings that we would use; all others are the best reading
  of the paper.
- "Targets found" are true targets with a found one within the distance given, one to one; "false
  targets" are the found ones that are left.
- The papers' computing times are MATLAB's on their machine, ours those of one core here.

The seed of a map is a hash of the name of the experiment's maps and of the map's number. The
settings of the cases were chosen on other maps. These maps are not unseen for the filter and the
planners, though: they were run again after changes of both, and what came out was read between
changes. What is called simulated hardware is the camera, the drift and the motion of the
simulator, not a robot.
"""


def available(experiment: Experiment, out: Path, seed: int = 1, small: bool = False) -> Results:
    """Return the runs of an experiment that are in a folder."""
    folder = RunFolder(out / experiment.name, experiment.name)
    return plan(experiment, out, folder.maps(), seed, small).results()


def how_many(results: Results, every: bool = True) -> str:
    """Return in words the number of runs of an experiment, and that of the paper.

    Parameters
    ----------
    results : Results
        The runs.
    every : bool
        Whether cases without runs count.
    """
    wanted, made = [], []
    for case in results.cases:
        if not (every or results.runs[case.name]):
            continue
        most = results.experiment.runs
        wanted.append(most if case.runs is None else min(most, case.runs))
        made.append(len(results.runs[case.name]))
    low, high = min(made), max(made)
    maps = f'{low}' if low == high else f'{low} to {high}'
    complete = all(number >= least for number, least in zip(made, wanted))
    text = f'{maps} run{"" if maps == "1" else "s"} of each case'
    if complete:
        return text
    return f'**not in full: {text}, the paper has {max(wanted)}**'


def how_long(results: Results) -> str:
    """Return in words the median time of a run on one core, '' if unknown."""
    times = [
        value
        for name in results.names()
        for value in results.values(name, 'processor_time')
        if value is not None
    ]
    return f' A run takes about {np.median(times):.1f} s on one core.' if times else ''


def page(results: dict[str, Results], earlier: dict[str, Earlier] | None = None) -> str:
    """Return the page of experiments that have runs, by name.

    Parameters
    ----------
    results : dict
        Runs of experiments.
    earlier : dict, optional
        Sections of an earlier page, for the others.
    """
    sections = dict(earlier or {})
    for name, found in results.items():
        tables = markdown(found)
        if name in sections and len(found.names()) < len(found.cases):
            tables = completed(tables, sections[name].tables)
        rests = how_many(found, every=EARLIER_ROW not in tables)
        sections[name] = Earlier(rests, how_long(found), tables)
    parts = [_INTRODUCTION, '## What was run\n']
    known = experiments()
    rows = ['| experiment | shows | rests on |', '|---|---|---|']
    for name, experiment in known.items():
        rests = sections[name].rests if name in sections else '**not run**'
        shown = f'[{name}](#{name})' if name in sections else name
        rows.append(f'| {shown} | {experiment.title} | {rests} |')
    parts.append('\n'.join(rows) + '\n')
    paper = ''
    for name, experiment in known.items():
        if name not in sections:
            continue
        section = sections[name]
        if experiment.paper != paper:
            paper = experiment.paper
            parts.append(f'## Paper {paper}\n\n{_PAPERS.get(paper, "")}\n')
        parts.append(
            f'### {name}\n\n{experiment.title}.\nRests on {section.rests}.{section.duration}\n'
        )
        parts.append(f'![{experiment.title}](reproduction/{name}.png)\n')
        parts.append(described(experiment, section.tables))
    return '\n'.join(parts)


def wrapped(text: str) -> str:
    """Return Markdown with long lines of paragraphs and lists wrapped; tables stay."""
    lines = []
    for line in text.split('\n'):
        if len(line) <= _COLUMNS or line.startswith(('|', '#', '!', '    ')):
            lines.append(line)
            continue
        indent = '  ' if line.startswith('- ') else ''
        lines += textwrap.wrap(
            line,
            _COLUMNS,
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        )
    return '\n'.join(lines)


def write_document(file: Path, out: Path, seed: int = 1, small: bool = False) -> list[str]:
    """Write the page of the experiments in a folder, with a figure for each beside it.

    Parameters
    ----------
    file : Path
        The page; figures are written to `reproduction/` beside it.
    out : Path
        Folder of all experiments.
    seed : int
        Of the campaign.
    small : bool
        Whether to use the small cases.

    Returns
    -------
    list of str
        Experiments with runs in the folder; others keep their present tables.

    Raises
    ------
    NoRoom
        If something cannot be written.
    """
    results = {}
    for name, experiment in experiments().items():
        found = available(experiment, out, seed, small)
        if found.names():
            results[name] = found
    for name, found in results.items():
        image = file.parent / 'reproduction' / f'{name}.png'
        # A figure of all cases is not replaced by one of some.
        if len(found.names()) == len(found.cases) or not image.exists():
            write_file(image, picture(found, _PICTURE_DPI))
    earlier = earlier_sections(file.read_text()) if file.exists() else {}
    write_file(file, wrapped(page(results, earlier)))
    return list(results)
