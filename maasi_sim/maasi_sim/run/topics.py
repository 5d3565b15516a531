"""Names of topics, and times of messages."""

from __future__ import annotations

from typing import Any

CLOCK = '/clock'
UPDATE, FOUND, DECISIONS = '/filter_update', '/found_targets', '/decisions'
BATCH = '/measurement_batch'
STEP = '/lockstep/step'


def within(namespace: str, topic: str) -> str:
    """Return the full name of a topic in a namespace; an empty one is the root."""
    return f'/{namespace}{topic}' if namespace else topic


def seconds(stamp: Any) -> float:
    """Return a `builtin_interfaces/Time` in seconds."""
    return (int(stamp.sec) * 10**9 + int(stamp.nanosec)) / 1e9
