"""Parts of an experiment: cases, measured quantities, published numbers, results."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from numpy.typing import ArrayLike

Value = float | int | str | bool | None


@dataclass(frozen=True)
class Choice:
    """Something that the paper leaves open, the value chosen here, and the reason."""

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
        Everything that a run needs, as plain values for YAML and JSON.
    preset : str
        'paper': the best reading of the paper; 'recommended': our own choice.
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
        """Return a short hash of the settings, by which stored runs are recognised."""
        text = json.dumps(self.settings, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Quantity:
    """A measured quantity: a key of `Outcome.summary` or `Outcome.timing`.

    Attributes
    ----------
    name : str
        The key.
    label : str
        In words.
    unit : str
        Empty for plain numbers.
    kind : str
        'mean': averaged over the runs that have it. 'restricted': a duration that is None in
        unfinished runs; its mean is restricted to the shortest limit of the runs.
    limit : str
        Of a restricted one: key of the limit in the summary.
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
        As printed, or as read from the figure (then stated in `note`).
    half_width : float, optional
        Of the paper's 95 % confidence interval.
    runs : int
        Number of runs.
    note : str
        Its place in the paper.
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
    """Results of one run.

    Attributes
    ----------
    summary : dict
        A number, text or None by quantity.
    columns : dict of arrays
        One row per step, all columns of the same length.
    details : dict
        Other data of figures, such as true positions: lists and numbers.
    timing : dict
        Wall times; the one part that differs when a run is repeated.
    """

    summary: dict[str, Value]
    columns: Mapping[str, ArrayLike] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)
    timing: dict[str, float] = field(default_factory=dict)
