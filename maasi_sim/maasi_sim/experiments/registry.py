"""Names every experiment."""

from __future__ import annotations

import difflib
import importlib

from maasi_sim.experiments.experiment import Experiment

# Modules of this package that hold experiments, in the order in which they are listed. Each has
# a function `experiments()` that returns a list of Experiment.
PAPERS = ('paper_000', 'paper_001', 'paper_002', 'paper_003', 'paper_004')


class UnknownExperiment(ValueError):
    """A name that no experiment has."""


def experiments() -> dict[str, Experiment]:
    """Return all experiments by name, in the order of the papers."""
    known: dict[str, Experiment] = {}
    for module in PAPERS:
        for item in importlib.import_module(f'maasi_sim.experiments.{module}').experiments():
            if item.name in known:
                raise ValueError(f'{item.name}: two experiments have this name')
            known[item.name] = item
    return known


def find(name: str) -> Experiment:
    """Return an experiment by its name.

    Raises
    ------
    UnknownExperiment
        With the nearest names.
    """
    known = experiments()
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4) or [
        item for item in known if item[:3] == name[:3]
    ]
    hint = f'; nearest are {", ".join(near)}' if near else ''
    raise UnknownExperiment(f"unknown experiment '{name}'{hint}; --list names all")
