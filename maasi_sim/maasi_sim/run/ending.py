"""How a run ends: the reason, and the exit code of `run_scenario`."""

from __future__ import annotations

from dataclasses import dataclass

DONE, NOT_ALL_FOUND, WRONG_INPUT, NODE_FAILED, NOT_WRITTEN, INTERRUPTED = 0, 1, 2, 3, 4, 130


@dataclass(frozen=True)
class Ending:
    """Why a run ended, its exit code, and what to say about it."""

    reason: str
    code: int
    text: str = ''
