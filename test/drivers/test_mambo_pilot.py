"""The Mambo's pilot against the fake's firmware, without a network and in simulated time."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from maasi_drivers.mambo_link import PositionEvent
from maasi_drivers.mambo_pilot import DeadReckoning, MamboPilot, Phase, full_speed
from maasi_drivers.mambo_settings import MamboSettings
from maasi_filter.pose import Pose
from maasi_planner.motion import RobotState, make_motion
from maasi_planner.settings import MotionSettings
from maasi_sim.mambo_firmware import FirmwareSettings, FlyingState, MamboFirmware, Piloting
from maasi_sim.odometry_model import OdometrySettings
from maasi_sim.robots import BatterySettings

STEP = 0.05
MOTION = MotionSettings(model='mambo', speed=0.4, tilt=0.1)
HOME = Pose.from_yaw([1.0, 1.2, 1.0], 0.6)
FENCE = np.array([[-0.4, 2.5], [-0.4, 2.5], [0.0, 2.0]])
# What a fault may take until the robot hovers or lands [s].
AT_MOST = 1.5
NAMES = {
    FlyingState.LANDED: 'landed',
    FlyingState.TAKING_OFF: 'takingoff',
    FlyingState.HOVERING: 'hovering',
    FlyingState.FLYING: 'flying',
    FlyingState.LANDING: 'landing',
    FlyingState.EMERGENCY: 'emergency',
}


class Flight:
    """A firmware, a link to it that loses nothing, and time: 20 steps a second."""

    def __init__(self, arm=True, battery=1.0, gain_error=0.0, **settings):
        start = Pose.from_yaw([*HOME.position[:2], 0.0], HOME.yaw)
        self.firmware = MamboFirmware(
            MOTION,
            start,
            FirmwareSettings(gain_error=gain_error),
            BatterySettings(charge=battery),
            OdometrySettings(position_noise=0.002, heading_noise=0.002),
        )
        self.firmware.limit_tilt(math.degrees(0.1))
        self.firmware.limit_climb(0.5)
        self.connected, self.error = True, ''
        self.tilt, self.climb = 0.1, 0.5
        self.position = None
        self.cut_up = self.cut_down = False
        self.sent = 'true'
        self.time = self.heard_at = 0.0
        self._flying_state, self._battery = 'landed', battery
        self.motion = make_motion(MOTION)
        self.pilot = MamboPilot(self, self.motion, MamboSettings(arm=arm, **settings), HOME, FENCE)
        self.goal = None
        self.problems = []

    # ---- what the pilot sees of a link -------------------------------------------------------

    @property
    def flying_state(self):
        if not self.cut_down:
            self._flying_state = NAMES[self.firmware.flying_state]
        return self._flying_state

    @property
    def battery(self):
        if not self.cut_down:
            self._battery = self.firmware.charge.charge
        return self._battery

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

    # ---- time --------------------------------------------------------------------------------

    def step(self, number=1):
        for _ in range(number):
            self.time += STEP
            if not self.cut_up:
                self.firmware.hear()
            self.firmware.advance(STEP)
            if round(self.time / STEP) % 10 == 0 and not self.cut_down:
                self.heard_at = self.time
                self._send_position()
            self.pilot.update(self.time, self.time)
            self.problems.append(self.pilot.problem)
            if self.goal is not None and self.pilot.phase is Phase.FLYING:
                self.pilot.fly(self.motion.command(self.pilot.state, self.goal))

    def _send_position(self):
        if self.sent == 'none':
            return
        estimate = self.firmware.estimate()
        position = estimate.position.copy()
        position[2] = round(position[2], 2)
        if self.sent == 'stuck':
            position = self.position.position
        yaw = math.radians(round(math.degrees(estimate.yaw)))
        self.position = PositionEvent(position, yaw, self.time)

    def until(self, condition, limit=30.0):
        end = self.time + limit
        while not condition():
            assert self.time < end, (self.pilot.phase, self.pilot.problem)
            self.step()

    def flown(self):
        """Return itself, in the air and on the way."""
        self.until(lambda: self.pilot.phase is Phase.FLYING)
        self.goal = HOME.position + np.array([0.9, -0.6, 0.0])
        self.step(30)
        return self

    @property
    def where(self):
        return self.firmware.state.pose.position

    @property
    def speed(self):
        return float(np.linalg.norm(self.firmware.state.velocity))


def test_it_takes_off_flies_to_waypoints_and_lands():
    flight = Flight()
    flight.until(lambda: flight.pilot.phase is Phase.FLYING)
    assert flight.pilot.problem == ''
    assert_allclose(flight.where, HOME.position, atol=0.12)
    for goal in ([2.0, 0.3, 1.0], [0.1, 0.2, 1.2], [0.1, 2.0, 1.0]):
        flight.goal = np.array(goal)
        flight.until(lambda: np.linalg.norm(flight.where - flight.goal) < 0.03)
        flight.step(60)
        assert np.linalg.norm(flight.where - flight.goal) < 0.04
    flight.pilot.end('the search is over')
    flight.until(lambda: flight.firmware.flying_state == FlyingState.LANDED)
    flight.step(5)
    assert flight.pilot.problem == 'landed: the search is over'
    flight.step(100)
    assert flight.firmware.take_offs == 1


@pytest.mark.parametrize('gain_error', [-0.3, 0.3])
def test_events_correct_a_model_that_is_wrong(gain_error):
    flight = Flight(gain_error=gain_error)
    flight.until(lambda: flight.pilot.phase is Phase.FLYING)
    errors = []
    for goal in ([2.0, 0.3, 1.0], [0.1, 0.2, 1.0]):
        flight.goal = np.array(goal)
        for _ in range(260):
            flight.step()
            errors.append(np.linalg.norm(flight.pilot.state.pose.position - flight.where))
        assert np.linalg.norm(flight.where - flight.goal) < 0.05
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert max(errors) < 0.12


def test_dead_reckoning_between_events_is_where_it_is():
    flight = Flight()
    flight.flown()
    errors, tilts = [], []
    for _ in range(60):
        flight.step()
        state, true = flight.pilot.state, flight.firmware.state
        errors.append(np.linalg.norm(state.pose.position - true.pose.position))
        tilts.append(np.linalg.norm(state.pose.rotation()[:, 2] - true.pose.rotation()[:, 2]))
        deviation = np.sqrt(flight.pilot.reckoning.covariance()[0, 0])
        assert 0.01 <= deviation <= 0.05
    assert max(errors) < 0.03
    assert max(tilts) < 0.02


def test_an_event_corrects_the_time_that_it_is_of():
    settings = MamboSettings(latency=0.2)
    reckoning = DeadReckoning(make_motion(MOTION), Pose(np.zeros(3)), settings)
    reckoning.correct(PositionEvent(np.array([0.0, 0.0, 1.0]), 0.0, 0.0), flying=False)
    reckoning.command(np.array([0.3, 0.0, 0.0, 0.0]))
    truth = make_motion(MOTION).body(RobotState.at_rest([0.0, 0.0, 1.0]))
    places = {}
    for step in range(1, 61):
        now = step * STEP
        truth.step([0.3, 0.0, 0.0, 0.0], STEP)
        places[step] = truth.robot_state().pose.position
        reckoning.go_on(now, now, flying=True)
        if step % 10 == 0:
            # Four steps late.
            reckoning.correct(PositionEvent(places[step - 4], 0.0, now), flying=True)
    assert_allclose(reckoning.state.pose.position, places[60], atol=0.02)


def test_the_speed_of_full_tilt_is_the_motion_models():
    assert_allclose(full_speed(MOTION, 0.1), 0.3783, atol=1e-3)
    assert full_speed(MotionSettings(model='constant_speed', speed=0.7), 0.2) == 0.7


# ---- safety ----------------------------------------------------------------------------------


def test_nothing_takes_off_without_arm():
    flight = Flight(arm=False)
    flight.step(200)
    assert flight.firmware.take_offs == 0
    assert 'mambo.arm' in flight.pilot.problem
    with pytest.raises(ValueError, match='finite'):
        flight.pilot.fly(np.array([math.nan, 0.0, 0.0, 0.0]))
    flight.pilot.fly(np.array([0.1, 0.0, 0.0, 0.0]))
    flight.step(20)
    assert flight.firmware.height == 0.0


@pytest.mark.parametrize(
    ('fault', 'reason'),
    [
        ({'cut_down': True}, 'link lost: nothing from the Mambo'),
        ({'cut_down': True, 'cut_up': True}, 'link lost: nothing from the Mambo'),
        ({'sent': 'none'}, 'no position'),
        ({'sent': 'stuck'}, 'the position has not changed'),
    ],
)
def test_what_is_lost_stops_it_then_lands_it(fault, reason):
    flight = Flight().flown()
    assert flight.speed > 0.2
    for name, value in fault.items():
        setattr(flight, name, value)
    began = flight.time
    flight.until(lambda: flight.pilot.problem)
    assert flight.pilot.problem.startswith(reason)
    assert not flight.pilot.has_pose
    # Without new commands, or with those to hover.
    flight.until(lambda: flight.firmware.flying_state in (FlyingState.HOVERING, FlyingState.LANDED))
    assert flight.time - began <= AT_MOST
    flight.until(lambda: flight.firmware.flying_state == FlyingState.LANDED)
    assert flight.time - began <= 10.0
    for name in fault:
        setattr(flight, name, 'true' if name == 'sent' else False)
    flight.step(100)
    assert flight.pilot.problem.startswith(f'landed: {reason}')
    assert flight.firmware.take_offs == 1


def test_a_short_loss_is_forgiven():
    flight = Flight().flown()
    flight.cut_down = True
    flight.step(40)
    assert flight.pilot.problem.startswith('link lost')
    flight.cut_down = False
    flight.until(lambda: not flight.pilot.problem)
    assert flight.pilot.phase is Phase.FLYING
    flight.until(lambda: np.linalg.norm(flight.where - flight.goal) < 0.05)


def test_a_low_battery_lands_it_and_keeps_it_down():
    flight = Flight().flown()
    flight.firmware.charge.charge = 0.08
    began = flight.time
    flight.until(lambda: flight.firmware.flying_state == FlyingState.LANDING)
    assert flight.time - began <= AT_MOST
    flight.until(lambda: flight.firmware.flying_state == FlyingState.LANDED)
    flight.step(2)
    assert flight.pilot.problem == 'landed: battery at 0.08, below 0.10'
    other = Flight(battery=0.05)
    other.step(100)
    assert other.firmware.take_offs == 0 and 'battery' in other.pilot.problem


def test_a_cancelled_goal_stops_it_then_lands_it_and_another_one_takes_it_up():
    flight = Flight().flown()
    flight.goal = None
    flight.pilot.goal_cancelled(flight.time)
    began = flight.time
    flight.until(lambda: flight.firmware.flying_state == FlyingState.HOVERING)
    assert flight.time - began <= AT_MOST
    flight.until(lambda: flight.firmware.flying_state == FlyingState.LANDED)
    assert flight.time - began >= flight.pilot.settings.cancel_landing
    flight.step(50)
    assert flight.pilot.problem == '' and flight.firmware.take_offs == 1
    flight.pilot.goal_taken()
    flight.until(lambda: flight.pilot.phase is Phase.FLYING)
    assert flight.firmware.take_offs == 2


def test_a_new_goal_soon_after_a_cancelled_one_keeps_it_up():
    flight = Flight().flown()
    flight.pilot.goal_cancelled(flight.time)
    flight.step(20)
    flight.pilot.goal_taken()
    flight.step(200)
    assert flight.pilot.phase is Phase.FLYING


def test_it_lands_when_it_drifts_out_of_the_geofence():
    flight = Flight().flown()
    flight.goal = np.array([4.5, 1.0, 1.0])
    flight.until(lambda: flight.firmware.flying_state == FlyingState.LANDING)
    assert 'outside the geofence' in flight.pilot.problem
    assert flight.where[0] < FENCE[0, 1] + 0.5 + 0.4 * AT_MOST


def test_no_number_is_no_command():
    flight = Flight().flown()
    flight.goal = None
    with pytest.raises(ValueError, match='finite'):
        flight.pilot.fly(np.array([0.1, math.nan, 0.0, 0.0]))
    began = flight.time
    flight.until(lambda: flight.firmware.flying_state == FlyingState.HOVERING)
    assert flight.time - began <= AT_MOST


def test_a_caller_that_stands_still_is_a_drone_that_hovers_then_lands():
    flight = Flight().flown()
    began = flight.firmware.time
    while flight.firmware.flying_state == FlyingState.FLYING:
        flight.firmware.advance(STEP)
        assert flight.firmware.time - began <= AT_MOST
    while flight.firmware.flying_state != FlyingState.LANDED:
        flight.firmware.advance(STEP)
        assert flight.firmware.time - began <= 10.0


def test_a_drone_that_lands_by_itself_is_noticed():
    flight = Flight().flown()
    flight.firmware.land()
    flight.step(2)
    assert 'by itself' in flight.pilot.problem
    emergency = Flight().flown()
    emergency.firmware.emergency()
    emergency.step(2)
    assert 'emergency' in emergency.pilot.problem


def test_it_flies_by_the_pose_of_another_system():
    flight = Flight(pose='pose')
    flight.sent = 'none'

    def tell():
        flight.pilot.take_pose(flight.time, flight.firmware.state)
        return flight.pilot.phase is Phase.FLYING

    flight.until(tell)
    flight.goal = np.array([2.0, 0.5, 1.0])

    def arrived():
        tell()
        return np.linalg.norm(flight.where - flight.goal) < 0.05

    flight.until(arrived)
    flight.goal = np.array([0.0, 0.5, 1.0])
    for _ in range(30):
        tell()
        flight.step()
    began = flight.time
    flight.until(lambda: flight.pilot.problem.startswith('no position'))
    assert flight.time - began <= AT_MOST
