"""Names every experiment, and says what an experiment is."""

from __future__ import annotations

import difflib
import hashlib
import importlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from maasi_sim.experiments.results import Results

Value = float | int | str | bool | None

# Modules of this package that hold experiments, in the order in which they are listed. Each has
# a function `experiments()` that returns a list of Experiment.
PAPERS = ('paper_000', 'paper_001', 'paper_002', 'paper_003', 'paper_004')


class UnknownExperiment(ValueError):
    """A name that no experiment has."""


@dataclass(frozen=True)
class Choice:
    """Something that the paper leaves open, what is taken, and why."""

    what: str
    taken: str
    reason: str


@dataclass(frozen=True)
class Case:
    """One configuration of an experiment, such as a method, that is run on every map.

    Attributes
    ----------
    name : str
        Unique within the experiment, such as 'ASI' or 'ASI, alpha 0.5, beta 5'.
    settings : dict
        All that a run needs, as plain values that YAML and JSON can hold.
    preset : str
        'paper', the best reading of the paper, or 'recommended', what we would use.
    runs : int, optional
        Number of maps at most; none: as many as asked for.
    """

    name: str
    settings: dict[str, Any]
    preset: Literal['paper', 'recommended'] = 'paper'
    runs: int | None = None

    @property
    def slug(self) -> str:
        """The name as part of a file name."""
        return ''.join(c if c.isalnum() or c in '.-' else '_' for c in self.name.lower())

    def digest(self) -> str:
        """Return a short hash of the settings: runs of other settings are not ours."""
        text = json.dumps(self.settings, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Quantity:
    """Something that is measured in each run: a key of `Outcome.summary` or `Outcome.timing`.

    Attributes
    ----------
    name : str
        The key.
    label : str
        In words.
    unit : str
        Empty for plain numbers.
    kind : str
        'mean': averaged over the runs that have it. 'restricted': a duration that is None in runs
        that did not get there; the mean is restricted to the shortest time that was tried.
    limit : str
        Of a restricted one: the key in the summary that says how long was tried.
    """

    name: str
    label: str
    unit: str = ''
    kind: Literal['mean', 'restricted'] = 'mean'
    limit: str = 'limit'


@dataclass(frozen=True)
class Published:
    """A number that the paper reports.

    Attributes
    ----------
    case, quantity : str
        Which one.
    value : float
        As printed, or as read off the figure (then say so in `note`).
    half_width : float, optional
        Of the paper's 95 % confidence interval.
    runs : int
        Behind it.
    note : str
        Where it stands.
    """

    case: str
    quantity: str
    value: float
    half_width: float | None = None
    runs: int = 10
    note: str = ''


@dataclass(frozen=True)
class Comparison:
    """A paired difference on the same maps, first minus second."""

    first: str
    second: str
    quantity: str


@dataclass
class Outcome:
    """What one run has come to.

    Attributes
    ----------
    summary : dict
        A number, text or None by quantity.
    columns : dict of arrays
        One row per step, all columns of the same length.
    details : dict
        Anything else that a figure needs, such as true positions: lists and numbers.
    timing : dict
        Wall times; the one part that differs when a run is repeated.
    """

    summary: dict[str, Value]
    columns: Mapping[str, ArrayLike] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)
    timing: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """A figure or table of a paper.

    Attributes
    ----------
    name : str
        Such as '000-fig4'.
    title : str
        What it shows, in a line.
    cases : function of bool
        Returns the cases; True asks for small ones that take a second: for tests and a first look.
        Settings are built when this is called, not when the module is imported.
    run : function of settings and seed
        Runs one case once. The seed is that of the map; it is the same for every case.
    quantities : sequence of Quantity
        Columns of the table.
    draw : function of an empty figure and the results
        Draws what can be laid beside the paper's figure.
    published : sequence of Published
        What the paper reports.
    comparisons : sequence of Comparison
        Paired differences to report.
    choices : sequence of Choice
        What the paper leaves open.
    causes : str
        Why we may differ from the paper; not tested.
    tested : str
        Why we differ from the paper, tested by runs; says which, and what stays unknown.
    runs : int
        Number of maps in the paper.
    seconds : float
        What a run takes on one core, roughly; for --list.
    maps : str, optional
        Experiments with the same word here have the same maps; none: maps of its own.
    note : str
        What a reader must know.
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
        """Return the seed of a map: of the experiment's maps, their number and the seed only.

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


def array(values: Sequence[float | None]) -> np.ndarray:
    """Return values as an array, nan where there is none."""
    return np.array([np.nan if value is None else float(value) for value in values])
