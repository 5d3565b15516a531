"""The record of a search in one process, and what is written of it."""

from importlib import import_module
from pathlib import Path
from typing import Any

from maasi_sim.run.log import RunLog
from maasi_sim.run.targets.tables import columns, found_rows


class SearchResult(RunLog):
    """The log of a search, see `RunLog`."""

    def save_replay(self, path: str | Path) -> None:
        """Write a page that shows the search, one HTML file.

        Raises
        ------
        ResultsError
            If it cannot be written.
        """
        # Deferred: only a page needs a web server.
        from maasi_sim.run.view.page_file import write_replay
        from maasi_sim.run.view.search_page import event_log

        path = Path(path)
        write_replay(event_log(self, path.stem), path)

    def to_dataframe(self, table: str = 'found_targets') -> Any:
        """Return a pandas data frame.

        Parameters
        ----------
        table : str
            'found_targets': a row for each, with the columns of `found_targets.csv`. 'progress': a
            row for each update, with the fields of `Count` and the places of robots.

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
