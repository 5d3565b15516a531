"""Sends found targets as Cursor-on-Target events to a TAK server or a multicast group, by UDP."""

from __future__ import annotations

import argparse
import contextlib
import math
import socket
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from maasi_filter.wording import counted

if TYPE_CHECKING:
    from maasi_filter.geometry.geodesy import OriginSettings
    from maasi_filter.records import FoundTarget

# Wall time between two events of a target, if it has moved, and if not [s].
_MOVED, _AGAIN = 2.0, 30.0


@dataclass(frozen=True)
class CotAddress:
    """Host and port that receive the events."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f'[{self.host}]' if ':' in self.host else self.host
        return f'udp://{host}:{self.port}'


def cot_address(text: str) -> CotAddress:
    """Return the address of a command line; errors as of `whole`."""
    url = text if '://' in text else f'udp://{text}'
    host, port, rest = None, None, True
    with contextlib.suppress(ValueError):
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
        rest = bool(parts.scheme != 'udp' or parts.path or parts.query or parts.fragment)
        rest = rest or '@' in parts.netloc
    if rest or not host or not port:
        raise argparse.ArgumentTypeError(f"read '{text[:60]}', allowed is udp://HOST:PORT")
    return CotAddress(host, port)


class CotSender:
    """Sends events as they change; errors are counted, and the first one is reported.

    Parameters
    ----------
    name : str
        Of the run, part of the identity of its targets.
    address : CotAddress
        Receiver.
    origin : OriginSettings
        Of the map.
    warn : callable
        Called with a text.

    Raises
    ------
    ValueError
        If the host is unknown, or there is no socket for it.
    """

    def __init__(
        self,
        name: str,
        address: CotAddress,
        origin: OriginSettings,
        warn: Callable[[str], object],
    ) -> None:
        self.sent = self.failed = 0
        self.address = address
        self._name, self._origin, self._warn = name, origin, warn
        self._to: Any
        # Wall time and position of the last event of each target.
        self._last: dict[int, tuple[float, tuple[float, ...]]] = {}
        try:
            # The only step that may wait, before the run.
            found = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_DGRAM)
            family, kind, protocol, _, self._to = found[0]
            self._socket = socket.socket(family, kind, protocol)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, 'strerror', None) or 'no such host'
            raise ValueError(f'--cot: read {address}: {reason}') from None
        self._socket.setblocking(False)

    def update(self, found: Iterable[FoundTarget], now: float | None = None) -> None:
        """Send what is new, has moved, or was not sent for a while; now: wall time [s]."""
        now = time.monotonic() if now is None else now
        targets = {target.id: target for target in found}
        due = []
        for number, target in targets.items():
            position = tuple(map(float, target.position))
            last, before = self._last.get(number, (-math.inf, ()))
            if now - last >= (_AGAIN if position == before else _MOVED):
                self._last[number] = now, position
                due.append(target)
        gone = [number for number in self._last if number not in targets]
        if due or gone:
            self._send(due, gone)

    def _send(self, due: list[FoundTarget], gone: list[int]) -> None:
        # Deferred: a run without events does not need these.
        import numpy as np

        from maasi_sim.run.targets.exports import cot_event, cot_message, cot_removal
        from maasi_sim.run.targets.tables import found_rows

        written = datetime.now(timezone.utc)
        dimension = len(due[0].position) if due else 2
        rows = found_rows(due, np.zeros((0, dimension)), [], self._origin)
        events = [cot_event(self._name, row, written) for row in rows]
        for number in gone:
            del self._last[number]
            events.append(cot_removal(self._name, number, written))
        for event in events:
            try:
                self._socket.sendto(cot_message(event), self._to)
                self.sent += 1
            except OSError as error:
                self.failed += 1
                if self.failed == 1:
                    reason = error.strerror or 'the socket failed'
                    self._warn(f'--cot: cannot send to {self.address}: {reason}')

    def finish(self, found: Iterable[FoundTarget]) -> str:
        """Send the last state of all targets; return what was sent, as text."""
        self._last = {number: (-math.inf, place) for number, (_, place) in self._last.items()}
        self.update(found)
        text = f'{counted(self.sent, "Cursor-on-Target event")} sent to {self.address}'
        return f'{text}, {self.failed} failed' if self.failed else text

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
