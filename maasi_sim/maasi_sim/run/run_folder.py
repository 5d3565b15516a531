"""Where the results of a run go, also when the disk is full."""

from __future__ import annotations

import contextlib
import errno
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maasi_sim.scenario.layering import ScenarioError

if TYPE_CHECKING:
    from maasi_sim.buildings.observer import CuboidRecord
    from maasi_sim.run.observer import RunRecord

# The disk, or the user's share of it, is full; or a file is longer than allowed.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class ResultsError(RuntimeError):
    """The results cannot be written: the disk is full, or fails."""


@dataclass(frozen=True)
class StoredReport:
    """A report, what to say of it, and where it is.

    Attributes
    ----------
    report : dict
        What stands in `report.json`.
    words : str
        Its summary.
    folder : Path or None
        That holds it; None: it could be written nowhere.
    problem : str
        Why it is not in the folder of the run; empty if it is.
    """

    report: dict[str, Any]
    words: str
    folder: Path | None
    problem: str = ''


def make_folder(out: Path | None, suffix: str = '') -> Path:
    """Return a new folder of a run: `out`, or one named by the time in `runs`.

    Raises
    ------
    ScenarioError
        If it cannot be made, or holds a run already.
    ResultsError
        If the disk is full.
    """
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            if (out / 'bag').exists() or (out / 'report.json').exists():
                raise ScenarioError(f'--out: {out} holds a run already, allowed is another folder')
            return out.resolve()
        stamp = datetime.now().strftime('%Y%m%d_%H%M%S') + suffix
        for number in range(1, 1000):
            folder = Path('runs') / (stamp if number == 1 else f'{stamp}_{number}')
            try:
                folder.mkdir(parents=True)
            except FileExistsError:
                continue
            return folder.resolve()
    except OSError as error:
        kind = ResultsError if error.errno in _FULL else ScenarioError
        raise kind(f'--out: {error.filename}: {error.strerror}') from None
    raise ScenarioError(f'--out: runs/{stamp} exists a thousand times')


def write_text(path: Path, text: str) -> None:
    """Write a file of the run.

    Raises
    ------
    ResultsError
        If it cannot be written; nothing of it is left.
    """
    try:
        write_whole(path, lambda file: file.write_text(text, encoding='utf-8'))
    except OSError as error:
        raise ResultsError(f'{path}: {error.strerror}') from error


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a file whole or not at all."""
    part = path.with_name(f'part_{path.name}')
    try:
        write(part)
        part.replace(path)
    except BaseException:
        _remove(part)
        raise


def store_report(record: RunRecord | CuboidRecord, folder: Path) -> StoredReport:
    """Write a report into the folder of the run; elsewhere if it must be.

    Elsewhere is a new folder below the first of these that has room: that of temporary files, the
    home of the user, `/dev/shm`.
    """
    from maasi_sim.buildings.observer import CuboidRecord
    from maasi_sim.buildings.report import build_cuboid_report, cuboid_summary, write_cuboid_report
    from maasi_sim.run.report import build_report, summary, write_report

    build: Callable[[Any], dict[str, Any]] = build_report
    write: Callable[[Any, Path], dict[str, Any]] = write_report
    describe = summary
    if isinstance(record, CuboidRecord):
        build, write, describe = build_cuboid_report, write_cuboid_report, cuboid_summary
    try:
        report = write(record, folder)
        return StoredReport(report, describe(report), folder)
    except (OSError, ResultsError) as error:
        problem = f'{folder}: the report cannot be written: {_reason(error)}'
    _remove(folder / 'report.json')
    for base in (Path(tempfile.gettempdir()), Path.home(), Path('/dev/shm')):
        try:
            place = Path(tempfile.mkdtemp(prefix='maasi_report_', dir=base))
        except OSError:
            continue
        try:
            report = write(record, place)
            return StoredReport(report, describe(report), place, problem)
        except (OSError, ResultsError):
            _remove(place / 'report.json')
            with contextlib.suppress(OSError):
                place.rmdir()
    report = build(record)
    return StoredReport(report, describe(report), None, problem)


def _reason(error: BaseException) -> str:
    cause = error.__cause__ or error
    return getattr(cause, 'strerror', None) or str(error)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
