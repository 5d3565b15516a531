"""Run a case of the fault campaign: start it, inject the fault, wait for its end."""

import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from chaos_cases import PAUSE

from maasi_sim.scenario.layering import to_yaml

# Longest wait for the moment of the fault, and for the end of the run after it [s].
TRIGGER_PATIENCE, END_PATIENCE = 120.0, 120.0
# Time for a first heartbeat: before it a node counts as starting [s].
FIRST_HEARTBEAT = 2.0
FOUND = re.compile(r'(\d+) (?:found|visited)')


@dataclass
class Outcome:
    """Result of a run: no code if it did not end, and the command lines that were left then."""

    folder: Path
    code: int | None
    output: str
    struck: bool
    ended_after: float
    left: list[str]


def execute(case, folder, seed):
    folder.mkdir(parents=True)
    file, run, output = folder / 'scenario.yaml', folder / 'run', folder / 'output.txt'
    file.write_text(to_yaml(case.scenario()), encoding='utf-8')
    command = [sys.executable, '-m', 'maasi_sim.run.run_scenario', str(file), '--out', str(run)]
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
        victims = victims_of(case, run, process, output)
        if case.hangs_guards and case.when == 'middle':
            time.sleep(FIRST_HEARTBEAT)
        at = time.monotonic()
        struck = bool(victims) and strike(case, victims)
        process.wait(END_PATIENCE)
    except subprocess.TimeoutExpired:
        pass
    ended_after = time.monotonic() - at
    code = process.poll()
    left = processes_of(f'{run}/')
    if code is None:
        process.kill()
        process.wait()
    for pid in processes_of(f'{run}/'):
        send(pid, signal.SIGKILL)
    return Outcome(run, code, output.read_text(), struck, ended_after, list(left.values()))


def victims_of(case, run, process, output):
    """Return the processes of the case's nodes at the moment of the fault; none: the run ended."""
    deadline = time.monotonic() + TRIGGER_PATIENCE
    while time.monotonic() < deadline and process.poll() is None:
        # Targets found, or cells visited, so far.
        found = max(map(int, FOUND.findall(output.read_text())), default=0)
        if case.when == 'start' or found > 0:
            # A node's parameter file is in its command line.
            files = [f'{node.strip("/").replace("/", "_")}.yaml' for node in case.nodes]
            pids = [pid for file in files for pid in processes_of(f'{run}/parameters/{file}')]
            if len(pids) == len(case.nodes):
                return pids
        time.sleep(0.02)
    return []


def strike(case, victims):
    number = signal.SIGKILL if case.fault == 'kill' else signal.SIGSTOP
    # All of them, even if the first has ended.
    done = [send(pid, number) for pid in victims]
    if case.fault == 'pause':
        time.sleep(PAUSE)
        for pid in victims:
            send(pid, signal.SIGCONT)
    return all(done)


def send(pid, number):
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return False
    return True


def processes_of(text):
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
