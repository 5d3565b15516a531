"""A vehicle's driver side and a fake autopilot on a wire in memory, in simulated time."""

import numpy as np

from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.links.mavlink.link import make_sender
from maasi_drivers.links.mavlink.phases import VehiclePhase
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_drivers.links.mavlink.vehicle import Vehicle
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_sim.simulation.emulators.mavlink.autopilot_settings import AutopilotSettings
from maasi_sim.simulation.emulators.mavlink.fake_autopilot import FakeAutopilot

PERIOD = 0.02
ARM, TAKE_OFF = mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_NAV_TAKEOFF
NOT_ARMED = f'vehicle: not armed: {UNTIL_ARM}'
# What a vehicle may take until it has stopped [s].
AT_MOST = 1.5
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

    def read(self):
        data, self.data = bytes(self.data), bytearray()
        messages = self._parser.parse_buffer(data) or []
        self.messages += messages
        return messages


class RoutingAutopilot(FakeAutopilot):
    """One with two links: what comes on link 1 for all is passed on to the driver, as by ArduPilot.

    Heartbeats only where their system and component are not known there
    (`MAVLink_routing::check_and_forward`, `handle_heartbeat`).
    """

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.known = set()

    def handle(self, message, link=0):
        ids = message.get_srcSystem(), message.get_srcComponent()
        if link == 0:
            self.known.add(ids)
        elif getattr(message, 'target_system', 0) == 0 and not self.crashed:
            heartbeat = message.get_type() == 'HEARTBEAT'
            if ids not in self.known if heartbeat else self.known:
                self._sender.file.write(bytes(message.get_msgbuf()))
        super().handle(message)

    def restart(self):
        super().restart()
        self.known.clear()


class Play:
    """Both sides, and what went over the wire; `stranger` is called as what others do meanwhile."""

    def __init__(
        self, firmware='arducopter', autopilot=None, permitted=True, memory=None, **changes
    ):
        kind = 'submarine' if firmware == 'ardusub' else 'copter'
        self.settings = MavlinkSettings.model_validate({'vehicle': kind, 'arm': True} | changes)
        self.height, self._memory = HEIGHTS[firmware], memory
        self.to_driver, self.to_autopilot = Wire(), Wire()
        self.stranger = lambda: None
        self.autopilot = RoutingAutopilot(
            AutopilotSettings.model_validate({'firmware': firmware} | (autopilot or {})),
            mavlink.MAVLink(self.to_driver, 1, 1),
            0.3,
            np.random.default_rng(1),
        )
        self.body = self.autopilot.body
        self.now = 100.0
        self._permitted = permitted
        self.start_driver()

    def start_driver(self):
        """Start a driver, instead of one that was killed."""
        sender = make_sender(self.settings.own_system)
        sender.file = self.to_autopilot
        self.vehicle = Vehicle(self.settings, [2.0, 3.0, self.height], sender, self._memory)
        self.vehicle.active = self.driver_lives = True
        self.reports = []

    def permit(self):
        return self.vehicle.permit(self.now)

    def permitted(self):
        """Return itself, once the service `arm` is granted."""
        assert self.permit() == ''
        return self

    def beat(self, system, component):
        """Be another ground station, on its own link."""
        wire = Wire()
        mavlink.MAVLink(wire, system, component).heartbeat_send(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4)
        for message in wire.read():
            self.autopilot.handle(message, link=1)

    def stands(self, seconds=0.0):
        """Check that nothing arms it until the service `arm` is called."""
        armed = len(self.commands(ARM))
        self.run(seconds)
        assert self.fault == NOT_ARMED and not self.autopilot.armed
        assert len(self.commands(ARM)) == armed
        self.permitted().fly()

    def turn(self):
        self.now += PERIOD
        self.stranger()
        if self._permitted and self.phase is not VehiclePhase.CONNECTING:
            self._permitted = False
            self.permit()
        self.autopilot.advance(PERIOD)
        received = self.to_driver.read()
        if self.driver_lives:
            for message in received:
                self.vehicle.handle(message, self.now)
            self.vehicle.tick(self.now)
            self.reports += self.vehicle.log.pop_all()
        for message in self.to_autopilot.read():
            self.autopilot.handle(message)

    def run(self, seconds, before=lambda: None):
        for _ in range(round(seconds / PERIOD)):
            before()
            self.turn()
        return self

    def unheard(self, seconds):
        """Return itself, after a time in which the driver receives nothing."""
        self.to_driver.cut = True
        self.run(seconds).to_driver.cut = False
        return self

    def without_driver(self, seconds, position=None):
        """Let the driver hang for a time; then the vehicle may be carried elsewhere."""
        self.driver_lives = False
        self.run(seconds)
        if position is not None:
            self.body.position[:2] = position
        self.driver_lives = True

    def until(self, condition, limit=60.0):
        end = self.now + limit
        while not condition():
            assert self.now < end, (self.fault, self.reports[-8:])
            self.turn()
        return self

    def fly(self):
        return self.until(lambda: self.vehicle.flying)

    def go(self):
        """Fly for a while."""
        return self.run(2.0, self.lead)

    def lead(self):
        """Set the set-point a short distance ahead, as the driver does."""
        if self.phase is VehiclePhase.FLYING:
            ahead = self.vehicle.estimate.telemetry.position + np.array([0.4, 0.0, 0.0])
            self.vehicle.set_target(ahead, 0.3)

    @property
    def fault(self):
        return self.vehicle.fault

    @property
    def phase(self):
        return self.vehicle.phase

    @property
    def mode(self):
        return self.autopilot.mode_name

    @property
    def speed(self):
        """Over the ground [m/s]."""
        return float(np.linalg.norm(self.body.velocity[:2]))

    @property
    def said(self):
        return ' | '.join(text for _, text in self.reports)

    def sent(self, kind):
        return [item for item in self.to_autopilot.messages if item.get_type() == kind]

    def commands(self, number):
        return [item for item in self.sent('COMMAND_LONG') if item.command == number]
