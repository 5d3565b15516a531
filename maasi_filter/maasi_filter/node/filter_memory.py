"""A filter and its progress in a run, in a file that survives the death of the process."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_filter.make_filter import filter_from_state
from maasi_filter.search_filter import SearchFilter
from maasi_filter.state_file import StateFileError, read_state, text, untext, write_state

# Names of the arrays that are not part of the state of the filter.
_PROGRESS, _UPDATE = 'progress', 'update'


@dataclass
class Progress:
    """Progress of a run after a batch.

    Attributes
    ----------
    batch : int
        Id of the last batch.
    stamp : int
        Of the last batch [ns].
    step : int
        Of the last batch.
    settled_by : dict
        Id of the batch that completed each found target, by the id of the target.
    heard : dict
        Batch, measurement and stamp [ns] of the last detections, by robot.
    update : bytes
        The last update, as published and serialised; it may not have been sent yet.
    """

    batch: int
    stamp: int
    step: int
    settled_by: dict[int, int] = field(default_factory=dict)
    heard: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    update: bytes = b''


class FilterMemory:
    """Keeps a filter with its progress in a file, replaced atomically after each batch.

    The file survives the death of the process, not a power failure: it is not forced to the disk.

    Parameters
    ----------
    path : str
        The file; its folder is created.
    """

    def __init__(self, path: str) -> None:
        self.path = Path(path)

    def save(self, search: SearchFilter, progress: Progress) -> None:
        """Save both.

        Raises
        ------
        OSError
            If the file cannot be written; the old one is kept.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        values = asdict(progress)
        update = values.pop('update')
        state = search.state()
        state[_PROGRESS] = text(json.dumps(values))
        state[_UPDATE] = np.frombuffer(update, np.uint8)
        write_state(self.path, state, durable=False)

    def load(self) -> tuple[SearchFilter, Progress] | None:
        """Return the saved filter and progress, or None without a file.

        Raises
        ------
        StateFileError
            If the file cannot be used.
        """
        if not self.path.exists():
            return None
        state = read_state(self.path)
        search = filter_from_state(state, self.path)
        try:
            return search, _progress(state)
        except KeyError as error:
            raise StateFileError(f'{self.path}: does not hold a progress: no {error}') from None
        except (ValueError, TypeError) as error:
            raise StateFileError(f'{self.path}: does not hold a progress: {error}') from None

    def set_aside(self) -> Path:
        """Rename a file that cannot be used, to keep it for inspection; return its new name."""
        aside = self.path.with_name(f'{self.path.name}.refused')
        self.path.replace(aside)
        return aside

    def forget(self) -> None:
        """Remove the file of a search that has ended."""
        self.path.unlink(missing_ok=True)


def _progress(state: Mapping[str, NDArray[Any]]) -> Progress:
    values = json.loads(untext(state[_PROGRESS]))
    numbers = {name: int(values[name]) for name in ('batch', 'stamp', 'step')}
    heard = {str(name): tuple(map(int, item)) for name, item in values['heard'].items()}
    for name, item in heard.items():
        if len(item) != 3:
            raise ValueError(f'heard: {name}: got {len(item)} numbers, allowed are 3')
    return Progress(
        **numbers,
        settled_by={int(key): int(item) for key, item in values['settled_by'].items()},
        heard=heard,  # type: ignore[arg-type]
        update=state[_UPDATE].tobytes(),
    )
