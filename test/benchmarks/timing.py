"""What the benchmarks share: the median time of a call, whole runs, an entry of their results."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any


def median_time(
    function: Callable[[], object], repeats: int, prepare: Callable[[], object] = lambda: None
) -> float:
    """Return the median wall time of a call [s]; `prepare` comes before each and is not timed."""
    times = []
    for _ in range(repeats):
        prepare()
        start = perf_counter()
        function()
        times.append(perf_counter() - start)
    return statistics.median(times)


def run_scenario(
    name: str,
    folder: Path,
    seconds: float,
    *options: str,
    hear: Callable[[str], object] = lambda line: None,
) -> float:
    """Run a scenario in lockstep, recorded; return its real-time factor. `hear` gets its output."""
    command = [sys.executable, '-m', 'maasi_sim.run.run_scenario', name, '--lockstep', '--seed']
    command += ['1', '--out', str(folder), '--time-limit', str(seconds), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        hear(line)
    if process.wait() not in (0, 1):
        raise RuntimeError(f'{name} ended with {process.returncode}:\n{"".join(lines)}')
    return float(json.loads((folder / 'report.json').read_text())['real_time_factor'])


def entry(
    name: str,
    value: float,
    unit: str = 'ms',
    baseline: str | None = None,
    ratio: float | None = None,
) -> dict[str, Any]:
    """Return a result; baseline is what it was compared with, and ratio its time over ours."""
    return {'name': name, 'value': value, 'unit': unit, 'baseline': baseline, 'ratio': ratio}
