"""The fence of a fake autopilot, as ArduPilot keeps it."""

from typing import Any

from maasi_drivers.links.mavlink.fence import Item
from maasi_drivers.links.mavlink.protocol import mavlink

_FENCE = mavlink.MAV_MISSION_TYPE_FENCE


class FakeFence:
    """The vehicle's side of the mission protocol for fences.

    As in ArduPilot's source: it asks for items by MISSION_REQUEST, again after 1 s
    (`MissionItemProtocol::update`), refuses another item than the one asked for with
    INVALID_SEQUENCE (`handle_mission_item`), what asks during an upload with DENIED, and more
    items than it has places for, 84 on a Pixhawk (`AC_PolyFence_loader::max_items`).
    """

    messages = ('MISSION_COUNT', 'MISSION_ITEM_INT', 'MISSION_REQUEST_LIST', 'MISSION_REQUEST_INT')

    def __init__(self, sender: Any) -> None:
        self.supported = True
        self.items: list[Item] = []
        self.most = 84
        self._sender = sender
        self._station = 0, 0
        # Items of an upload, until there are as many as were announced.
        self._incoming: list[Item] = []
        self._announced = 0
        self._asked_at = 0.0

    def advance(self, now: float) -> None:
        """Ask again for an item that has not come."""
        if self._announced and now - self._asked_at > 1.0:
            self._ask(now)

    def _ask(self, now: float) -> None:
        self._asked_at = now
        self._sender.mission_request_send(*self._station, len(self._incoming), _FENCE)

    def handle(self, message: Any, now: float) -> None:
        """Take a message of an upload, or of one who reads."""
        kind, sender = message.get_type(), self._sender
        self._station = to = message.get_srcSystem(), message.get_srcComponent()
        if kind == 'MISSION_COUNT' and message.count <= self.most:
            self._incoming, self._announced = [], message.count
            self._ask(now)
        elif kind == 'MISSION_COUNT':
            sender.mission_ack_send(*to, mavlink.MAV_MISSION_NO_SPACE, _FENCE)
        elif kind == 'MISSION_ITEM_INT' and self._announced:
            self._take(message, now)
        elif kind == 'MISSION_ITEM_INT' or self._announced:
            wrong = mavlink.MAV_MISSION_DENIED if self._announced else mavlink.MAV_MISSION_ERROR
            sender.mission_ack_send(*to, wrong, _FENCE)
        elif kind == 'MISSION_REQUEST_LIST':
            sender.mission_count_send(*to, len(self.items), _FENCE)
        elif message.seq < len(self.items):
            command, number, *place = self.items[message.seq]
            head = message.seq, mavlink.MAV_FRAME_GLOBAL, command, 0, 0, number
            sender.mission_item_int_send(*to, *head, 0, 0, 0, *place, 0, _FENCE)

    def _take(self, message: Any, now: float) -> None:
        result = mavlink.MAV_MISSION_INVALID_SEQUENCE
        if message.seq == len(self._incoming):
            self._incoming.append((message.command, message.param1, message.x, message.y))
            if len(self._incoming) < self._announced:
                self._ask(now)
                return
            result = mavlink.MAV_MISSION_ACCEPTED
            self.items, self._announced = self._incoming, 0
        self._sender.mission_ack_send(*self._station, result, _FENCE)
