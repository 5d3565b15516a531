"""Replay the measurements of a recording to the filter node, and compare the found targets."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maasi_sim.run.domain import Domain
from maasi_sim.run.node_plan import NodePlan
from maasi_sim.run.processes import NodeProcess, stop
from maasi_sim.run.replay_node import FILTER, Recording, ReplayNode, read_recording
from maasi_sim.run.run_folder import make_folder
from maasi_sim.run.topics import within

EQUAL, DIFFERENT, FAILED, INTERRUPTED = 0, 1, 3, 130
# Timeouts of an update, and of the start of the node, which may have to compile [s].
_PATIENCE = 60.0
_START_PATIENCE = 180.0
# Without clock, lockstep, batch timeout, loading or saving.
REPLAYED = {
    'use_sim_time': False,
    'lockstep': False,
    'batch_timeout': 1e6,
    'save_file': '',
    'save_batches': False,
    'particles_rate': 0.0,
    'markers_rate': 0.0,
}


class _Interrupted(Exception):
    """A signal has arrived."""


class _FilterError(Exception):
    """A filter does not answer: text and process."""


def differences(recorded: list[Any], found: list[Any]) -> list[str]:
    """Return in words how two lists of found targets differ; empty if they are equal to the bit."""
    lines = []
    if len(recorded) != len(found):
        lines.append(f'{len(recorded)} found targets were recorded, {len(found)} found now')
    for before, now in zip(recorded, found):
        for key in before.get_fields_and_field_types():
            old, new = getattr(before, key), getattr(now, key)
            if not np.array_equal(old, new):
                lines.append(f'target {before.id}: {key} was {old}, is {new}')
    return lines


def replay(
    path: Path,
    out: Path | None,
    domain_id: int | None,
    interrupted: Callable[[], bool],
) -> int:
    """Replay a recording, print whether the found targets are equal, and return the exit code.

    Logs and parameters of the nodes are written to a folder, `interrupted` returns true after an
    interruption.
    """
    recording = read_recording(path)
    folder = make_folder(out, '_replay')
    with Domain(domain_id) as domain:
        os.environ.update(domain.environment())
        processes = [
            _process(recording.facts, namespace, folder) for namespace in recording.namespaces
        ]
        try:
            for process in processes:
                process.start()
            robots = sorted(recording.facts['scenario']['robots'])
            node = ReplayNode(domain.number, robots, recording.namespaces)
            try:
                return _feed(node, recording, processes, interrupted)
            except _Interrupted:
                return INTERRUPTED
            except _FilterError as error:
                text, process = error.args
                print(f'error: {text}\n--- {process.log}\n{process.last_words()}', file=sys.stderr)
                return FAILED
            finally:
                node.close()
        finally:
            stop(processes)


def _process(facts: dict[str, Any], namespace: str, folder: Path) -> NodeProcess:
    recorded = facts['nodes'][within(namespace, f'/{FILTER}')]
    plan = NodePlan(
        recorded['package'],
        recorded['executable'],
        FILTER,
        namespace,
        {**recorded['parameters'], **REPLAYED},
    )
    return plan.process(folder, folder)


def _feed(
    node: ReplayNode,
    recording: Recording,
    processes: list[NodeProcess],
    interrupted: Callable[[], bool],
) -> int:
    first_difference = None

    def wait_for(condition: Callable[[], bool], what: str, patience: float = _PATIENCE) -> None:
        deadline = time.monotonic() + patience
        while not condition():
            if interrupted():
                raise _Interrupted
            for process in processes:
                if not process.running:
                    raise _FilterError(f'{process.name} {process.how_it_ended()}', process)
            if time.monotonic() > deadline:
                raise _FilterError(f'{what} for {patience:g} s', processes[0])
            node.spin()

    wait_for(lambda: node.ready, 'the filter was not ready', _START_PATIENCE)
    for number, batch in enumerate(recording.batches, start=1):
        node.publish(batch)
        wait_for(
            lambda number=number: len(node.updates) >= number,  # type: ignore[misc]
            f'the filter did not answer batch {batch.update.batch_id}',
        )
        # Robots are missing where none is requested.
        batch.update.missing = node.updates[-1].missing
        if first_difference is None and node.updates[-1] != batch.update:
            first_difference = batch.update.batch_id
    wait_for(
        lambda: all(node.found_batch[key] >= last for key, last in recording.found_batch.items()),
        'the filter published no found targets',
    )
    lines = []
    for namespace, found in recording.found.items():
        now = node.found[namespace]
        lines += [within(namespace, f' {line}').strip() for line in differences(found, now)]
    for line in lines:
        print(line)
    if first_difference is not None:
        print(f'the first update that differs is that of batch {first_difference}')
    number = sum(len(found) for found in recording.found.values())
    if lines:
        print(f'{len(recording.batches)} batches replayed: the found targets are NOT equal')
        return DIFFERENT
    print(f'{len(recording.batches)} batches replayed: {number} found targets, equal to the bit')
    return EQUAL
