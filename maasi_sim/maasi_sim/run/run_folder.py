"""The folder of a run, and files that are written whole or not at all."""

import contextlib
import errno
import itertools
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

from maasi_sim.scenario.layering import ScenarioError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # disk full, quota exceeded, or file too large


class ResultsError(RuntimeError):
    """The results cannot be written: the disk is full, or fails."""


def make_folder(out: Path | None, suffix: str = '') -> Path:
    """Return a new folder of a run: `out`, or one named by the time in `runs`."""
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            if (out / 'bag').exists() or (out / 'report.json').exists():
                raise ScenarioError(
                    f'--out: {out} already contains a run, allowed is another folder'
                )
            return out.resolve()
        stamp = datetime.now().strftime('%Y%m%d_%H%M%S') + suffix
        for number in itertools.count(1):
            folder = Path('runs') / (stamp if number == 1 else f'{stamp}_{number}')
            with contextlib.suppress(FileExistsError):
                folder.mkdir(parents=True)
                break
        return folder.resolve()
    except OSError as error:
        kind = ResultsError if error.errno in _FULL else ScenarioError
        raise kind(f'--out: {error.filename}: {error.strerror}') from None


def write_text(path: Path, text: str | bytes) -> None:
    """Write a file of the run; its folder is made."""
    try:
        path.parent.mkdir(exist_ok=True)
        data = text.encode() if isinstance(text, str) else text
        write_whole(path, lambda file: file.write_bytes(data))
    except OSError as error:
        raise ResultsError(f'{path}: {error.strerror}') from error


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a file whole or not at all."""
    part = path.with_name(f'part_{path.name}')
    try:
        write(part)
        part.replace(path)
    except BaseException:
        remove(part)
        raise


def remove(path: Path) -> None:
    """Remove a file if it is there."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
