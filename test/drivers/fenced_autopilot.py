"""A fake autopilot with a fence, as ArduPilot keeps it."""

from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_sim.simulation.emulators.mavlink.fake_autopilot import FakeAutopilot

_FENCE = mavlink.MAV_MISSION_TYPE_FENCE
_POLYGONS = (
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_INCLUSION,
    mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
)


def is_whole(items):
    """Return whether each polygon has all of its corners."""
    while items:
        head, *_ = heads = [item[:2] for item in items]
        corners = int(head[1]) if head[0] in _POLYGONS else 1
        if head[0] in _POLYGONS and (corners < 3 or heads[:corners] != [head] * corners):
            return False
        items = items[corners:]
    return True


class FakeFence:
    """The vehicle's side of the mission protocol for fences.

    As in ArduPilot's source: it asks for items by MISSION_REQUEST, again after 1 s
    (`MissionItemProtocol::update`), refuses another item than the one asked for with
    INVALID_SEQUENCE (`handle_mission_item`), what asks during an upload with DENIED, and more
    items than it has places for, 84 on a Pixhawk (`AC_PolyFence_loader::max_items`), with NO_SPACE;
    it keeps a fence only whole, with as many items of each polygon as that has corners, at least
    three (`validate_fence`), and says that it has fences in AUTOPILOT_VERSION
    (`GCS_MAVLINK::capabilities`).
    """

    messages = ('MISSION_COUNT', 'MISSION_ITEM_INT', 'MISSION_REQUEST_LIST', 'MISSION_REQUEST_INT')

    def __init__(self, sender):
        #: Command, number of corners or radius [m], latitude and longitude [1e-7 degrees].
        self.items = []
        self.most = 84
        self._sender = sender
        self._station = 0, 0
        # Items of an upload, until there are as many as were announced.
        self._incoming = []
        self._announced = 0
        self._asked_at = 0.0

    def advance(self, now):
        if self._announced and now - self._asked_at > 1.0:
            self._ask(now)

    def _ask(self, now):
        self._asked_at = now
        self._sender.mission_request_send(*self._station, len(self._incoming), _FENCE)

    def handle(self, message, now):
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

    def _take(self, message, now):
        result = mavlink.MAV_MISSION_INVALID_SEQUENCE
        if message.seq == len(self._incoming):
            self._incoming.append((message.command, message.param1, message.x, message.y))
            if len(self._incoming) < self._announced:
                self._ask(now)
                return
            self._announced, result = 0, mavlink.MAV_MISSION_ERROR
            if is_whole(self._incoming):
                self.items, result = self._incoming, mavlink.MAV_MISSION_ACCEPTED
        self._sender.mission_ack_send(*self._station, result, _FENCE)


class FencedAutopilot(FakeAutopilot):
    def __init__(self, settings, sender, yaw, generator):
        super().__init__(settings, sender, yaw, generator)
        self.fence = FakeFence(sender)
        self.capabilities = mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE

    def handle(self, message):
        super().handle(message)
        if message.get_type() in FakeFence.messages and message.mission_type == _FENCE:
            self.fence.handle(message, self.now)

    def advance(self, dt):
        super().advance(dt)
        self.fence.advance(self.now)
