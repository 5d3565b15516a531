"""The area of a search as the fence of an autopilot: uploaded, read back and compared."""

import math
from typing import Any

import numpy as np
import shapely

from maasi_drivers.links.mavlink.protocol import ERROR, INFO, WARNING, ReportLog, mavlink
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.area import Area, level_shape
from maasi_filter.arrays import FloatArray
from maasi_filter.geodesy import OriginSettings, geodetic

# Command, number of corners or radius [m], latitude and longitude [1e-7 degrees].
Item = tuple[int, float, int, int]

_FENCE = mavlink.MAV_MISSION_TYPE_FENCE
_INSIDE = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
_OUTSIDE = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
_ROUND = mavlink.MAV_CMD_NAV_FENCE_CIRCLE_EXCLUSION
# Silence after which a message is sent again, how often, and time until the next attempt [s, 1, s].
_PATIENCE, _TRIES, _PAUSE = 1.5, 8, 10.0
# Of the numbers of an item, as an autopilot keeps them.
_ROUNDING = 0.5, 0.01, 1.5, 1.5


def fence_items(
    area: Area, origin: OriginSettings, start: list[float], bounds: FloatArray
) -> list[Item]:
    """Return the border of an area, or of a box (2 or 3, 2), with its holes and keep-outs.

    Autopilots intersect borders, so of an area in parts only the one at the start is a border.
    """
    zones = area.settings.keep_outs
    parts = shapely.get_parts(area.shapes['area'] or [shapely.box(*bounds[:2].T.ravel())])
    part = min(parts, key=shapely.Point(start[:2]).distance)
    closed = shapely.get_parts([level_shape(zone) for zone in zones if zone.polygon])
    outside = [*part.interiors, *(polygon.exterior for polygon in closed)]
    rows = []
    for command, ring in [(_INSIDE, part.exterior), *((_OUTSIDE, ring) for ring in outside)]:
        corners = shapely.get_coordinates(ring)[:-1]
        rows += [(command, len(corners), corner) for corner in corners]
    rows += [(_ROUND, zone.radius, zone.centre[:2]) for zone in zones if zone.centre]
    degrees = geodetic(np.array([place for *_, place in rows]), origin)[:, :2]
    places = np.rint(1e7 * degrees).astype(int).tolist()
    return [(*row[:2], *place) for row, place in zip(rows, places, strict=True)]


class FenceUpload:
    """Gives an autopilot its fence, and checks that it has it; times are of the steady clock [s].

    By the mission protocol of MAVLink (mavlink.io, services/mission): MISSION_COUNT, each
    MISSION_ITEM_INT when it is requested (by ArduPilot with MISSION_REQUEST), MISSION_ACK; then the
    same the other way round.
    """

    def __init__(self, settings: MavlinkSettings, sender: Any, log: ReportLog) -> None:
        #: Why the autopilot may have another fence; empty where it has it, or needs none.
        self.problem = ''
        self._items: list[Item] = []
        self._own = settings.own_system
        self._vehicle = settings.system, mavlink.MAV_COMP_ID_AUTOPILOT1
        self._sender = sender
        self._log = log
        self.begin()

    def begin(self, items: list[Item] | None = None) -> None:
        """Upload a fence, or the same again."""
        self._items = self._items if items is None else items
        self.busy, self._reason = bool(self._items), 'no answer'
        self._enter('ask', -math.inf if self.busy else math.inf)

    def _enter(self, step: str, now: float) -> None:
        """Begin with a step: 'ask' for the protocol, 'write' or 'read' the fence."""
        self._step, self._tries, self._due = step, 0, now
        self._at = -1  # item that was sent or requested last

    def tick(self, now: float) -> None:
        """Send what is due."""
        if now < self._due:
            return
        if not self.busy:
            self.begin()
        elif self._tries == _TRIES:
            self._conclude(ERROR, f'not verified ({self._reason})', now + _PAUSE)
        else:
            self._tries += 1
            self._send(now)

    def _send(self, now: float) -> None:
        self._due, sender, to = now + _PATIENCE, self._sender, self._vehicle
        if self._step == 'ask':
            what = mavlink.MAV_CMD_REQUEST_MESSAGE, 0, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
            sender.command_long_send(*to, *what, *[0.0] * 6)
        elif self._step == 'read' and self._at < 0:
            sender.mission_request_list_send(*to, _FENCE)
        elif self._step == 'read':
            sender.mission_request_int_send(*to, self._at, _FENCE)
        elif self._at < 0:
            sender.mission_count_send(*to, len(self._items), _FENCE)
        else:
            command, number, *place = self._items[self._at]
            head = self._at, mavlink.MAV_FRAME_GLOBAL, command, 0, 1, number
            sender.mission_item_int_send(*to, *head, *[0.0] * 3, *place, 0.0, _FENCE)

    def take(self, message: Any, now: float) -> None:
        """Take a message; those that are not an answer are left out."""
        kind, step, last = message.get_type(), self._step, len(self._items) - 1
        if kind == 'AUTOPILOT_VERSION' and step == 'ask':
            if message.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE:
                self._enter('write', now)
            else:
                self._conclude(WARNING, 'not uploaded: the autopilot has no protocol for it')
        elif getattr(message, 'mission_type', None) != _FENCE or message.target_system != self._own:
            return
        elif step == 'write' and kind in ('MISSION_REQUEST', 'MISSION_REQUEST_INT'):
            self._at = min(message.seq, last)
            self._send(now)
        elif step == 'write' and kind == 'MISSION_ACK':
            if message.type == mavlink.MAV_MISSION_ACCEPTED and self._at == last:
                self._enter('read', now)
            # An item that came twice changes nothing.
            elif message.type != mavlink.MAV_MISSION_INVALID_SEQUENCE:
                self._at = -1
                self._reason = mavlink.enums['MAV_MISSION_RESULT'][message.type].name
        elif step == 'read' and kind == 'MISSION_COUNT' and self._at < 0:
            self._compare(message.count == last + 1, 'the number of its items', now)
        elif step == 'read' and kind == 'MISSION_ITEM_INT' and message.seq == self._at:
            read = message.command, message.param1, message.x, message.y
            same = np.isclose(read, self._items[self._at], 0.0, _ROUNDING).all()
            self._compare(bool(same), f'item {self._at}', now)

    def _compare(self, same: bool, what: str, now: float) -> None:
        self._at, self._tries = self._at + 1, 0
        if not same:
            self._conclude(ERROR, f'read back, {what} differs', now + _PAUSE)
        elif self._at < len(self._items):
            self._send(now)
        else:
            self._sender.mission_ack_send(*self._vehicle, mavlink.MAV_MISSION_ACCEPTED, _FENCE)
            self._conclude(INFO, f'uploaded and verified, {self._at} vertices and circles')

    def _conclude(self, severity: int, result: str, again: float = math.inf) -> None:
        problem = f'its fence is {result}' if severity == ERROR else ''
        if not problem or problem != self.problem:
            self._log.add(severity, f'fence: {result}')
        self.problem, self.busy, self._step, self._due = problem, False, '', again
