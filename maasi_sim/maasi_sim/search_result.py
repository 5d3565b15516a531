"""The result of a search in one process."""

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.records import FoundTarget
from maasi_planner.team import Decision
from maasi_sim.run.targets.tables import columns, found_rows
from maasi_sim.run.targets.tally import FoundCount, Scores
from maasi_sim.run.view.live_view import SearchTrace
from maasi_sim.run.view.page_file import write_replay
from maasi_sim.scenario.schema import Scenario


@dataclass(frozen=True)
class SearchState(FoundCount):
    """State of a search after a measurement batch."""

    rmse: float  #: of the true targets among those found [m]; nan without any
    members: tuple[str, ...]  #: robots that measured
    positions: dict[str, FloatArray]  #: of all robots, (3,) [m]


@dataclass
class SearchResult:
    """Result of a search.

    Attributes
    ----------
    scenario : Scenario
        That was run.
    trace : SearchTrace
        For a replay.
    measurements, distance : dict
        Number of measurements, and distance travelled, of each robot [m].
    end_reason : str
        'all_found', 'planner_done', 'time_limit' or 'measurement_limit'.
    steps : int
        Length of the search.
    found_targets : list of FoundTarget
        At the end.
    truth : (n, d) array
        True targets [m].
    scores : Scores
        Of the found targets against the truth.
    progress : list of SearchState
        After each measurement batch.
    decisions : list of Decision
        In their order.
    filter_times, planning_times : list of float
        Wall time of each filter step and of each decision [s].
    """

    scenario: Scenario
    trace: SearchTrace = field(repr=False, compare=False)
    measurements: dict[str, int]
    distance: dict[str, float] = field(default_factory=dict)
    end_reason: str = ''
    steps: int = 0
    found_targets: list[FoundTarget] = field(default_factory=list)
    truth: FloatArray = field(init=False)
    scores: Scores = field(init=False)
    progress: list[SearchState] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    filter_times: list[float] = field(default_factory=list)
    planning_times: list[float] = field(default_factory=list)

    @property
    def missed(self) -> int:
        """True targets without a found one."""
        return self.scores.match.missed

    @property
    def false_found(self) -> int:
        """Found targets without a true one."""
        return self.scores.match.false_found

    @property
    def rmse(self) -> float:
        """Of the true ones among those found [m]; nan without any."""
        return self.scores.match.rmse

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Index of a found target, and of the true one that it is."""
        return self.scores.match.pairs

    @property
    def total_measurements(self) -> int:
        """Measurements of all robots."""
        return sum(self.measurements.values())

    @property
    def complete(self) -> bool:
        """Whether all targets are found, and nothing else."""
        return self.missed == 0 and self.false_found == 0

    def columns(self) -> dict[str, Any]:
        """Return the progress by columns, with places of robots and whether they measured."""
        progress = self.progress
        kinds = ('step', 'time', 'measurements', 'found', 'true_found', 'rmse')
        columns: dict[str, Any] = {
            kind: [getattr(item, kind) for item in progress] for kind in kinds
        }
        for name in sorted(self.measurements):
            places = np.array([item.positions[name] for item in progress]).reshape(-1, 3)
            columns |= {f'{name}_{axis}': values for axis, values in zip('xyz', places.T)}
            columns[f'{name}_measures'] = [name in item.members for item in progress]
        return columns

    def save_replay(self, path: str | Path) -> None:
        """Write a page that shows the search, one HTML file.

        Raises
        ------
        ResultsError
            If it cannot be written.
        """
        path = Path(path)
        write_replay(self.trace.log(path.stem), path)

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
        if table not in ('found_targets', 'progress'):
            raise ValueError(f"table: got {table!r}, allowed are 'found_targets', 'progress'")
        try:
            pandas = import_module('pandas')
        except ImportError:
            raise ImportError(
                'to_dataframe needs pandas, which is not installed: pip install pandas'
            ) from None
        if table == 'found_targets':
            origin = self.scenario.environment.origin
            rows = found_rows(self.found_targets, self.truth, self.pairs, origin)
            frame = pandas.DataFrame(rows, columns=columns(self.truth.shape[1], origin))
            return frame.astype({'target': 'Int64', 'error': float})
        return pandas.DataFrame(self.columns())
