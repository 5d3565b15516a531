"""A Mambo by Bluetooth: pyparrot's own connection, over a stand-in for the radio."""

import time

import fake_bluepy
import numpy as np
import pytest
from simulated_mambo import FENCE, HOME, MOTION, TILT, full_speed
from waiting import wait_until

from maasi_drivers.links.mambo.link import MamboLink
from maasi_drivers.links.mambo.pilot import MamboPilot, Phase
from maasi_drivers.settings.vehicles import MamboSettings
from maasi_filter.models.pose import Pose
from maasi_planner.motion import make_motion
from maasi_sim.emulators.mambo.firmware import FirmwareSettings, FlyingState, MamboFirmware

# Between two looks [s]; the radio is asked as often.
PERIOD = 0.05


class Flight:
    """A pilot in real time, a link, and a drone that tells no position."""

    def __init__(self, monkeypatch, lost_link):
        start = Pose.from_yaw([*HOME.position[:2], 0.0], HOME.yaw)
        self.firmware = MamboFirmware(start, FirmwareSettings(lost_link=lost_link))
        self.radio = fake_bluepy.install(monkeypatch, self.firmware)
        self.link = MamboLink('ble', 'e0:14:d0:63:3d:d0', tilt=TILT)
        self.link.connect()
        self.goal = None
        settings = {'arm': True, 'pose': 'pose', 'full_speed': full_speed(0.5)}
        settings = MamboSettings(**settings, link_timeout=1.5, land_after=1.0)
        self.motion = make_motion(MOTION)
        self.pilot = MamboPilot(self.link, self.motion, settings, HOME, FENCE)
        self.permitted = False

    def step(self):
        now = time.monotonic()
        self.link.keep_alive()
        self.pilot.update(now)
        self.permitted = self.permitted or self.pilot.permit(now) == ''
        self.pilot.take_pose(now, self.firmware.state)
        if self.goal is not None and self.pilot.phase is Phase.FLYING:
            self.pilot.fly(self.motion.command(self.pilot.ahead(), self.goal))
        time.sleep(PERIOD)

    def until(self, condition):
        pilot, link = self.pilot, self.link
        wait_until(condition, self.step, lambda: (pilot.phase, pilot.problem, link.error))


@pytest.fixture(params=['hover', 'land'])
def flight(monkeypatch, request):
    made = Flight(monkeypatch, request.param)
    yield made
    made.link.close()


def test_it_flies_without_sensor_stamps_and_notices_a_lost_link(flight):
    flight.until(lambda: flight.pilot.phase is Phase.FLYING)
    flight.goal = HOME.position + np.array([0.4, 0.0, 0.0])
    flight.until(lambda: np.linalg.norm(flight.firmware.state.pose.position - flight.goal) < 0.06)
    assert flight.link.position is None and flight.pilot.problem == ''
    # One piloting command after the other, and what has to be acknowledged.
    assert flight.radio.heard.count(('fa0a', (2, 0, 2))) >= 10
    assert ('fa0b', (2, 8, 1)) in flight.radio.heard
    flight.radio.cut = True
    flight.until(lambda: flight.pilot.problem.startswith('link lost: nothing from the Mambo'))
    flight.until(lambda: flight.firmware.flying_state != FlyingState.FLYING)
    flight.until(lambda: flight.pilot.phase is Phase.LANDING)
    if flight.firmware.settings.lost_link == 'hover':
        assert flight.firmware.flying_state == FlyingState.HOVERING
    flight.radio.cut = False
    flight.until(lambda: flight.firmware.flying_state == FlyingState.LANDED)
    assert flight.firmware.take_offs == 1
