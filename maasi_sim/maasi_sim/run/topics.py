"""Names of topics; times and classes of messages, also of serialised ones (CDR)."""

from __future__ import annotations

import importlib
import struct
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


def point(item: Any) -> tuple[float, float, float]:
    """Return the coordinates of a `geometry_msgs/Point`."""
    return float(item.x), float(item.y), float(item.z)


def stamp_of(topic: str, kind: Any, data: bytes) -> int:
    """Return the first stamp of a serialised message, 0 if it has none [ns]."""
    first = next(iter(kind.get_fields_and_field_types()))
    if first in ('header', 'clock'):
        return time_at(data, 4)
    # Transforms are a sequence, which starts with its length.
    if topic.rpartition('/')[2] == 'tf' and first == 'transforms' and len(data) >= 16:
        return time_at(data, 8)
    return 0


def time_at(data: bytes, offset: int) -> int:
    """Return the time at a place of a serialised message [ns]."""
    seconds, nanoseconds = struct.unpack_from('<iI', data, offset)
    return int(seconds) * 10**9 + int(nanoseconds)


def message_class(name: str) -> type:
    """Return the class of `package/msg/Type`."""
    package, _, kind = name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), kind)
