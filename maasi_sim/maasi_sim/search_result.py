"""The result of a search in one process."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maasi_filter.arrays import FloatArray
from maasi_filter.records import FoundTarget
from maasi_planner.team import Decision
from maasi_sim.scenario.base import OriginSettings
from maasi_sim.targets.tables import data_frame
from maasi_sim.targets.tally import FoundCount
from maasi_sim.view.search_trace import SearchTrace


@dataclass(frozen=True)
class SearchState(FoundCount):
    """State of a search after a measurement batch.

    Attributes
    ----------
    time : float
        [s].
    step : int
        k.
    measurements : int
        Number so far, of all robots.
    found, true_found : int
        Targets found so far, and the number of true ones among them.
    rmse : float
        Of the true ones [m]; nan without any.
    members : tuple of str
        Robots that measured.
    positions : dict
        Of all robots, (3,) [m].
    """

    rmse: float
    members: tuple[str, ...]
    positions: dict[str, FloatArray]


@dataclass
class SearchResult:
    """Result of a search.

    Attributes
    ----------
    end_reason : str
        'all_found', 'planner_done' or 'time_limit'.
    found_targets : list of FoundTarget
        At the end.
    truth : (n, d) array
        True targets [m].
    missed, false_found : int
        True targets without a found one, and found ones without a true one.
    rmse : float
        Of the true ones among those found [m]; nan without any.
    measurements : dict
        Number of each robot.
    distance : dict
        Distance travelled by each robot [m].
    steps : int
        Length of the search.
    progress : list of SearchState
        After each measurement batch.
    decisions : list of Decision
        In their order.
    filter_times, planning_times : list of float
        Wall time of each filter step and of each decision [s].
    trace : SearchTrace or None
        For a replay.
    pairs : list of (int, int)
        Index of a found target, and of the true one that it is.
    origin : OriginSettings or None
        Of the map on the earth.
    """

    end_reason: str
    found_targets: list[FoundTarget]
    truth: FloatArray
    missed: int
    false_found: int
    rmse: float
    measurements: dict[str, int]
    distance: dict[str, float]
    steps: int
    progress: list[SearchState] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    filter_times: list[float] = field(default_factory=list)
    planning_times: list[float] = field(default_factory=list)
    trace: SearchTrace | None = field(default=None, repr=False, compare=False)
    pairs: list[tuple[int, int]] = field(default_factory=list)
    origin: OriginSettings | None = None

    def save_replay(self, path: str | Path) -> None:
        """Write a page that shows the search, one HTML file.

        Raises
        ------
        ResultsError
            If it cannot be written.
        """
        assert self.trace is not None, 'a result that `search` returned has a trace'
        self.trace.save_replay(Path(path))

    def to_dataframe(self, table: str = 'found_targets') -> Any:
        """Return a pandas data frame.

        Parameters
        ----------
        table : str
            'found_targets': a row for each, with the columns of `found_targets.csv`. 'progress': a
            row for each measurement batch, with the fields of `SearchState` and the
            places of robots.

        Raises
        ------
        ImportError
            If pandas is not installed.
        ValueError
            If there is no such table.
        """
        return data_frame(self, table)

    @property
    def total_measurements(self) -> int:
        """Measurements of all robots."""
        return sum(self.measurements.values())

    @property
    def complete(self) -> bool:
        """Whether all targets are found, and nothing else."""
        return self.missed == 0 and self.false_found == 0
