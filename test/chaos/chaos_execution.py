"""Run a case of the fault campaign: start it, inject the fault, wait for its end."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
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

    The code is None if it did not end; `left` are command lines of processes that still ran then.
    """

    folder: Path
    code: int | None
    output: str
    struck: bool
    ended_after: float
    left: list[str]


def _found(output: Path) -> int:
    """Return the number of targets found, or cells visited, so far."""
    return max(map(int, _FOUND.findall(output.read_text())), default=0)


def execute(case: Case, folder: Path, seed: int) -> Outcome:
    """Run a case in a new folder."""
    folder.mkdir(parents=True)
    file, run = folder / 'scenario.yaml', folder / 'run'
    file.write_text(to_yaml(case.scenario()), encoding='utf-8')
    command = [sys.executable, '-m', 'maasi_sim.run.run_scenario', str(file), '--out', str(run)]
    output = folder / 'output.txt'
    with output.open('w') as stream:
        process = subprocess.Popen(
            [*command, '--seed', str(seed), *case.options()],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
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
    left = processes_of(f'{run}/')
    if code is None:
        process.kill()
        process.wait()
    for pid in processes_of(f'{run}/'):
        _send(pid, signal.SIGKILL)
    return Outcome(run, code, output.read_text(), struck, ended_after, list(left.values()))


def _victims(case: Case, run: Path, process: subprocess.Popen[bytes], output: Path) -> list[int]:
    """Return the processes of the case's nodes at the moment of the fault; none: the run ended."""
    deadline = time.monotonic() + _TRIGGER_PATIENCE
    while time.monotonic() < deadline and process.poll() is None:
        if case.when == 'start' or _found(output) > 0:
            pids = [pid for node in case.nodes for pid in _pids(run, node)]
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


def _pids(run: Path, node: str) -> list[int]:
    """Return the process of a node: its parameter file is in its command line."""
    file = run / 'parameters' / f'{node.strip("/").replace("/", "_")}.yaml'
    return list(processes_of(str(file)))


def processes_of(text: str) -> dict[int, str]:
    """Return the processes with a text in their command line, without this one and zombies."""
    found = {}
    for entry in Path('/proc').glob('[0-9]*'):
        try:
            line = (entry / 'cmdline').read_bytes().replace(b'\0', b' ').decode(errors='replace')
        except OSError:
            continue
        if text in line and int(entry.name) != os.getpid():
            found[int(entry.name)] = line
    return found
