"""Files of runs, one each: JSON with a checksum, written atomically; and tables of all runs."""

import contextlib
import csv
import errno
import hashlib
import io
import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from maasi_sim.experiments.experiment import Case, Outcome, Run, plain
from maasi_sim.machine import this_machine


class DamagedRun(ValueError):
    """A file of a run whose content is not what was written."""


class NoRoom(OSError):
    """A file cannot be written."""


def run_of(experiment: str, case: Case, number: int, seed: int, outcome: Outcome) -> Run:
    """Return an outcome as a run on this machine."""
    columns = {name: np.asarray(values, float) for name, values in outcome.columns.items()}
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        raise ValueError(f'{experiment}: columns of {sorted(lengths)} rows, allowed is one')
    return Run(
        plain(outcome.summary),
        columns,
        plain(outcome.details),
        plain(outcome.timing),
        experiment=experiment,
        case=case.name,
        number=number,
        seed=seed,
        digest=case.digest(),
        machine=this_machine(),
    )


def to_text(run: Run) -> str:
    """Return a run as the text of its file."""
    facts = json.dumps(plain(asdict(run)), allow_nan=False)
    return f'{{"sha256": "{_checksum(facts)}",\n"run": {facts}}}\n'


def load_run(path: Path) -> Run:
    """Return the run in a file."""
    try:
        content = json.loads(path.read_bytes())
        checksum, facts = content['sha256'], content['run']
    except (ValueError, KeyError, TypeError):
        raise DamagedRun(f'{path}: is not the file of a run') from None
    if checksum != _checksum(json.dumps(facts)):
        raise DamagedRun(f'{path}: the checksum does not match')
    columns = {name: np.array(values, float) for name, values in facts.pop('columns').items()}
    return Run(columns=columns, **facts)


def _checksum(facts: str) -> str:
    return hashlib.sha256(facts.encode()).hexdigest()


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file atomically: afterwards it is complete, or as before."""
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


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    """Return rows as CSV; None and non-finite numbers become empty cells."""
    out = io.StringIO()
    csv.writer(out, lineterminator='\n').writerows(
        ['' if isinstance(cell, float) and not math.isfinite(cell) else cell for cell in row]
        for row in rows
    )
    return out.getvalue()


def _cell(value: float) -> str:
    return str(int(value)) if float(value).is_integer() else repr(float(value))


def steps_text(runs: Sequence[Run]) -> str:
    """Return all runs as one CSV, one row per run and step."""
    names = list(dict.fromkeys(name for run in runs for name in run.columns))
    rows: list[list[Any]] = [['case', 'map', *names]]
    for run in runs:
        length = max((len(values) for values in run.columns.values()), default=0)
        cells = (map(_cell, run.columns[n]) if n in run.columns else [''] * length for n in names)
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
