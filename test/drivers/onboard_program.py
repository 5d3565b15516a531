"""A drone with its own program, as in 001, section 7: it takes waypoints by UDP."""

import math
import socket
import struct
import threading
import time
import zlib

import numpy as np

from maasi_filter.models.pose import Pose, compose
from maasi_planner.motion import RobotState
from maasi_sim.simulation.emulators.mavlink.flight_model import FlightModel

_STEP, _FEED_PERIOD = 0.02, 0.1
GROUND, AIR, LANDING = range(3)


class OnboardProgram:
    """The drone, in real time; `start` is its pose in the map at the start."""

    def __init__(self, address, feed, start):
        # How long it flies without an order [s].
        self.start, self.patience = start, 3.0
        self.charge = 1.0
        self.blobs, self.count = b'', 0  # of the next images, as the feed has them
        # Orders that it has received.
        self.kinds, self.take_offs = [], 0
        self.doing = GROUND
        # Up from where it stands, x forward, y left.
        self.model = FlightModel(np.zeros(3), speed=0.5)
        self._feed, self._silent = feed, False
        self._sequence = 0
        self._order, self._last, self._received_at = 0, None, -math.inf
        self._goal = np.zeros(3)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((address, 0))
        self._socket.setblocking(False)
        self.address, self.port = self._socket.getsockname()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    @property
    def state(self):
        pose = compose(self.start, Pose(self.model.position))
        return RobotState(pose, self.start.rotation() @ self.model.velocity)

    def cut(self, cut=True):
        """Let nothing of it get through; it still receives orders."""
        self._silent = cut

    def close(self):
        self._ended.set()
        self._thread.join()
        self._socket.close()

    def _live(self):
        sent_at = 0.0
        while not self._ended.wait(_STEP):
            now = time.monotonic()
            self._hear(now)
            self._fly(now)
            if now - sent_at >= _FEED_PERIOD and not self._silent:
                sent_at = now
                self._send()

    def _hear(self, now):
        while True:
            try:
                data = self._socket.recv(2048)
            except BlockingIOError:
                return
            # As docs/measurement_feed.md says, not by the code under test.
            magic, version, kind, _, sequence, *numbers = struct.unpack('<4sBBHI4f', data[:28])
            good = data[28:] == struct.pack('<I', zlib.crc32(data[:28])) and version == 1
            if magic != b'MSWO' or not good or sequence == self._last:
                continue
            self._last, self._received_at = sequence, now
            self._order, self._goal = kind, np.array(numbers[:3])
            self.kinds.append(kind)

    def _fly(self, now):
        silence, order = now - self._received_at, self._order
        if silence > self.patience:
            order = 0
        elif silence > 0.5:
            order = min(order, 1)
        if self.doing == GROUND:
            if order < 2:
                return
            self.take_offs += 1
        self.doing = AIR if order else LANDING
        if order == 2:
            self.model.fly_to(self._goal, None, _STEP)
        else:
            self.model.fly(np.array([0.0, 0.0, 0.0 if order else -0.5]), _STEP)
        if order == 0 and self.model.grounded:
            self.doing = GROUND

    def _send(self):
        self._sequence += 1
        data = b'MSMF' + struct.pack('<BBHHHII', 1, 1, self.count, 160, 120, self._sequence, 20000)
        numbers = [*self.model.position, 0.0, 0.0, 0.0, self.charge]
        data += struct.pack('<7fI', *numbers, self.doing) + self.blobs
        self._socket.sendto(data + struct.pack('<I', zlib.crc32(data)), self._feed)
