"""The fence of a fake autopilot: how it is uploaded, what is outside of it, and what it does."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import shapely

from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.geodesy import OriginSettings, to_map

Item = tuple[int, float, int, int]

_FENCE = mavlink.MAV_MISSION_TYPE_FENCE
_INSIDE = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION
_OUTSIDE = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
_POLYGONS = (_INSIDE, _OUTSIDE)
# Bits of FENCE_TYPE, and their names in texts (`AC_Fence::get_fence_names`).
_TYPES = {1: 'alt max', 2: 'circle', 4: 'polygon'}
_POLYGON = 4
#: Modes by FENCE_ACTION (`Copter::fence_checks_async`); 0 only reports.
ACTIONS = {1: 'RTL', 2: 'LAND', 4: 'BRAKE'}


def polygons_of(items: list[Item]) -> list[list[Item]] | None:
    """Return the items of each polygon or circle; None where a polygon lacks corners."""
    groups = []
    while items:
        head, *_ = heads = [item[:2] for item in items]
        corners = int(head[1]) if head[0] in _POLYGONS else 1
        if head[0] in _POLYGONS and (corners < 3 or heads[:corners] != [head] * corners):
            return None
        groups.append(items[:corners])
        items = items[corners:]
    return groups


class FakeFence:
    """The vehicle's side of the mission protocol for fences, and the fence itself.

    As in ArduPilot's source: it asks for items by MISSION_REQUEST, again after 1 s
    (`MissionItemProtocol::update`), refuses another item than the one asked for with
    INVALID_SEQUENCE (`handle_mission_item`), what asks during an upload with DENIED, and more
    items than it has places for, 84 on a Pixhawk (`AC_PolyFence_loader::max_items`), with NO_SPACE;
    it keeps a fence only whole, with as many items of each polygon as that has corners, at least
    three (`validate_fence`), and says that it has fences in AUTOPILOT_VERSION
    (`GCS_MAVLINK::capabilities`). With FENCE_ENABLE a destination outside is rejected without a
    word (`AC_Fence::check_destination_within_fence`), whatever FENCE_ACTION is.

    home: where the local frame begins on the earth; without it nothing is outside of polygons.
    """

    messages = ('MISSION_COUNT', 'MISSION_ITEM_INT', 'MISSION_REQUEST_LIST', 'MISSION_REQUEST_INT')

    def __init__(self, sender: Any, parameters: Mapping[str, float]) -> None:
        self.most = 84
        self.home: OriginSettings | None = None
        self.breached = 0  #: bits of FENCE_TYPE
        self._sender, self._parameters = sender, parameters
        #: Command, number of corners or radius [m], latitude and longitude [1e-7 degrees].
        self.items: list[Item] = []
        # Of the items that they were made of: where it may be, and what is closed.
        self._shapes: tuple[list[Item], Any, list[Any]] = [], None, []
        self._station = 0, 0
        # Items of an upload, until there are as many as were announced.
        self._incoming: list[Item] = []
        self._announced = 0
        self._asked_at = 0.0

    def advance(self, now: float) -> None:
        """Ask again for an item that did not come."""
        if self._announced and now - self._asked_at > 1.0:
            self._ask(now)

    @property
    def types(self) -> int:
        """Bits of the fences that are enabled."""
        read = self._parameters.get
        return int(read('FENCE_TYPE', 7)) if read('FENCE_ENABLE', 0) else 0

    @property
    def problem(self) -> str:
        """Why it is not armed; `AC_Fence::pre_arm_check`."""
        if self.types == _POLYGON and not self.items:
            return 'Fences enabled, but none selected'
        return 'Vehicle breaching fence' if self.breached else ''

    def breach(self, position: FloatArray, height: float) -> int:
        """Return which fences a position (3,), local, `height` above home [m] is outside of."""
        read, found = self._parameters.get, 0
        if height > read('FENCE_ALT_MAX', 100.0):
            found |= 1
        if float(np.hypot(*position[:2])) > read('FENCE_RADIUS', 300.0):
            found |= 2
        if self.home is not None and self.items:
            if self._shapes[0] != self.items:
                self._shapes = list(self.items), *self._make_shapes(self.home)
            point = shapely.Point(position[:2])
            _, allowed, closed = self._shapes
            if not (allowed is None or allowed.covers(point)):
                found |= _POLYGON
            if any(shape.contains(point) for shape in closed):
                found |= _POLYGON
        return found & self.types

    def check(self, position: FloatArray, height: float) -> str:
        """Update `breached`; return what is said of a new breach, or nothing."""
        before, self.breached = self.breached, self.breach(position, height)
        new = self.breached & ~before
        if not new:
            return ''
        self.send_status()
        names = ' and '.join(name for bit, name in _TYPES.items() if new & bit)
        return f'{names} fence breached'

    def send_status(self) -> None:
        """Send FENCE_STATUS, where a fence is enabled (`send_fence_status`)."""
        if self.types:
            kind = mavlink.FENCE_BREACH_BOUNDARY if self.breached else mavlink.FENCE_BREACH_NONE
            self._sender.fence_status_send(bool(self.breached), bool(self.breached), kind, 0)

    def _make_shapes(self, home: OriginSettings) -> tuple[Any, list[Any]]:
        allowed, closed = None, []
        for group in polygons_of(self.items) or []:
            degrees = 1e-7 * np.array([item[:1:-1] for item in group], dtype=float)
            corners = to_map(degrees, home)
            if group[0][0] not in _POLYGONS:
                closed.append(shapely.Point(corners[0]).buffer(group[0][1], quad_segs=32))
            elif group[0][0] == _INSIDE:
                shape = shapely.Polygon(corners)
                allowed = shape if allowed is None else allowed.intersection(shape)
            else:
                closed.append(shapely.Polygon(corners))
        return allowed, closed

    def _ask(self, now: float) -> None:
        self._asked_at = now
        self._sender.mission_request_send(*self._station, len(self._incoming), _FENCE)

    def handle(self, message: Any, now: float) -> None:
        """Take a message of the protocol."""
        kind, sender = message.get_type(), self._sender
        self._station = to = message.get_srcSystem(), message.get_srcComponent()
        if kind == 'MISSION_COUNT' and message.count <= self.most:
            self._incoming, self._announced = [], message.count
            self._ask(now)
        elif kind == 'MISSION_COUNT':
            sender.mission_ack_send(*to, mavlink.MAV_MISSION_NO_SPACE, _FENCE)
        elif kind == 'MISSION_ITEM_INT' and self._announced:
            self._handle(message, now)
        elif kind == 'MISSION_ITEM_INT' or self._announced:
            wrong = mavlink.MAV_MISSION_DENIED if self._announced else mavlink.MAV_MISSION_ERROR
            sender.mission_ack_send(*to, wrong, _FENCE)
        elif kind == 'MISSION_REQUEST_LIST':
            sender.mission_count_send(*to, len(self.items), _FENCE)
        elif message.seq < len(self.items):
            command, number, *place = self.items[message.seq]
            head = message.seq, mavlink.MAV_FRAME_GLOBAL, command, 0, 0, number
            sender.mission_item_int_send(*to, *head, 0, 0, 0, *place, 0, _FENCE)

    def _handle(self, message: Any, now: float) -> None:
        result = mavlink.MAV_MISSION_INVALID_SEQUENCE
        if message.seq == len(self._incoming):
            self._incoming.append((message.command, message.param1, message.x, message.y))
            if len(self._incoming) < self._announced:
                self._ask(now)
                return
            self._announced, result = 0, mavlink.MAV_MISSION_ERROR
            if polygons_of(self._incoming) is not None:
                self.items, result = self._incoming, mavlink.MAV_MISSION_ACCEPTED
        self._sender.mission_ack_send(*self._station, result, _FENCE)
