"""Topic names, and stamps and classes of messages, also of serialised ones (CDR)."""

import importlib
import math
import struct
from functools import cache
from typing import Any

CLOCK = '/clock'
_FARTHEST = 1e8  # position [m]
UPDATE, FOUND, DECISIONS = '/filter_update', '/found_targets', '/decisions'
REPORTS = '/reports'
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


def finite_numbers(field: str, *values: float) -> tuple[float, ...]:
    """Return the numbers of a field; raises ValueError if one is not finite."""
    if not all(map(math.isfinite, values)):
        read = ', '.join(f'{value:g}' for value in values)
        raise ValueError(f'{field}: read {read}, allowed are finite numbers')
    return values


def place(field: str, item: Any) -> tuple[float, float, float]:
    """Return the coordinates of a `geometry_msgs/Point`; raises ValueError if implausible."""
    x, y, z = finite_numbers(field, *point(item))
    if max(abs(x), abs(y), abs(z)) > _FARTHEST:
        raise ValueError(f'{field}: read {x:g}, {y:g}, {z:g}, allowed are up to {_FARTHEST:g} m')
    return x, y, z


def stamp_of(topic: str, kind: Any, data: bytes) -> int:
    """Return the stamp of a serialised message [ns], -1 if it has none near its begin."""
    offset = _stamp_offset(kind)
    # Transforms are a sequence, which begins with its length.
    if topic.rpartition('/')[2] == 'tf' and len(data) >= 16:
        offset = 8
    return -1 if offset is None else time_at(data, offset)


@cache
def _stamp_offset(kind: Any) -> int | None:
    """Return the offset of a message's stamp, if only 64-bit numbers precede it."""
    offset = 4
    for field in kind.get_fields_and_field_types().values():
        if field in ('builtin_interfaces/Time', 'std_msgs/Header'):
            return offset
        if field not in ('uint64', 'int64', 'double'):
            return None
        offset += 8
    return None


def time_at(data: bytes, offset: int) -> int:
    """Return the time at an offset of a serialised message [ns]."""
    seconds, nanoseconds = struct.unpack_from('<iI', data, offset)
    return int(seconds) * 10**9 + int(nanoseconds)


def message_class(name: str) -> type:
    """Return the class of `package/msg/Type`."""
    package, _, kind = name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), kind)
