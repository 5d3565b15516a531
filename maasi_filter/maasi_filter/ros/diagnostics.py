"""Parts of a node's diagnostics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue


def level_of(fault: str, warned: bool) -> bytes:
    """Return the level of a status."""
    if fault:
        return DiagnosticStatus.ERROR
    return DiagnosticStatus.WARN if warned else DiagnosticStatus.OK


def key_values(status: Mapping[str, Any], dropped: Mapping[str, int]) -> list[KeyValue]:
    """Return values of a node, and numbers of discarded data by reason."""
    counts = {f'dropped: {reason}': dropped[reason] for reason in sorted(dropped)}
    return [KeyValue(key=key, value=str(value)) for key, value in {**status, **counts}.items()]
