"""The record of a run, and the part of it that all observers gather."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.arrays import FloatArray
from maasi_sim.run.topics import seconds


@dataclass(frozen=True)
class RunEnd:
    """How a run ended.

    `reason` is a key of `END_REASONS`, `time` simulated, `wall_time` from the first step [s].
    Events are nodes that died, hung or were restarted.
    """

    reason: str
    time: float
    wall_time: float
    events: list[dict[str, Any]] = field(default_factory=list)


@dataclass
class RunRecord:
    """Data of the reports of all kinds of runs.

    Trajectories are time [s], x, y, z [m] by robot, (n, 4). Events are robots lost and back, nodes
    restarted or dead, in order of time.
    """

    name: str
    scenario: Any
    seed: int
    trajectories: dict[str, FloatArray] = field(default_factory=dict, kw_only=True)
    events: list[dict[str, Any]] = field(default_factory=list, kw_only=True)
    end_reason: str = field(default='', kw_only=True)
    end_time: float = field(default=0.0, kw_only=True)
    wall_time: float = field(default=0.0, kw_only=True)

    def add_events(self, *events: Iterable[dict[str, Any]]) -> None:
        """Merge events in order of time."""
        every = [*self.events, *(event for some in events for event in some)]
        self.events = sorted(every, key=lambda event: float(event['time']))


class TeamLog:
    """Robots that take part, by the messages of the simulation, and the start of the run."""

    def __init__(self, types: Typestore) -> None:
        self._types = types
        # A clock that the run follows may start at any time.
        self.begin: float | None = None
        self.robots: list[str] | None = None
        self.events: list[dict[str, Any]] = []

    def decode(self, data: bytes, name: str) -> Any:
        """Return a message of `maasi_msgs`."""
        return self._types.deserialize_cdr(data, f'maasi_msgs/msg/{name}')

    def time(self, stamp: Any) -> float:
        """Return the time since the first step [s]."""
        return seconds(stamp) - (self.begin or 0.0)

    def note(self, step: Any) -> bool:
        """Note the robots of a `LockstepStep`; return whether they have changed."""
        if self.begin is None:
            self.begin = seconds(step.stamp)
        before, self.robots = self.robots, list(step.robots)
        if before is not None:
            lost, joined = set(before) - set(self.robots), set(self.robots) - set(before)
            for word, names in (('lost', lost), ('joined', joined)):
                for name in sorted(names):
                    self.events.append(
                        {'time': self.time(step.stamp), 'agent': name, 'event': word}
                    )
        return before != self.robots

    def trajectory(self, states: Iterable[Any]) -> FloatArray:
        """Return time [s], x, y, z [m] of a robot's `AgentState` messages, (n, 4)."""
        places = [(self.time(state.header.stamp), state.pose.pose.position) for state in states]
        return rows([(time, place.x, place.y, place.z) for time, place in places], 4)


def rows(values: list[Any], width: int) -> FloatArray:
    """Return rows as an array, (0, width) without any."""
    return np.array(values, dtype=float).reshape(-1, width)
