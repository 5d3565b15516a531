"""Time of a node: stamps, silent sources, and jumps of a simulated clock."""

import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, JumpThreshold, ROSClock, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node

_NANOSECONDS = 1_000_000_000

JUMP = _NANOSECONDS  #: smallest difference of consecutive stamps that counts as a jump [ns]

LAST_STAMP = 2**31 - 1  #: largest valid stamp [s]

# Largest first batch id, and largest step from one id to the next.
_FIRST_IDS = 2**62
_IDS_AHEAD = 10**6

# With several publishers of /clock: a jump counts if time stays back this long [s].
_CONFIRMATION = 1.0
_LEAST_BACKWARD, _LEAST_FORWARD = 1_000_000, 200_000_000


def stamp_problem(message: Any) -> str | None:
    """Return the error of a message's stamp: field, read and allowed values."""
    name, owner = 'header.stamp', getattr(message, 'header', None)
    if owner is None:
        name, owner = 'stamp', message
    stamp = getattr(owner, 'stamp', None)
    if stamp is None:
        return None
    if stamp.sec < 0:
        return f'{name}.sec: read {stamp.sec}, allowed is from 0 [s]'
    if stamp.nanosec >= _NANOSECONDS:
        return f'{name}.nanosec: read {stamp.nanosec}, allowed is below {_NANOSECONDS} [ns]'
    return None


def batch_id_limit(last: int) -> int:
    """Return the highest id allowed after `last`; higher ones could exhaust uint64."""
    return max(last, _FIRST_IDS) + _IDS_AHEAD


class StampGate:
    """Distinguishes a jump of a stream, confirmed by the next stamp, from a single wrong stamp."""

    def __init__(self, jump: int = JUMP) -> None:
        self.jump = jump
        self._last: int | None = None
        self._suspect: int | None = None

    def accepts(self, stamp: int) -> bool:
        """Return whether a stamp is accepted."""
        last, suspect = self._last, self._suspect
        self._suspect = None
        if last is not None and abs(stamp - last) > self.jump:
            if suspect is None or not 0 < stamp - suspect <= self.jump:
                self._suspect = stamp
                return False
        elif last is not None and stamp < last:
            return True  # a late message, not a jump: the reference stays at the last stamp
        self._last = stamp
        return True


# An arrival clock uses ticks of this period, and extrapolates the last one for so long [s of the
# steady clock].
_MEMORY, _AHEAD = 0.5, 2


class ArrivalClock:
    """The node's time at any recent instant of the steady clock.

    Simulated time arrives in ticks, some of them late, and may be slower than the steady clock.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        # Instants [s] and their times [ns]; replaced as a whole, as ticks may be handled in
        # another thread.
        self._ticks: tuple[tuple[float, int], ...] = ()
        # rclpy 7.1 only borrows the pointer: until its clock keeps a reference to it, a jump
        # after the loss of this handle segfaults.
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
        # Two entries give the length of a tick.
        recent = [tick for tick in ticks[:-1] if tick[0] >= now - _MEMORY]
        self._ticks = (*recent, *ticks[-1:], (now, begun)) if begun > 0 else ()

    def stamp(self, instant: float) -> int | None:
        """Return the node's time [ns] at an instant [s]; None before it began."""
        now = time.monotonic()
        if not (isinstance(self._clock, ROSClock) and self._clock.ros_time_is_active):
            return int(self._clock.now().nanoseconds) - round(1e9 * (now - instant))
        ticks = self._ticks
        if not ticks or instant < ticks[0][0] - _MEMORY:
            return None
        (first, begun), (_, latest) = ticks[0], ticks[-1]
        if len(ticks) == 1:
            return latest if instant >= first else None
        # Extrapolated from each tick at the mean rate; late ticks give earlier times.
        rate = (latest - begun) / (now - first)
        at = max(tick + rate * (instant - when) for when, tick in ticks)
        return min(round(at), latest + _AHEAD * (latest - ticks[-2][1]))

    def close(self) -> None:
        """Stop following the clock."""
        if self._handle is not None:
            self._handle.unregister()
            self._handle = None


class Silence:
    """Time without a message from a source, in simulated time if the node uses it."""

    def __init__(self, node: Node) -> None:
        self._clock = node.get_clock()
        self.end()

    def end(self) -> None:
        """Note a received message."""
        self._wall = time.monotonic()
        self._simulated = self._time()

    def _time(self) -> int | None:
        """Return the simulated time [ns]; 0 before it begins, None without it."""
        if isinstance(self._clock, ROSClock) and self._clock.ros_time_is_active:
            return int(self._clock.now().nanoseconds)
        return None

    @property
    def wall(self) -> float:
        """Wall time without a message [s]."""
        return time.monotonic() - self._wall

    @property
    def length(self) -> float:
        """Time without a message [s]; 0 if simulated time had not begun, or has jumped back."""
        now = self._time()
        if now is None:
            return self.wall
        if not self._simulated or now < self._simulated:
            self._simulated = now
        return 1e-9 * (now - self._simulated)


class ClockWatch:
    """Reports backward jumps of the node's time.

    With one publisher of `/clock` a jump counts at once, with several only if the time stays back.
    `warn` takes a key and a text; `on_restart` takes the size of the jump [s].
    """

    def __init__(
        self, node: Node, warn: Callable[[str, str], None], on_restart: Callable[[float], None]
    ) -> None:
        self._node, self._warn, self._on_restart = node, warn, on_restart
        # Unconfirmed jump: time before it [ns], and steady time at which it happened [s].
        self._pending: tuple[int, float] | None = None
        # rclpy 7.1 only borrows the pointer: until its clock keeps a reference to it, a jump
        # after the loss of this handle segfaults.
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
            executor.create_task(self._check_jump, delta)

    def _check_jump(self, delta: int) -> None:
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
        """Confirm pending jumps; call it about once per second."""
        if self._pending is not None and time.monotonic() - self._pending[1] >= _CONFIRMATION:
            before, self._pending = self._pending[0], None
            gap = before - self._node.get_clock().now().nanoseconds
            if gap > 0:
                self._on_restart(1e-9 * gap)

    def stop(self) -> None:
        """Remove the callback from the clock."""
        if self._handle is not None:
            self._handle.unregister()
            self._handle = None
