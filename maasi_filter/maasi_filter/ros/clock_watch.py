"""Backward jumps of a simulated clock, and a clock that does not start."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node

# Time without /clock before a warning [s].
_PATIENCE = 3.0
# With several publishers of /clock: a jump counts if time stays back this long [s].
_CONFIRMATION = 1.0
_LEAST_BACKWARD, _LEAST_FORWARD = 1_000_000, 200_000_000


class ClockWatch:
    """Informs a node that its time starts again.

    A looped recording or a restarted simulation has one publisher of `/clock`: a backward jump
    counts at once. With several publishers the time may alternate between theirs: then a jump
    counts only after the time has stayed back.

    Parameters
    ----------
    node : Node
        Whose clock it is.
    warn : callable
        Is called with a key and a text: throttled warnings.
    on_restart : callable
        Is called from the executor when the time starts again, with the size of the jump [s].
    """

    def __init__(
        self,
        node: Node,
        warn: Callable[[str, str], None],
        on_restart: Callable[[float], None],
    ) -> None:
        self._node = node
        self._warn = warn
        self._on_restart = on_restart
        # Unconfirmed jump: time before it [ns], and steady time at which it happened [s].
        self._pending: tuple[int, float] | None = None
        self._silent_since: float | None = None
        self._patience = _PATIENCE
        # rclpy only borrows the pointer: without this reference a jump segfaults.
        self._handle: Any = node.get_clock().create_jump_callback(
            JumpThreshold(
                min_forward=Duration(nanoseconds=_LEAST_FORWARD),
                min_backward=Duration(nanoseconds=-_LEAST_BACKWARD),
                on_clock_change=False,
            ),
            post_callback=self._on_jump,
        )

    def _on_jump(self, jump: TimeJump) -> None:
        # An exception must not pass through the C code that calls this.
        executor, delta = self._node.executor, jump.delta.nanoseconds
        if executor is not None:
            executor.create_task(self._judge, delta)

    def _judge(self, delta: int) -> None:
        now = self._node.get_clock().now().nanoseconds
        if delta > 0:
            if self._pending is not None and now >= self._pending[0]:
                self._pending = None
            return
        publishers = self._node.get_publishers_info_by_topic('/clock')
        if len(publishers) <= 1:
            self._pending = None
            self._on_restart(-1e-9 * delta)
            return
        names = ', '.join(sorted({info.node_name for info in publishers}))
        self._warn(
            'clock',
            f'/clock jumped back by {-1e-9 * delta:.3f} s; it has {len(publishers)} publishers '
            f'({names}), allowed is one',
        )
        if self._pending is None:
            self._pending = (now - delta, time.monotonic())

    def look(self) -> None:
        """Confirm pending jumps and check for silence; call about once per second."""
        now, time_now = time.monotonic(), self._node.get_clock().now().nanoseconds
        if self._pending is not None and now - self._pending[1] >= _CONFIRMATION:
            before, self._pending = self._pending[0], None
            if time_now < before:
                self._on_restart(1e-9 * (before - time_now))
        self._look_for_clock(now, time_now)

    def _look_for_clock(self, now: float, time_now: int) -> None:
        simulated = self._node.get_parameter('use_sim_time').value
        if not simulated or time_now or self._node.count_publishers('/clock'):
            self._silent_since, self._patience = None, _PATIENCE
            return
        if self._silent_since is None:
            self._silent_since = now
        waited = now - self._silent_since
        if waited >= self._patience:
            # Exponential back-off.
            self._patience = 2.0 * waited
            self._node.get_logger().warning(
                f'no publisher of /clock for {waited:.0f} s (use_sim_time is true): waiting'
            )

    def stop(self) -> None:
        """Remove the callback from the clock."""
        if self._handle is not None:
            self._handle.unregister()
            self._handle = None
