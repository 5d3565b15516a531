"""All experiments by name."""

from __future__ import annotations

import difflib

from maasi_sim.experiments.experiment import Experiment
from maasi_sim.experiments.papers import paper_experiments

PAPERS = ('000', '001', '002', '003', '004')


class UnknownExperiment(ValueError):
    """There is no experiment of this name."""


def experiments() -> dict[str, Experiment]:
    """Return all experiments by name, in the order of the papers."""
    return {item.name: item for number in PAPERS for item in paper_experiments(number)}


def find(name: str) -> Experiment:
    """Return an experiment by its name.

    Raises
    ------
    UnknownExperiment
        Names the nearest ones.
    """
    known = experiments()
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4) or [
        item for item in known if item[:3] == name[:3]
    ]
    hint = f'; nearest are {", ".join(near)}' if near else ''
    raise UnknownExperiment(f"unknown experiment '{name}'{hint}; --list names all")
