"""Stamps for what arrives without one."""

import time
from typing import Any

from rclpy.clock import Clock, JumpThreshold, ROSClock
from rclpy.duration import Duration

from maasi_filter.ros.clocks import JUMP

_MEMORY = 0.5  # ticks of this time are used [s of the steady clock]
_AHEAD = 2  # longest time after the last tick [ticks]


class ArrivalClock:
    """The node's time at any recent instant of the steady clock.

    A simulated time comes in ticks, of which some are handled late, and passes more slowly than
    the steady clock where the simulation does not keep up.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        # Instants [s] and the times that began there [ns]. Replaced as a whole: a tick may be
        # handled in another thread.
        self._ticks: tuple[tuple[float, int], ...] = ()
        # rclpy only borrows the pointer: without this reference a jump segfaults.
        self._handle: Any = clock.create_jump_callback(
            JumpThreshold(
                min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1)
            ),
            post_callback=self._on_tick,
        )

    def _on_tick(self, _: Any) -> None:
        # An exception must not pass through the C code that calls this.
        now, begun = time.monotonic(), int(self._clock.now().nanoseconds)
        ticks = self._ticks
        if ticks and not 0 < begun - ticks[-1][1] <= JUMP:
            ticks = ()
        # The last but one stays: the length of a tick.
        recent = [tick for tick in ticks[:-1] if tick[0] >= now - _MEMORY]
        self._ticks = (*recent, *ticks[-1:], (now, begun)) if begun > 0 else ()

    def stamp(self, instant: float) -> int | None:
        """Return the node's time [ns] at an instant [s]; None while it had not begun."""
        now = time.monotonic()
        if not (isinstance(self._clock, ROSClock) and self._clock.ros_time_is_active):
            return int(self._clock.now().nanoseconds) - round(1e9 * (now - instant))
        ticks = self._ticks
        if not ticks or instant < ticks[0][0] - _MEMORY:
            return None
        (first, begun), (_, latest) = ticks[0], ticks[-1]
        if len(ticks) == 1:
            return latest if instant >= first else None
        # At the mean rate from each tick on: the latest time is by a tick that was not late.
        rate = (latest - begun) / (now - first)
        at = max(tick + rate * (instant - when) for when, tick in ticks)
        return min(round(at), latest + _AHEAD * (latest - ticks[-2][1]))

    def close(self) -> None:
        """Stop to follow the clock."""
        if self._handle is not None:
            self._handle.unregister()
            self._handle = None
