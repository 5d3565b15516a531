"""Whole scenarios as processes: speed in lockstep, time to start, latency of the filter node."""

from __future__ import annotations

import os
import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from timing import entry, run_scenario

from maasi_sim.run.domain import Domain
from maasi_sim.run.node_plan import NodePlan
from maasi_sim.run.processes import NodeProcess, find_executable, stop
from maasi_sim.run.replay_node import FILTER, REPLAYED, ReplayNode, read_recording

SECONDS = 40.0
# For an answer of the filter node [s].
PATIENCE = 30.0


def start_of(folder: Path, begin: float) -> float:
    """Return the wall time from `begin` until the time of a run started [s]."""
    log = (folder / 'sim_node.log').read_text()
    found = re.search(r'\[(\d+\.\d+)\] \[sim_node\]: all nodes are ready', log)
    if found is None:
        raise RuntimeError(f'the time did not start:\n{log}')
    return float(found.group(1)) - begin


def wait_for(node: ReplayNode, condition: Callable[[], bool]) -> None:
    """Take what comes until a condition holds."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError(f'{FILTER} did not answer for {PATIENCE:g} s')
        node.spin()


def latencies(bag: Path, folder: Path) -> list[float]:
    """Return the times from detections to the update that holds them, over DDS [s]."""
    recording = read_recording(bag)
    facts = recording.facts['nodes'][f'/{FILTER}']
    parameters = {**facts['parameters'], **REPLAYED}
    plan = NodePlan(facts['package'], facts['executable'], FILTER, parameters=parameters)
    file = folder / 'filter_node.yaml'
    file.write_text(plan.parameter_text(), encoding='utf-8')
    times = []
    with Domain(None) as domain:
        os.environ.update(domain.environment())
        executable = find_executable(plan.package, plan.executable)
        command = plan.command(executable, file)
        process = NodeProcess(plan.full_name, command, folder / 'filter_node.log', plan.package)
        process.start()
        node = ReplayNode(domain.number, sorted(recording.facts['scenario']['robots']))
        try:
            wait_for(node, lambda: node.ready)
            for number, batch in enumerate(recording.batches, start=1):
                begin = time.perf_counter()
                node.publish(batch)
                wait_for(node, lambda number=number: len(node.updates) >= number)
                times.append(time.perf_counter() - begin)
        finally:
            node.close()
            stop([process])
    return times


def run(share: float = 1.0) -> list[dict[str, Any]]:
    """Run the benchmarks; `share` of the simulated time."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # The first run finds everything cold.
        run_scenario('mambo_turtlebot', folder / 'cold', 0.1)
        begin = time.time()
        run_scenario('mambo_turtlebot', folder / 'start', 0.1)
        start = start_of(folder / 'start', begin)
        floor = run_scenario('mambo_turtlebot', folder / 'floor', share * SECONDS)
        space = run_scenario('ranging_pair_3d', folder / 'space', 2.0 * share * SECONDS)
        times = latencies(folder / 'floor' / 'bag', folder)
        return [
            entry('demo_real_time_factor', floor, 'x'),
            entry('ranging_pair_real_time_factor', space, 'x'),
            entry('start_to_first_step', start, 's'),
            entry('detections_to_update_p50', 1e3 * float(np.percentile(times, 50)), 'ms'),
            entry('detections_to_update_p99', 1e3 * float(np.percentile(times, 99)), 'ms'),
        ]
