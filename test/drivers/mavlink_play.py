"""A vehicle's driver side and a fake autopilot on a wire in memory, in simulated time."""

import numpy as np

from maasi_drivers.links.mavlink.link import make_sender
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_drivers.links.mavlink.vehicle import Phase, Vehicle
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_sim.emulators.mavlink.autopilot_settings import AutopilotSettings
from maasi_sim.emulators.mavlink.fake_autopilot import FakeAutopilot

PERIOD = 0.02
FIRMWARES = ('arducopter', 'px4', 'ardusub')
HEIGHTS = {'arducopter': 2.0, 'px4': 2.0, 'ardusub': -1.5}


class Wire:
    """One direction: bytes in, messages out."""

    def __init__(self):
        self.data = bytearray()
        self.messages = []
        self.cut = False
        self._parser = mavlink.MAVLink(None)

    def write(self, data):
        if not self.cut:
            self.data += data

    def take(self):
        data, self.data = bytes(self.data), bytearray()
        messages = self._parser.parse_buffer(data) or []
        self.messages += messages
        return messages


class Play:
    """Both sides, and what went over the wire."""

    def __init__(
        self, firmware='arducopter', autopilot=None, permitted=True, memory=None, **changes
    ):
        kind = 'submarine' if firmware == 'ardusub' else 'copter'
        settings = {'vehicle': kind, 'arm': True} | changes
        self.to_driver, self.to_autopilot = Wire(), Wire()
        link = MavlinkSettings.model_validate(settings)
        self._start, self.memory = [2.0, 3.0, HEIGHTS[firmware]], memory
        self.vehicle = self._driver(link)
        # System and component of a ground station on another link; None: there is none.
        self.station = None
        self._beat_at = 0.0
        self.vehicle.active = True
        self.autopilot = FakeAutopilot(
            AutopilotSettings.model_validate({'firmware': firmware} | (autopilot or {})),
            mavlink.MAVLink(self.to_driver, 1, 1),
            0.3,
            np.random.default_rng(1),
        )
        self.now = 100.0
        self.driver_lives = True
        self.reports = []
        self._permitted = permitted

    def _driver(self, settings):
        sender = make_sender(settings.own_system)
        sender.file = self.to_autopilot
        return Vehicle(settings, self._start, sender, self.memory)

    def permit(self):
        """Call the service `arm`."""
        return self.vehicle.permit(self.now)

    def permitted(self):
        """Return itself, once the service `arm` is granted."""
        assert self.permit() == ''
        return self

    def restart_driver(self):
        """Start another driver in the place of the one before, which was killed."""
        old = self.vehicle
        self.vehicle = self._driver(old.settings)
        self.vehicle.active = self.driver_lives = True
        self.reports = []

    def cut(self):
        self.to_driver.cut = self.to_autopilot.cut = True

    def turn(self):
        self.now += PERIOD
        if self.station is not None and self.now - self._beat_at >= 1.0:
            self._beat_at = self.now
            wire = Wire()
            sender = mavlink.MAVLink(wire, *self.station)
            sender.heartbeat_send(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4)
            for message in wire.take():
                self.autopilot.handle(message, link=1)
        if self._permitted and self.vehicle.phase is not Phase.CONNECTING:
            self._permitted = False
            self.permit()
        self.autopilot.advance(PERIOD)
        heard = self.to_driver.take()
        if self.driver_lives:
            for message in heard:
                self.vehicle.handle(message, self.now)
            self.vehicle.tick(self.now)
            self.reports += self.vehicle.reports()
        for message in self.to_autopilot.take():
            self.autopilot.handle(message)

    def run(self, seconds):
        for _ in range(round(seconds / PERIOD)):
            self.turn()

    def until(self, condition, limit=60.0):
        end = self.now + limit
        while not condition():
            assert self.now < end, (self.vehicle.fault, self.reports[-8:])
            self.turn()

    def fly(self):
        self.until(lambda: self.vehicle.flying)
        return self

    def go(self, ahead=0.4, direction=(1.0, 0.0, 0.0), seconds=2.0):
        """Fly with the setpoint so far ahead, as the driver has it."""
        end = self.now + seconds
        while self.now < end:
            self.lead(ahead, direction)
            self.turn()
        return self

    def lead(self, ahead, direction=(1.0, 0.0, 0.0)):
        if self.vehicle.phase is Phase.FLYING:
            position = self.vehicle.estimate.telemetry.position
            self.vehicle.set_target(position + ahead * np.array(direction), 0.3)

    @property
    def fault(self):
        return self.vehicle.fault

    @property
    def phase(self):
        return self.vehicle.phase

    @property
    def estimate(self):
        return self.vehicle.estimate

    @property
    def mode(self):
        return self.autopilot.mode_name

    @property
    def armed(self):
        return self.autopilot.armed

    @property
    def position(self):
        return self.autopilot.body.position

    @property
    def level_speed(self):
        return float(np.linalg.norm(self.autopilot.body.velocity[:2]))

    @property
    def speed(self):
        return float(np.linalg.norm(self.autopilot.body.velocity))

    @property
    def said(self):
        return ' | '.join(text for _, text in self.reports)

    def sent(self, kind):
        return [item for item in self.to_autopilot.messages if item.get_type() == kind]

    def commands(self, number):
        return [item for item in self.sent('COMMAND_LONG') if item.command == number]
