"""A Mambo's pilot over the fake's firmware, without a network and in simulated time."""

import math
from types import SimpleNamespace

import numpy as np

from maasi_drivers.links.mambo.link import PositionEvent
from maasi_drivers.links.mambo.pilot import MamboPhase, MamboPilot
from maasi_drivers.measure_mambo import MeasuringFlight, fit_speed
from maasi_drivers.settings.vehicles import MamboSettings
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.operating_volume import OperatingVolume
from maasi_filter.models.pose import Pose
from maasi_planner.motion import make_motion
from maasi_planner.settings import MotionSettings
from maasi_sim.scenario.schema import BatterySettings
from maasi_sim.simulation.emulators.mambo.firmware import FirmwareSettings, MamboFirmware, Piloting
from maasi_sim.simulation.odometry import OdometrySettings

STEP = 0.05
TILT = 0.1
MOTION = MotionSettings(model='mambo', speed=0.4, tilt=TILT)
HOME = Pose.from_yaw([1.0, 1.2, 1.0], 0.6)
FENCE = np.array([[-0.4, 2.5], [-0.4, 2.5], [0.0, 2.0]])


def full_speed(drag):
    """Return the steady speed of the firmware's body at the largest tilt [m/s]."""
    return 9.81 * math.tan(TILT) / drag


class Flight:
    """A firmware, a link to it that loses nothing, and time: 20 steps a second."""

    def __init__(self, battery=1.0, drag=0.5, firmware_delay=0.1, permitted=True, **settings):
        self.firmware = MamboFirmware(
            Pose.from_yaw([*HOME.position[:2], 0.0], HOME.yaw),
            FirmwareSettings(delay=firmware_delay, lost_link='land', drag=drag),
            BatterySettings(charge=battery),
            OdometrySettings(position_noise=0.002, heading_noise=0.002),
        )
        self.firmware.limit('tilt', math.degrees(TILT))
        self.firmware.limit('climb', 0.5)
        self.connected, self.error = True, ''
        self.tilt, self.climb = TILT, 0.5
        self.position = None
        self.cut_up = self.cut_down = False
        self.sent = 'true'
        self.time = self.received_at = 0.0
        self.flying_state, self.battery = 'landed', battery
        self.motion = make_motion(MOTION)
        settings = MamboSettings(**{'full_speed': full_speed(drag), 'arm': True} | settings)
        volume = OperatingVolume(Area(FENCE), 0.1, FENCE.copy())
        self.pilot = MamboPilot(self, self.motion, settings, HOME, volume)
        self.pilot.update(self.time)
        if permitted:
            self.pilot.permit(self.time)
        self.goal = None

    def take_off(self):
        if not self.cut_up:
            self.firmware.take_off()

    def land(self):
        if not self.cut_up:
            self.firmware.land()

    def steer(self, forward, left, up, turn):
        if not self.cut_up:
            values = [round(100 * max(-1.0, min(x, 1.0))) for x in (-left, forward, -turn, up)]
            self.firmware.pilot(Piloting(*values))

    def keep_alive(self):
        pass

    def step(self, number=1):
        for _ in range(number):
            self.time += STEP
            if not self.cut_up:
                self.firmware.note_message()
            self.firmware.advance(STEP)
            if not self.cut_down:
                self.flying_state = self.firmware.flying_state.name.lower().replace('_', '')
                self.battery = self.firmware.charge.charge
                if round(self.time / STEP) % 10 == 0:
                    self.received_at = self.time
                    self._send_position()
            self.pilot.update(self.time)
            if self.goal is not None and self.pilot.phase is MamboPhase.FLYING:
                self.pilot.fly(self.motion.command(self.pilot.ahead(), self.goal))

    def _send_position(self):
        if self.sent == 'none':
            return
        estimate = self.firmware.estimate()
        position = np.array([*estimate.position[:2], round(estimate.position[2], 2)])
        if self.sent == 'stuck':
            position = self.position.position
        yaw = math.radians(round(math.degrees(estimate.yaw)))
        self.position = PositionEvent(position, yaw, self.time)

    def is_silent(self, steps):
        """Lose what it sends for some steps."""
        self.cut_down = True
        self.step(steps)
        self.cut_down = False

    def until(self, condition, limit=30.0):
        end = self.time + limit
        while not condition():
            assert self.time < end, (self.pilot.phase, self.pilot.problem)
            self.step()

    def until_it_is(self, state):
        """Go on until the firmware is in a flying state; return for how long [s]."""
        began = self.time
        self.until(lambda: self.firmware.flying_state == state)
        return self.time - began

    def up(self):
        """Return itself, in the air."""
        self.until(lambda: self.pilot.phase is MamboPhase.FLYING)
        return self

    def flown(self):
        """Return itself, in the air and on its route."""
        self.up().goal = HOME.position + np.array([0.9, -0.6, 0.0])
        self.step(30)
        return self

    @property
    def where(self):
        return self.firmware.state.pose.position

    @property
    def speed(self):
        return float(np.linalg.norm(self.firmware.state.velocity))

    @property
    def left(self):
        """Way left to its goal [m]."""
        return float(np.linalg.norm(self.where - self.goal))


# The field of the scenarios on the floor and what its candidates reach: x and y [m].
FIELD = np.array([[-0.3, 2.4], [-0.3, 2.4]])
WAYPOINTS = [[2.2, 2.2], [-0.1, 2.2], [2.2, -0.1], [-0.1, -0.1], [1.05, 1.05], [1.43, 1.05]]


def measure_and_fly(drag, delay):
    """Return how a Mambo flies over the field with what its measuring flight says."""
    # Farthest from the start of a leg, beyond a waypoint, outside the field, and flown [m].
    flown = SimpleNamespace(far=0.0, overshoot=0.0, outside=-math.inf, distance=0.0, straight=0.0)
    flight = Flight(drag=drag, firmware_delay=delay, arm=False)
    measuring = MeasuringFlight(flight, 1.0, 6, lambda: flight.time)
    for _ in measuring.steps():
        flight.step()
        flown.far = max(flown.far, float(np.hypot(*(flight.where - HOME.position)[:2])))
    flown.measured = fit_speed(measuring.legs, TILT)
    speed, late = flown.measured.full_speed, flown.measured.delay
    flight = Flight(drag=drag, firmware_delay=delay, full_speed=speed, delay=late).up()
    began = flight.time
    for x, y in WAYPOINTS:
        start, goal = flight.where, np.array([x, y, HOME.position[2]])
        length = float(np.hypot(*(goal - start)[:2]))
        flown.straight += length
        flight.goal, arrived = goal, math.inf
        while flight.time - arrived < 1.0:
            before = flight.where
            flight.step()
            there = flight.where
            flown.distance += float(np.linalg.norm(there - before))
            beyond = float((there - start)[:2] @ (goal - start)[:2]) / length - length
            flown.overshoot = max(flown.overshoot, beyond)
            sides = [there[:2] - FIELD[:, 1], FIELD[:, 0] - there[:2]]
            flown.outside = max(flown.outside, float(np.max(sides)))
            arrived = min(arrived, flight.time) if flight.left <= MOTION.tolerance else math.inf
            assert flight.time - began < 300.0, 'it does not come to rest'
    flown.time = flight.time - began
    return flown
