"""Whole scenarios as processes: speed in lockstep, time to start, latency of the filter node."""

from __future__ import annotations

import io
import re
import tempfile
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import numpy as np
from timing import entry, run_scenario

from maasi_sim.run import replay_node
from maasi_sim.run.replay_node import Batch, ReplayNode

SECONDS = 40.0


def start_of(folder: Path, begin: float) -> float:
    """Return the wall time from `begin` until the time of a run started [s]."""
    log = (folder / 'sim_node.log').read_text()
    found = re.search(r'\[(\d+\.\d+)\] \[sim_node\]: all nodes are ready', log)
    if found is None:
        raise RuntimeError(f'the time did not start:\n{log}')
    return float(found.group(1)) - begin


class TimedNode(ReplayNode):
    """Notes the times from detections to the update that holds them, over DDS [s]."""

    times: ClassVar[list[float]] = []

    def publish(self, batch: Batch) -> None:
        self._begin = time.perf_counter()
        super().publish(batch)

    def spin(self, timeout: float = 0.05) -> None:
        before = len(self.updates)
        super().spin(timeout)
        if len(self.updates) > before:
            self.times.append(time.perf_counter() - self._begin)


def run(share: float = 1.0) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # The first run finds everything cold.
        run_scenario('mambo_turtlebot', folder / 'cold', 0.1)
        begin = time.time()
        run_scenario('mambo_turtlebot', folder / 'start', 0.1)
        start = start_of(folder / 'start', begin)
        floor = run_scenario('mambo_turtlebot', folder / 'floor', share * SECONDS)
        space = run_scenario('ranging_pair_3d', folder / 'space', 2.0 * share * SECONDS)
        timed = patch.object(replay_node, 'ReplayNode', TimedNode)
        with timed, redirect_stdout(io.StringIO()) as said:
            bag = folder / 'floor' / 'bag'
            if replay_node.replay(bag, folder / 'replay', None, lambda: False) != replay_node.EQUAL:
                raise RuntimeError(said.getvalue())
        times = TimedNode.times
        return [
            entry('demo_real_time_factor', floor, 'x'),
            entry('ranging_pair_real_time_factor', space, 'x'),
            entry('start_to_first_step', start, 's'),
            entry('detections_to_update_p50', 1e3 * float(np.percentile(times, 50)), 'ms'),
            entry('detections_to_update_p99', 1e3 * float(np.percentile(times, 99)), 'ms'),
        ]
