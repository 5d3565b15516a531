"""Files of runs, one each: written atomically, with a checksum."""

from __future__ import annotations

import contextlib
import csv
import errno
import hashlib
import io
import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_sim.experiments.cases import Case, Outcome, Value

FloatArray = NDArray[np.float64]

_HEAD = '# maasi run, sha256 '


class DamagedRun(ValueError):
    """A file of a run whose content is not what was written."""


class NoRoom(OSError):
    """A file cannot be written."""


@dataclass
class Run:
    """One run of one case on one map.

    Attributes
    ----------
    experiment, case : str
        Names.
    number : int
        Of the map, from 0.
    seed : int
        Of all its random numbers.
    digest : str
        Of the case's settings.
    summary, columns, details, timing
        See `Outcome`.
    machine : dict
        That made it, see `this_machine`; empty in files of earlier versions.
    """

    experiment: str
    case: str
    number: int
    seed: int
    digest: str
    summary: dict[str, Value]
    columns: dict[str, FloatArray] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)
    timing: dict[str, float] = field(default_factory=dict)
    machine: dict[str, str] = field(default_factory=dict)

    def value(self, quantity: str) -> float | None:
        """Return a measured quantity; None if the run has none."""
        read = self.summary.get(quantity, self.timing.get(quantity))
        return None if read is None or isinstance(read, str) else float(read)


def run_of(experiment: str, case: Case, number: int, seed: int, outcome: Outcome) -> Run:
    """Return an outcome as a run.

    Raises
    ------
    ValueError
        If the columns differ in length.
    """
    columns = {name: np.asarray(values, float) for name, values in outcome.columns.items()}
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        raise ValueError(f'{experiment}: columns of {sorted(lengths)} rows, allowed is one')
    return Run(
        experiment,
        case.name,
        number,
        seed,
        case.digest(),
        plain(outcome.summary),
        columns,
        plain(outcome.details),
        plain(outcome.timing),
    )


def plain(value: Any) -> Any:
    """Return a value for JSON; non-finite numbers become None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def to_text(run: Run) -> str:
    """Return a run as the text of its file: checksum, facts as JSON, rows as CSV."""
    facts = {
        'experiment': run.experiment,
        'case': run.case,
        'number': run.number,
        'seed': run.seed,
        'digest': run.digest,
        'summary': run.summary,
        'details': run.details,
        'timing': run.timing,
        'machine': run.machine,
    }
    rows = zip(*(map(_number, values) for values in run.columns.values()))
    text = f'# {json.dumps(facts, allow_nan=False)}\n{csv_text([run.columns, *rows])}'
    return f'{_HEAD}{hashlib.sha256(text.encode()).hexdigest()}\n{text}'


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    """Return rows as CSV; None and non-finite numbers become empty cells."""
    out = io.StringIO()
    csv.writer(out, lineterminator='\n').writerows(
        ['' if isinstance(cell, float) and not math.isfinite(cell) else cell for cell in row]
        for row in rows
    )
    return out.getvalue()


def _number(value: float) -> str:
    return str(int(value)) if float(value).is_integer() else repr(float(value))


def from_text(text: str, origin: str = 'run') -> Run:
    """Return the run of a file's text.

    Raises
    ------
    DamagedRun
        If anything is missing or changed.
    """
    head, _, body = text.partition('\n')
    if not head.startswith(_HEAD):
        raise DamagedRun(f'{origin}: is not the file of a run')
    if head[len(_HEAD) :] != hashlib.sha256(body.encode()).hexdigest():
        raise DamagedRun(f'{origin}: the checksum does not match')
    first, _, rows = body.partition('\n')
    facts = json.loads(first[2:])
    read = list(csv.reader(io.StringIO(rows)))
    names = read[0] if read else []
    table = np.array(read[1:], dtype=float).reshape(-1, len(names))
    return Run(columns={name: table[:, i] for i, name in enumerate(names)}, **facts)


def load_run(path: Path) -> Run:
    """Return the run in a file.

    Raises
    ------
    DamagedRun
        If it is damaged.
    """
    try:
        return from_text(path.read_bytes().decode('utf-8'), str(path))
    except UnicodeDecodeError:
        raise DamagedRun(f'{path}: is not text') from None


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file atomically: afterwards it is complete, or as before.

    Raises
    ------
    NoRoom
        If the disk is full or the folder is not writable.
    """
    data = content.encode() if isinstance(content, str) else content
    draft = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with draft.open('wb') as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        reason = 'no room on the disk' if full else error.strerror
        raise NoRoom(error.errno, f'{path}: cannot be written: {reason}') from None


class RunFolder:
    """The folder of an experiment's runs.

    Parameters
    ----------
    path : Path
        Created with the first run.
    experiment : str
        Its name.
    """

    def __init__(self, path: Path, experiment: str) -> None:
        self.path = path
        self.experiment = experiment

    def file(self, case: Case, number: int) -> Path:
        """Return the file of a run."""
        return self.path / 'runs' / f'{case.slug}-{number:04d}.csv'

    def maps(self) -> int:
        """Return the largest number of a map with runs, plus one."""
        numbers = [
            int(path.stem.rsplit('-', 1)[1])
            for path in (self.path / 'runs').glob('*-[0-9][0-9][0-9][0-9].csv')
        ]
        return max(numbers, default=-1) + 1

    def load(self, case: Case, number: int, seed: int) -> Run | None:
        """Return a stored run, None if there is none with these settings and seed.

        Raises
        ------
        DamagedRun
            If its file is damaged.
        """
        path = self.file(case, number)
        if not path.exists():
            return None
        run = load_run(path)
        wanted = (self.experiment, case.name, number, seed, case.digest())
        found = (run.experiment, run.case, run.number, run.seed, run.digest)
        return run if found == wanted else None

    def write(self, case: Case, number: int, text: str) -> None:
        """Write the file of a run."""
        write_file(self.file(case, number), text)


def steps_text(runs: Sequence[Run]) -> str:
    """Return all runs as one CSV, one row per run and step."""
    names = list(dict.fromkeys(name for run in runs for name in run.columns))
    rows: list[list[Any]] = [['case', 'map', *names]]
    for run in runs:
        length = max((len(values) for values in run.columns.values()), default=0)
        cells = (map(_number, run.columns[n]) if n in run.columns else [''] * length for n in names)
        rows += [[run.case, run.number, *row] for row in zip(*cells)]
    return csv_text(rows)


def runs_text(runs: Sequence[Run]) -> str:
    """Return the results of all runs as CSV, one row per run."""
    names = list(dict.fromkeys(name for run in runs for name in (*run.summary, *run.timing)))
    rows: list[list[Any]] = [['case', 'map', 'seed', *names]]
    for run in runs:
        known = {**run.summary, **run.timing}
        rows.append([run.case, run.number, run.seed, *(known.get(name) for name in names)])
    return csv_text(rows)
