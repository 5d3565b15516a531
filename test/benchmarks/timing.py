"""What the benchmarks share: the median time of a call, and an entry of their results."""

from __future__ import annotations

import statistics
from collections.abc import Callable
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


def entry(
    name: str,
    value: float,
    unit: str = 'ms',
    baseline: str | None = None,
    ratio: float | None = None,
) -> dict[str, Any]:
    """Return a result; baseline is what it was compared with, and ratio its time over ours."""
    return {'name': name, 'value': value, 'unit': unit, 'baseline': baseline, 'ratio': ratio}
