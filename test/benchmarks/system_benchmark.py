"""Whole scenarios as processes: speed in lockstep, time to start, latency of the filter node."""

import io
import re
import tempfile
import time
from contextlib import redirect_stdout
from pathlib import Path
from unittest.mock import patch

import numpy as np
from timing import entry, real_time_factor

from maasi_sim.run import replay_node
from maasi_sim.run.replay_node import ReplayNode

SECONDS = 40.0
DEMO = 'mambo_turtlebot'
TIMES = []


class TimedNode(ReplayNode):
    """Notes in `TIMES` the times from detections to the update that holds them, over DDS [s]."""

    def publish(self, batch):
        self._begin = time.perf_counter()
        super().publish(batch)

    def spin(self, timeout=0.05):
        before = len(self.updates)
        super().spin(timeout)
        if len(self.updates) > before:
            TIMES.append(time.perf_counter() - self._begin)


def latencies(bag, folder):
    """Replay a recording; return the median and the 99th percentile of the latency [ms]."""
    timed = patch.object(replay_node, 'ReplayNode', TimedNode)
    with timed, redirect_stdout(io.StringIO()) as said:
        if replay_node.replay(bag, folder, None, False) != replay_node.EQUAL:
            raise RuntimeError(said.getvalue())
    return 1e3 * np.percentile(TIMES, [50, 99])


def run(share=1.0):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # The first run finds everything cold.
        real_time_factor(DEMO, folder / 'cold', 0.1)
        begin = time.time()
        real_time_factor(DEMO, folder / 'start', 0.1)
        log = (folder / 'start' / 'sim_node.log').read_text()
        started = re.search(r'\[(\d+\.\d+)\] \[sim_node\]: all nodes are ready', log)
        factor = real_time_factor(DEMO, folder / 'floor', share * SECONDS)
        yield entry('demo_real_time_factor', factor, 'x')
        factor = real_time_factor('ranging_pair_3d', folder / 'space', 2.0 * share * SECONDS)
        yield entry('ranging_pair_real_time_factor', factor, 'x')
        yield entry('start_to_first_step', float(started[1]) - begin, 's')
        half, most = latencies(folder / 'floor' / 'bag', folder / 'replay')
        yield entry('detections_to_update_p50', half)
        yield entry('detections_to_update_p99', most)
