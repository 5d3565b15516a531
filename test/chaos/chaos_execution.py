"""Run a case of the fault campaign: start it, inject the fault, wait for its end."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from chaos_cases import PAUSE, Case

from maasi_sim.scenario.layering import to_yaml

# Longest wait for the moment of the fault, and for the end of the run after it [s].
_TRIGGER_PATIENCE, _END_PATIENCE = 120.0, 120.0
_LOOK_PERIOD = 0.02
_FOUND = re.compile(r'(\d+) (?:found|visited)')


@dataclass
class Outcome:
    """Result of a run.

    Attributes
    ----------
    folder : Path
        Of the run.
    code : int or None
        Exit code; None: it did not end.
    output : str
        Printed text.
    struck : bool
        Whether the fault was injected.
    ended_after : float
        From the fault to the end [s].
    left : list of str
        Command lines of processes that were still running after the end.
    """

    folder: Path
    code: int | None
    output: str
    struck: bool
    ended_after: float
    left: list[str]


class _Output:
    """Reads the output of a running process."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.lines: list[str] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        self.lines.extend(iter(self._process.stdout.readline, ''))

    def found(self) -> int:
        """Return the number of targets found, or cells visited, so far."""
        matches = [_FOUND.search(line) for line in list(self.lines)]
        return max((int(match.group(1)) for match in matches if match), default=0)

    def text(self) -> str:
        """Return the whole output, after the end."""
        self._thread.join(5.0)
        return ''.join(self.lines)


def execute(case: Case, folder: Path, seed: int) -> Outcome:
    """Run a case in a new folder."""
    folder.mkdir(parents=True)
    file, run = folder / 'scenario.yaml', folder / 'run'
    file.write_text(to_yaml(case.scenario()), encoding='utf-8')
    command = [sys.executable, '-m', 'maasi_sim.run.run_scenario', str(file), '--out', str(run)]
    process = subprocess.Popen(
        [*command, '--seed', str(seed), *case.options()],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    output = _Output(process)
    struck, at = False, time.monotonic()
    try:
        victims = _victims(case, run, process, output)
        at = time.monotonic()
        struck = bool(victims) and _strike(case, victims)
        process.wait(_END_PATIENCE)
    except subprocess.TimeoutExpired:
        pass
    ended_after = time.monotonic() - at
    code = process.poll()
    left = processes_of(run)
    if code is None:
        process.kill()
        process.wait()
    for pid in processes_of(run):
        _send(pid, signal.SIGKILL)
    return Outcome(run, code, output.text(), struck, ended_after, list(left.values()))


def _victims(case: Case, run: Path, process: subprocess.Popen[str], output: _Output) -> list[int]:
    """Return the processes of the case's nodes at the moment of the fault; none: the run ended."""
    deadline = time.monotonic() + _TRIGGER_PATIENCE
    while time.monotonic() < deadline and process.poll() is None:
        if case.when == 'start' or output.found() > 0:
            found = {name: _pid(run, name) for name in case.nodes}
            pids = [pid for pid in found.values() if pid is not None]
            if len(pids) == len(case.nodes):
                return pids
        time.sleep(_LOOK_PERIOD)
    return []


def _strike(case: Case, victims: list[int]) -> bool:
    number = signal.SIGKILL if case.fault == 'kill' else signal.SIGSTOP
    # All of them, even if the first has ended.
    done = [_send(pid, number) for pid in victims]
    if case.fault == 'pause':
        time.sleep(PAUSE)
        for pid in victims:
            _send(pid, signal.SIGCONT)
    return all(done)


def _send(pid: int, number: signal.Signals) -> bool:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


def _pid(run: Path, node: str) -> int | None:
    """Return the process of a node: its parameter file is in its command line."""
    file = str(run / 'parameters' / f'{node.strip("/").replace("/", "_")}.yaml')
    return next((pid for pid, line in processes_of(run).items() if file in line), None)


def processes_of(run: Path) -> dict[int, str]:
    """Return the processes with a run's folder in their command line, without zombies."""
    found = {}
    for entry in Path('/proc').iterdir():
        if not entry.name.isdigit():
            continue
        try:
            line = (entry / 'cmdline').read_bytes().replace(b'\0', b' ').decode(errors='replace')
        except OSError:
            continue
        if f'{run}/' in line:
            found[int(entry.name)] = line
    return found
