"""Experiments and their results."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from maasi_sim.experiments.cases import Case, Choice, Comparison, Outcome, Published, Quantity
from maasi_sim.experiments.results import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Experiment:
    """A figure or table of a paper.

    Attributes
    ----------
    name : str
        Such as '000-fig4'.
    title : str
        One line.
    cases : function of bool
        Returns the cases; with True small ones that take a second, for tests and a first look.
    run : function of settings and seed
        Runs one case once. The seed is that of the map, the same for every case.
    quantities : sequence of Quantity
        Columns of the table.
    draw : function of an empty figure and the results
        Draws a figure in the form of the paper's.
    published : sequence of Published
        Numbers of the paper.
    comparisons : sequence of Comparison
        Paired differences to report.
    choices : sequence of Choice
        Open points of the paper.
    causes : str
        Likely causes of differences from the paper; not tested.
    tested : str
        Causes of differences that were tested by runs.
    runs : int
        Number of maps in the paper.
    seconds : float
        Approximate time of a run on one core; for --list.
    maps : str, optional
        Experiments with the same value have the same maps; none: maps of its own.
    note : str
        Further information for readers.
    """

    name: str
    title: str
    cases: Callable[[bool], list[Case]]
    run: Callable[[dict[str, Any], int], Outcome]
    quantities: Sequence[Quantity]
    draw: Callable[[Figure, Results], None]
    published: Sequence[Published] = ()
    comparisons: Sequence[Comparison] = ()
    choices: Sequence[Choice] = ()
    causes: str = ''
    tested: str = ''
    runs: int = 10
    seconds: float = 2.0
    maps: str | None = None
    note: str = ''

    @property
    def paper(self) -> str:
        """The paper's number: the first three digits of the name."""
        return self.name[:3]

    def seed(self, number: int, seed: int = 1) -> int:
        """Return the seed of a map; it depends on `maps`, the number and the seed only.

        Parameters
        ----------
        number : int
            Of the map, from 0.
        seed : int
            Of the whole campaign.
        """
        key = f'{self.maps or self.name}/{seed}/{number}'
        return int.from_bytes(hashlib.sha256(key.encode()).digest()[:6], 'big')

    def quantity(self, name: str) -> Quantity:
        """Return a quantity by its name."""
        return next(item for item in self.quantities if item.name == name)


@dataclass
class Results:
    """The runs of one experiment.

    Attributes
    ----------
    experiment : Experiment
        Which.
    cases : list of Case
        All of its cases.
    runs : dict
        Runs of each case by name, in the order of the maps.
    """

    experiment: Experiment
    cases: list[Case]
    runs: dict[str, list[Run]]

    def names(self) -> list[str]:
        """Return the cases that have runs."""
        return [case.name for case in self.cases if self.runs.get(case.name)]

    def case(self, name: str) -> Case:
        """Return a case by its name."""
        return next(case for case in self.cases if case.name == name)

    def values(self, case: str, quantity: str) -> list[float | None]:
        """Return a quantity in each run of a case."""
        return [run.value(quantity) for run in self.runs[case]]

    def pairs(self, first: str, second: str) -> list[tuple[Run, Run]]:
        """Return the runs of two cases on the same maps."""
        other = {run.number: run for run in self.runs.get(second, [])}
        return [(run, other[run.number]) for run in self.runs.get(first, []) if run.number in other]
