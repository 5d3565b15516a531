"""The search area as the fence of an autopilot: uploaded, read back and compared."""

import math
from collections.abc import Generator
from functools import partial
from typing import Any

import numpy as np
import shapely

from maasi_drivers.links.mavlink.protocol import ERROR, INFO, WARNING, ReportLog, mavlink
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.geometry.area import level_shape
from maasi_filter.geometry.geodesy import geodetic
from maasi_filter.geometry.operating_volume import MARGIN, OperatingVolume

Item = tuple[int, float, int, int]  # command, corners or radius [m], 1e-7 degrees north, east

_FENCE = mavlink.MAV_MISSION_TYPE_FENCE
_INSIDE = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
_OUTSIDE = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
_TWICE = mavlink.MAV_MISSION_INVALID_SEQUENCE  # for an item that arrived twice
_ROUND = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION
# Timeout of a message, number of attempts, and time until the next upload [s, 1, s].
_PATIENCE, _TRIES, _PAUSE = 1.5, 8, 10.0
_ROUNDING = 0.5, 0.01, 1.5, 1.5  # precision of an item's numbers in an autopilot


def fence_items(volume: OperatingVolume, start: list[float]) -> list[Item]:
    """Return the border of a volume on the map with its holes and keep-out zones."""
    area = volume.area
    zones, origin = area.settings.keep_outs, area.settings.origin
    assert origin is not None
    # Goals may lie on the border of a box; the driver acts at the margin.
    box = shapely.box(*(volume.limits[:2] + np.array([-MARGIN, MARGIN])).T.ravel())
    parts = shapely.get_parts(area.shapes['area'] or [box])
    # Autopilots intersect borders: of several parts the one at the start counts.
    part = min(parts, key=shapely.Point(start[:2]).distance)
    closed = shapely.get_parts([level_shape(zone) for zone in zones if zone.polygon])
    outside = [*part.interiors, *(polygon.exterior for polygon in closed)]
    rows: list[Any] = []
    for command, ring in [(_INSIDE, part.exterior), *((_OUTSIDE, ring) for ring in outside)]:
        corners = shapely.get_coordinates(ring)[:-1]
        rows += [(command, len(corners), corner) for corner in corners]
    rows += [(_ROUND, zone.radius, zone.centre[:2]) for zone in zones if zone.centre]
    degrees = geodetic(np.array([row[2] for row in rows]), origin)[:, :2]
    positions = np.rint(1e7 * degrees).astype(int).tolist()
    return [(*row[:2], *position) for row, position in zip(rows, positions, strict=True)]


class FenceUpload:
    """Uploads the fence of an autopilot and verifies it; times: steady clock."""

    def __init__(self, settings: MavlinkSettings, sender: Any, log: ReportLog) -> None:
        #: Why the autopilot may have another fence; empty if verified or not needed.
        self.problem = ''
        self._items: list[Item] = []
        self._vehicle = settings.system, mavlink.MAV_COMP_ID_AUTOPILOT1
        self._sender, self._log = sender, log
        self.begin()

    def begin(self, items: list[Item] | None = None) -> None:
        """Upload a fence, or the same one again."""
        self._items = self._items if items is None else items
        self.busy, self._tries = bool(self._items), 0
        self._due = -math.inf if self.busy else math.inf
        self._exchange = self._upload()
        self._send, self._answers = next(self._exchange)

    def tick(self, now: float) -> None:
        """Send what is due."""
        if now < self._due:
            return
        if not self.busy:
            self.begin()
        elif self._tries == _TRIES:
            self._conclude(now, ERROR, 'not verified (no answer)')
        else:
            self._tries, self._due = self._tries + 1, now + _PATIENCE
            self._send()

    def update(self, message: Any, now: float) -> None:
        """Handle a message; others than answers are ignored."""
        expected = {'target_system': self._sender.srcSystem, 'mission_type': _FENCE}
        ours = all(getattr(message, key, value) == value for key, value in expected.items())
        ours &= message.get_type() in self._answers and getattr(message, 'type', None) != _TWICE
        if self.busy and ours:
            self._tries, self._due = 0, now
            try:
                self._send, self._answers = self._exchange.send(message)
            except StopIteration as end:
                self._conclude(now, *end.value)

    def _conclude(self, now: float, severity: int, result: str) -> None:
        problem = f'fence {result}' if severity == ERROR else ''
        if not problem or problem != self.problem:
            self._log.add(severity, f'fence: {result}')
        self.problem, self.busy = problem, False
        self._due = now + _PAUSE if problem else math.inf

    def _upload(self) -> Generator[Any, Any, tuple[int, str]]:
        """Yield messages and expected answers of MAVLink's mission protocol, both directions."""
        sender, to, items = self._sender, self._vehicle, self._items
        what = mavlink.MAV_CMD_REQUEST_MESSAGE, 0, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
        ask = partial(sender.command_long_send, *to, *what, *[0.0] * 6)
        version = yield ask, ('AUTOPILOT_VERSION',)
        if not version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE:
            return WARNING, 'not uploaded: the autopilot does not support it'
        left, send = len(items), partial(sender.mission_count_send, *to, len(items), _FENCE)
        while True:
            answer = yield send, ('MISSION_REQUEST', 'MISSION_REQUEST_INT', 'MISSION_ACK')
            if answer.get_type() != 'MISSION_ACK' and answer.seq < len(items):
                left, (command, size, *position) = len(items) - 1 - answer.seq, items[answer.seq]
                head = answer.seq, mavlink.MAV_FRAME_GLOBAL, command, 0, 1, size, 0.0, 0.0, 0.0
                send = partial(sender.mission_item_int_send, *to, *head, *position, 0.0, _FENCE)
            # If the last answer is lost, another one arrives: the download decides.
            elif left == 0:
                break
            elif getattr(answer, 'type', 0) != mavlink.MAV_MISSION_ACCEPTED:
                known = mavlink.enums['MAV_MISSION_RESULT'].get(answer.type)
                return ERROR, f'not verified ({known.name if known else answer.type})'
        announced = yield partial(sender.mission_request_list_send, *to, _FENCE), ('MISSION_COUNT',)
        if announced.count != len(items):
            return ERROR, 'not verified: the number of items read back differs'
        for number, item in enumerate(items):
            send = partial(sender.mission_request_int_send, *to, number, _FENCE)
            while (answer := (yield send, ('MISSION_ITEM_INT',))).seq != number:
                pass
            read = answer.command, answer.param1, answer.x, answer.y
            if not np.isclose(read, item, 0.0, _ROUNDING).all():
                return ERROR, f'not verified: item {number} read back differs'
        sender.mission_ack_send(*to, mavlink.MAV_MISSION_ACCEPTED, _FENCE)
        return INFO, f'uploaded and verified, {len(items)} vertices and circles'
