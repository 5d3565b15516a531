"""A filter and its progress in a run, in a file that survives the death of the process."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from maasi_filter.make_filter import filter_of
from maasi_filter.search_filter import SearchFilter
from maasi_filter.state_file import SavedState, write_state


@dataclass
class Progress:
    """Progress of a run after a batch."""

    batch: int  # Id of the last batch
    stamp: int  # Of the last batch [ns]
    step: int  # Of the last batch
    #: Id of the batch that completed each found target, by the id of the target.
    settled_by: dict[int, int] = field(default_factory=dict)
    #: Batch, measurement and stamp [ns] of the last detections, by robot.
    heard: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    #: The last update, as published and serialised; it may not have been sent yet.
    update: bytes = b''


class FilterMemory:
    """Keeps a filter with its progress in a file, replaced atomically after each batch.

    The file survives the death of the process, not a power failure: it is not forced to the disk.
    """

    def __init__(self, path: str) -> None:
        self.path = Path(path)

    def save(self, search: SearchFilter, progress: Progress) -> None:
        """Save both; OSError if the file cannot be written: the old one is kept."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        state = search.state()
        write_state(self.path, {state.method: state, 'progress': progress}, durable=False)

    def load(self) -> tuple[SearchFilter, Progress] | None:
        """Return the saved filter and progress, or None without a file."""
        if not self.path.exists():
            return None
        saved = SavedState(self.path)
        return filter_of(saved), saved.read('progress', Progress)

    def set_aside(self) -> Path:
        """Rename a file that cannot be used, to keep it for inspection; return its new name."""
        aside = self.path.with_name(f'{self.path.name}.refused')
        self.path.replace(aside)
        return aside

    def forget(self) -> None:
        """Remove the file of a search that has ended."""
        self.path.unlink(missing_ok=True)
