"""Experiments: their cases and quantities, the papers' numbers, and runs."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class WrongInput(ValueError):
    """What was asked for is unknown, or does not fit what is there."""


@dataclass(frozen=True)
class OpenPoint:
    """What a paper leaves open, the value used here, and the reason, or ''."""

    what: str
    taken: str
    reason: str


@dataclass(frozen=True)
class Case:
    """One configuration of an experiment, such as a method, that is run on every map."""

    name: str  # unique within the experiment
    settings: dict[str, Any]  # all that a run needs, as plain values
    preset: Literal['paper', 'recommended'] = 'paper'  # the paper's best reading, or ours
    runs: int | None = None  # the most maps

    @property
    def slug(self) -> str:
        """The name as part of a file name."""
        return ''.join(c if c.isalnum() or c in '.-' else '_' for c in self.name.lower())

    def digest(self) -> str:
        """Return a short hash of the settings, by which stored runs are recognised."""
        text = json.dumps(self.settings, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Quantity:
    """A measured quantity: a key of `Outcome.summary` or `Outcome.timing`."""

    name: str
    label: str
    unit: str = ''
    kind: Literal['mean', 'restricted'] = 'mean'  # restricted: a duration, None if unfinished
    limit: str = 'limit'  # of restricted: the key of what its mean is up to

    def title(self, unit: str | None = None) -> str:
        """Return label and unit, or another unit."""
        shown = self.unit if unit is None else unit
        return f'{self.label} [{shown}]' if shown else self.label


@dataclass(frozen=True)
class Published:
    """A number that the paper reports, as printed, or as read from a figure."""

    case: str
    quantity: str
    value: float
    half_width: float | None = None  # of its 95 % confidence interval
    runs: int = 10
    note: str = ''  # its place in the paper


@dataclass(frozen=True)
class Comparison:
    """A paired difference on the same maps, first minus second."""

    first: str
    second: str
    quantity: str


@dataclass(frozen=True)
class Claim:
    """Something that a paper says, and the cases here that it rests on."""

    says: str
    quantity: str
    first: str = ''  # whose quantity is expected to be less than (or as `expects` says)
    second: str = ''  # that of this one
    case: str = ''  # instead of two: one whose number is `published`
    expects: Literal['less', 'greater', 'alike', 'number'] = 'less'
    note: str = ''  # added to the words
    cause: str = ''  # why it does not hold here, '' if no run has shown it


@dataclass
class Outcome:
    """Results of one run."""

    summary: dict[str, Any]  # numbers, texts or None by quantity
    columns: Mapping[str, Any] = field(default_factory=dict)  # by row for each step
    details: dict[str, Any] = field(default_factory=dict)  # other data of figures
    timing: dict[str, float] = field(default_factory=dict)  # wall times, not the same again


@dataclass(kw_only=True)
class Run(Outcome):
    """The outcome of one run of one case on one map."""

    experiment: str
    case: str
    number: int  # of the map, from 0
    seed: int
    digest: str  # of the case's settings
    machine: dict[str, str]  # what made it, see `this_machine`

    def value(self, quantity: str) -> float | None:
        """Return a measured quantity; None if the run has none."""
        read = self.summary.get(quantity, self.timing.get(quantity))
        return None if read is None or isinstance(read, str) else float(read)


def plain(value: Any) -> Any:
    """Return a value for JSON; non-finite numbers become None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclass(frozen=True)
class Experiment:
    """A figure or table of a paper."""

    name: str
    title: str
    cases: Callable[[bool], list[Case]]  # with True small ones, which take a second
    run: Callable[[dict[str, Any], int], Outcome]  # by settings and the seed of the map
    quantities: Sequence[Quantity]  # columns of the table
    draw: Callable[[Figure, Results], None]  # a figure in the form of the paper's
    published: Sequence[Published] = ()  # the paper's numbers
    comparisons: Sequence[Comparison] = ()  # paired differences
    claims: Sequence[Claim] = ()
    choices: Sequence[OpenPoint] = ()  # open points of the paper
    tested: str = ''  # causes of differences from the paper that runs have shown
    runs: int = 10  # maps in the paper
    seconds: float = 2.0  # of a run on one core, about
    maps: str | None = None  # those with the same name have the same maps; None: its own
    note: str = ''
    shown: Sequence[str] = ()  # quantities on the page that neither claim nor difference uses
    compared: bool = False  # searches are compared: the seed is the number of the map

    def seed(self, number: int, seed: int = 1) -> int:
        """Return the seed of a map of a campaign; it depends on `maps` and the arguments only."""
        if self.compared:
            return number
        key = f'{self.maps or self.name}/{seed}/{number}'
        return int.from_bytes(hashlib.sha256(key.encode()).digest()[:6], 'big')

    def maps_of(self, case: Case, runs: int) -> int:
        """Return on how many maps a case is run, of `runs` that are asked for."""
        return runs if case.runs is None else min(runs, case.runs)

    def quantity(self, name: str) -> Quantity:
        """Return a quantity by its name."""
        return next(item for item in self.quantities if item.name == name)

    def published_of(self, quantity: str) -> dict[str, Published]:
        """Return the paper's numbers for a quantity by case."""
        return {item.case: item for item in self.published if item.quantity == quantity}


@dataclass
class Results:
    """The runs of one experiment: those of each case by its name, in the order of the maps."""

    experiment: Experiment
    cases: list[Case]
    runs: dict[str, list[Run]]

    def names(self) -> list[str]:
        """Return the cases that have runs."""
        return [case.name for case in self.cases if self.runs.get(case.name)]

    def every(self) -> list[Run]:
        """Return all runs, case by case."""
        return [run for case in self.cases for run in self.runs[case.name]]

    def case(self, name: str) -> Case:
        """Return a case by its name."""
        return next(case for case in self.cases if case.name == name)

    def values(self, case: str, quantity: str) -> NDArray[np.float64]:
        """Return a quantity in each run of a case; nan where a run has none."""
        return _values(self.runs[case], quantity)

    def pairs(self, first: str, second: str, quantity: str) -> list[NDArray[np.float64]]:
        """Return a quantity of two cases on the maps that both have."""
        sides = [{run.number: run for run in self.runs.get(name, [])} for name in (first, second)]
        both = [number for number in sides[0] if number in sides[1]]
        return [_values([side[number] for number in both], quantity) for side in sides]


def _values(runs: Sequence[Run], quantity: str) -> NDArray[np.float64]:
    return np.array([run.value(quantity) for run in runs], dtype=float)
