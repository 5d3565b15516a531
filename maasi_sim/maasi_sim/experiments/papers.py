"""Experiments of the papers, from the YAML files in `papers/`, one per paper.

A case's settings are the layers of the experiment, of its preset and of the case, merged, and its
own values on top. A list of mappings of cases means all combinations of them.
"""

import difflib
from collections.abc import Callable, Mapping
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import yaml

from maasi_sim.experiments import buildings, figures, searches
from maasi_sim.experiments.experiment import (
    Case,
    Claim,
    Comparison,
    Experiment,
    OpenPoint,
    Published,
    WrongInput,
)
from maasi_sim.experiments.searches import search_case
from maasi_sim.scenario.layering import merged

QUANTITIES = {item.name: item for item in (*searches.QUANTITIES, *buildings.QUANTITIES)}
RUNS = {
    'search': searches.run_search,
    'exploring': searches.run_exploring,
    'among_obstacles': searches.run_among_obstacles,
    'on_terrain': searches.run_on_terrain,
    'mission': buildings.run_mission,
    'timing': buildings.run_timing,
}
FIGURES: dict[str, Callable[..., None]] = {
    'curves': figures.draw_curves,
    'paths': figures.draw_paths,
    'against': figures.draw_against,
    'table': figures.draw_table,
    'missions': buildings.draw_missions,
    'batteries_and_ranges': buildings.draw_batteries_and_ranges,
    'visits_over_time': buildings.draw_visits_over_time,
    'mission_times': buildings.draw_mission_times,
    'decision_times': buildings.draw_decision_times,
}
PAPERS = ('000', '001', '002', '003', '004')
FOLDER = Path(__file__).with_name('papers')


def experiments() -> dict[str, Experiment]:
    """Return all experiments by name, in the order of the papers."""
    return {item.name: item for number in PAPERS for item in paper_experiments(number)}


def find(name: str) -> Experiment:
    """Return an experiment by its name."""
    known = experiments()
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4) or [
        item for item in known if item[:3] == name[:3]
    ]
    hint = f'; nearest are {", ".join(near)}' if near else ''
    raise WrongInput(f"unknown experiment '{name}'{hint}; --list names all")


@cache
def _paper(number: str) -> dict[str, Any]:
    text = (FOLDER / f'{number}.yaml').read_text(encoding='utf-8')
    content: dict[str, Any] = yaml.safe_load(text)
    return content


def title_of(paper: str) -> str:
    """Return authors and title of a paper, '' of an unknown one."""
    return str(_paper(paper)['title']) if paper in PAPERS else ''


def named(paper: str) -> str:
    """Return the code of a paper with its short name, such as '000 (MAASI 2024)'."""
    return f'{paper} ({_paper(paper)["name"]})' if paper in PAPERS else paper


def paper_experiments(number: str) -> list[Experiment]:
    """Return the experiments of a paper, such as '000'."""
    paper = _paper(number)
    return [_experiment(name, entry, paper) for name, entry in paper['experiments'].items()]


def _experiment(name: str, content: Mapping[str, Any], paper: Mapping[str, Any]) -> Experiment:
    entry = dict(content)
    for key in ('cases', 'layers', 'preset', 'most_measurements', 'only', 'small'):
        entry.pop(key, None)
    figure = dict(entry.pop('figure'))
    draw = FIGURES[figure.pop('kind')]
    if draw is figures.draw_curves:
        shown = figure.pop('cases', None) or _combined(content['cases'])
        figure['styles'] = {case: paper['styles'].get(case, '') for case in shown}
    if draw is figures.draw_table:
        figure['axes'] = [list(axis) for axis in _axes(content['cases'])]
    return Experiment(
        name=name,
        cases=lambda small: _cases(content, paper.get('layers', {}), small),
        run=RUNS[entry.pop('run', 'search')],
        quantities=[QUANTITIES[item] for item in entry.pop('quantities')],
        draw=partial(draw, **figure),
        published=[Published(**row) for row in entry.pop('published', [])],
        comparisons=[
            Comparison(*names)
            for row in entry.pop('comparisons', [])
            for names in product(row['first'], row['second'], row['quantities'])
        ],
        claims=[Claim(**row) for row in entry.pop('claims', [])],
        choices=[OpenPoint(**paper['choices'][key]) for key in entry.pop('choices')],
        **entry,
    )


def _axes(cases: Any) -> list[dict[str, dict[str, Any]]]:
    return cases if isinstance(cases, list) else [cases]


def _combined(cases: Any) -> dict[str, dict[str, Any]]:
    return {
        ', '.join(name for name, _ in items): merged(*(values for _, values in items))
        for items in product(*(axis.items() for axis in _axes(cases)))
    }


def _cases(entry: Mapping[str, Any], layers: Mapping[str, Any], small: bool) -> list[Case]:
    change = dict(entry.get('small', {})) if small else {}
    only = [names for names in (entry.get('only'), change.pop('only', None)) if names]
    listed = []
    for name, content in _combined(entry['cases']).items():
        if not all(name in names for names in only):
            continue
        preset = content.pop('preset', entry.get('preset', 'paper'))
        runs = content.pop('runs', None)
        cap = content.pop('most_measurements', entry.get('most_measurements'))
        own = content.pop('layers', [])
        used = [*entry['layers'], *([preset] if preset in layers else []), *own]
        values = merged(*(layers[key] for key in used), content, change)
        common = values.pop('every_robot', None)
        if common is not None:
            robots = values['robots'].items()
            values['robots'] = {robot: merged(common, its) for robot, its in robots}
        if cap is None:
            listed.append(Case(name, values, preset, runs))
        else:
            listed.append(search_case(name, values, cap, preset, small, runs))
    return listed
