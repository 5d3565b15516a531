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
    """Something that the paper leaves open, the value taken here, and the reason."""

    what: str
    taken: str
    reason: str


@dataclass(frozen=True)
class Case:
    """One configuration of an experiment, such as a method, that is run on at most `runs` maps.

    The settings are all that a run needs; the preset is the best reading of the paper, or our own.
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
        """Return a short hash of the settings, by which stored runs are recognised."""
        text = json.dumps(self.settings, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Quantity:
    """A measured quantity: a key of `Outcome.summary` or `Outcome.timing`.

    A restricted one is a duration, None in unfinished runs; its mean is up to the key `limit`.
    """

    name: str
    label: str
    unit: str = ''
    kind: Literal['mean', 'restricted'] = 'mean'
    limit: str = 'limit'

    def title(self, unit: str | None = None) -> str:
        """Return label and unit, or another unit."""
        shown = self.unit if unit is None else unit
        return f'{self.label} [{shown}]' if shown else self.label


@dataclass(frozen=True)
class Published:
    """A number of the paper, half of its 95 % interval, and where it is printed or read from."""

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


@dataclass(frozen=True)
class Claim:
    """Something that a paper says of two cases, or (a number in `published`) of one.

    `note` is added to the words; `cause` says why it does not hold here, '' if no run has shown it.
    """

    says: str
    quantity: str
    first: str = ''
    second: str = ''
    case: str = ''
    expects: Literal['less', 'greater', 'alike', 'number'] = 'less'
    note: str = ''
    cause: str = ''


@dataclass
class Outcome:
    """Results of one run: numbers, texts or None by quantity, and columns with a row for each step.

    Details are other data of figures; timing is wall times, which differ when a run is repeated.
    """

    summary: dict[str, Any]
    columns: Mapping[str, Any] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)
    timing: dict[str, float] = field(default_factory=dict)


@dataclass(kw_only=True)
class Run(Outcome):
    """The outcome of one run: number of the map, digest of its settings, and the machine."""

    experiment: str
    case: str
    number: int
    seed: int
    digest: str
    machine: dict[str, str]

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
    """A figure or table of a paper.

    `cases` returns the cases; with True small ones that take a second, for tests and a first look.
    `run` runs a case once, from its settings and the seed of the map, the same for every case.
    `quantities` are the columns of the table. `draw` draws a figure in the form of the paper's.
    `published` are the paper's numbers, `comparisons` paired differences, `claims` what the paper
    says of them, and `choices` open points of the paper. `tested` are causes of differences from
    the paper that runs have shown. `runs` are the maps in the paper, `seconds` the approximate time
    of a run on one core. Experiments with the same `maps` have the same maps; None: maps of its
    own. `compared`: searches are compared, and the seed is the number of the map.
    """

    name: str
    title: str
    cases: Callable[[bool], list[Case]]
    run: Callable[[dict[str, Any], int], Outcome]
    quantities: Sequence[Quantity]
    draw: Callable[[Figure, Results], None]
    published: Sequence[Published] = ()
    comparisons: Sequence[Comparison] = ()
    claims: Sequence[Claim] = ()
    choices: Sequence[OpenPoint] = ()
    tested: str = ''
    runs: int = 10
    seconds: float = 2.0
    maps: str | None = None
    note: str = ''
    compared: bool = False

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
