"""Duration of silence of a source, in the clock that timeouts of a node use."""

from __future__ import annotations

import time

from rclpy.clock import ROSClock
from rclpy.node import Node


class Silence:
    """Time since the last message of a source: simulated if the node uses simulated time.

    On a busy machine simulated time slows down with everything else, while timeouts of wall time
    would expire without a fault. Otherwise the clock is the steady one.

    Parameters
    ----------
    node : Node
        Whose clock it is.
    """

    def __init__(self, node: Node) -> None:
        self._clock = node.get_clock()
        self.end()

    def end(self) -> None:
        """Note that a message was received."""
        self._wall = time.monotonic()
        self._simulated = self._time()

    def _time(self) -> int | None:
        """Return the simulated time [ns]; 0 before it begins, None where it is not used."""
        if isinstance(self._clock, ROSClock) and self._clock.ros_time_is_active:
            return int(self._clock.now().nanoseconds)
        return None

    @property
    def wall(self) -> float:
        """Wall time since then [s]."""
        return time.monotonic() - self._wall

    @property
    def length(self) -> float:
        """Time since then [s]; 0 if simulated time had not begun then, or has jumped back."""
        now = self._time()
        if now is None:
            return self.wall
        if not self._simulated or now < self._simulated:
            self._simulated = now
        return 1e-9 * (now - self._simulated)
