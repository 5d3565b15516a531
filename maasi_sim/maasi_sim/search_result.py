"""The result of a search in one process, and its outputs."""

from importlib import import_module
from pathlib import Path
from typing import Any

from maasi_sim.run.log import RunLog
from maasi_sim.run.targets.tables import columns, found_rows


class SearchResult(RunLog):
    """Result of a search in one process: found targets, scores, progress and events.

    `found_targets`, `missed`, `rmse` [m], `total_measurements`, `progress` and `end_reason` are
    those of `RunLog`.
    """

    def save_replay(self, path: str | Path) -> None:
        """Write a page that shows the search, as one HTML file.

        Parameters
        ----------
        path : str or Path
            File to write.

        Raises
        ------
        ResultsError
            If it cannot be written.
        """
        # Deferred: only a page needs a web server.
        from maasi_sim.run.view.page_file import write_replay
        from maasi_sim.run.view.recording import event_log

        path = Path(path)
        write_replay(event_log(self, path.stem), path)

    def to_dataframe(self, table: str = 'found_targets') -> Any:
        """Return a pandas data frame.

        Parameters
        ----------
        table : str
            'found_targets': one row per target, with the columns of `found_targets.csv`.
            'progress': one row per update, with the fields of `Count` and robot positions.

        Raises
        ------
        ImportError
            If pandas is not installed.
        ValueError
            If the table is unknown.
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
