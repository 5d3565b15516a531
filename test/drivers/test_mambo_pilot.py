"""The Mambo's pilot against the fake's firmware, without a network and in simulated time."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from simulated_mambo import FENCE, HOME, STEP, TILT, Flight, full_speed, measure_and_fly

from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.links.mambo.link import PositionEvent
from maasi_drivers.links.mambo.pilot import MamboPhase, MamboPilot
from maasi_drivers.links.mambo.reckoning import Course, DeadReckoning, TiltModel
from maasi_drivers.settings.vehicles import MamboSettings
from maasi_filter.models.pose import Pose
from maasi_sim.simulation.emulators.mambo.firmware import FlyingState

AT_MOST = 1.5  # what a fault may take until the robot hovers or lands [s]


@pytest.mark.parametrize('share', [0.6, 1.0, 1.6])
def test_events_correct_a_speed_that_was_measured_wrong(share):
    flight = Flight(full_speed=share * full_speed(0.5)).up()
    errors, tilts, variances = [], [], []
    for goal in ([2.0, 0.3, 1.0], [0.1, 0.2, 1.0]):
        flight.goal = np.array(goal)
        for _ in range(300):
            flight.step()
            pose, true = flight.pilot.state.pose, flight.firmware.state.pose
            errors.append(np.linalg.norm(pose.position - true.position))
            tilts.append(np.linalg.norm((pose.rotation() - true.rotation())[:, 2]))
            variances.append(np.diag(flight.pilot.reckoning.covariance()))
        assert flight.left < 0.05
    right = share == 1.0
    assert np.sqrt(np.mean(np.square(errors))) < (0.02 if right else 0.05)
    assert max(errors) < (0.04 if right else 0.12)
    assert np.sqrt(np.mean(np.square(tilts))) < 0.01 and max(tilts) < 0.05
    x, tilt = np.array(variances)[:, [0, 3]].T
    assert x.min() >= 1e-4 and x.max() <= 0.05**2
    # Which of two tilts it has is not known while a command is being transmitted.
    assert tilt.max() > 1.2 * tilt.min() > 0.0


def test_an_event_corrects_the_time_that_it_is_of():
    model = TiltModel(TILT, 0.8, 0.5, 2.6)
    reckoning = DeadReckoning(model, Pose(np.zeros(3)), MamboSettings(latency=0.2, delay=0.0))
    reckoning.correct(PositionEvent(np.array([0.0, 0.0, 1.0]), 0.0, 0.0), flying=False)
    shares = np.array([0.4, 0.0, 0.0, 0.0])
    reckoning.command(0.0, shares)
    truth = [Course(np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0)]
    for step in range(1, 61):
        truth.append(model.advance(truth[-1], shares, STEP))
        reckoning.go_on(step * STEP, flying=True)
        if step % 10 == 0:
            # Four steps late.
            event = PositionEvent(truth[step - 4].position, 0.0, step * STEP)
            reckoning.correct(event, flying=True)
    assert_allclose(reckoning.state.pose.position, truth[-1].position, atol=0.02)


# Drag [1/s] and delay [s]; test/drivers/mambo_table.py prints more.
@pytest.mark.parametrize(('drag', 'delay'), [(0.3, 0.3), (3.0, 0.0)])
def test_it_stays_inside_the_field_with_what_the_measuring_flight_says(drag, delay):
    flown = measure_and_fly(drag, delay)
    assert_allclose(flown.measured.full_speed, full_speed(drag), rtol=0.1)
    # The time constant of the tilt is a delay, too.
    assert_allclose(flown.measured.delay, delay + 0.1, atol=0.05)
    assert flown.measured.uncertainty < 0.1 and flown.far < 1.0
    assert flown.overshoot <= 0.03 and flown.outside < 0.0
    assert flown.distance <= 1.1 * flown.straight


@pytest.mark.parametrize(('end', 'speed'), [(2.5, 0.8), (14.0, 3.0)])
def test_a_velocity_that_cannot_be_stopped_before_the_geofence_is_not_flown(end, speed):
    flight = Flight(drag=0.3, firmware_delay=0.3, delay=0.4).up()
    flight.pilot.volume.limits[0, 1] = end
    for _ in range(400):
        flight.step()
        # Along the map's x axis.
        along = speed * np.array([math.cos(HOME.yaw), -math.sin(HOME.yaw), 0.0, 0.0])
        flight.pilot.fly(along)
        assert flight.where[0] < end + 0.02
    assert flight.where[0] > end - 0.2 and flight.pilot.phase is MamboPhase.FLYING


@pytest.mark.parametrize('pose', ['events', 'pose'])
@pytest.mark.parametrize('drag', [0.3, 3.0])
def test_a_steady_push_does_not_keep_it_off_its_goal(pose, drag):
    flight = Flight(drag=drag, delay=0.2, pose=pose)
    flight.sent = 'true' if pose == 'events' else 'none'
    flight.goal = np.array([1.5, 0.3, 1.0])
    distances = []
    while flight.time < 35.0:
        if flight.where[2] > 0.05:
            flight.firmware.body.velocity[0] += 0.2 * STEP  # wind
        if pose == 'pose':
            flight.pilot.update_pose(flight.time, flight.firmware.state)
        flight.step()
        distances.append(flight.left)
    assert flight.pilot.phase is MamboPhase.FLYING and max(distances[-100:]) < 0.03
    # Without a pose it hovers.
    flight.sent, began = 'none', flight.time
    flight.until(lambda: flight.pilot.problem.startswith('no position'))
    assert flight.time - began <= AT_MOST


# ---- safety ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'arm': False}, 'mambo.arm'),
        ({'full_speed': None}, 'mambo.full_speed'),
        ({'battery': 0.05}, 'battery at 5 %, below 10 %'),
    ],
)
def test_what_keeps_it_on_the_ground(changes, text):
    flight = Flight(**changes)
    flight.pilot.fly(np.array([0.1, 0.0, 0.0, 0.0]))
    flight.step(200)
    assert text in flight.pilot.problem and text in flight.pilot.permit(flight.time)
    assert flight.firmware.take_offs == 0 and flight.firmware.height == 0.0
    # Nor does it fly one that is in the air.
    flight.firmware.take_off()
    flight.goal = HOME.position + np.array([0.9, -0.6, 0.0])
    flight.step(200)
    assert flight.pilot.phase is MamboPhase.GROUND and flight.speed < 1e-6


def test_each_call_of_the_service_is_for_one_take_off():
    flight = Flight(permitted=False)
    flight.step(20)
    assert flight.pilot.problem == f'on the ground, {UNTIL_ARM}'
    # A permission that is not used ends.
    flight.pilot._permission.timeout = 1.0
    assert flight.pilot.permit(flight.time - 2.0) == ''
    flight.step(100)
    assert flight.firmware.take_offs == 0
    assert flight.pilot.permit(flight.time) == ''
    flight.up()
    assert flight.pilot.permit(flight.time) == 'it is in the air already'
    # A driver before this one left it in the air.
    flight.pilot.phase = MamboPhase.GROUND
    flight.step(20)
    assert flight.pilot.problem == f'in the air, not by this driver, {UNTIL_ARM}'
    assert flight.pilot.permit(flight.time) == ''
    flight.up()
    assert flight.firmware.take_offs == 1


@pytest.mark.parametrize(
    ('fault', 'reason'),
    [
        ({'cut_down': True}, 'link lost: no data from the Mambo'),
        ({'cut_down': True, 'cut_up': True}, 'link lost: no data from the Mambo'),
        ({'sent': 'none'}, 'no position'),
        ({'sent': 'stuck'}, 'the position has not changed'),
    ],
)
def test_what_is_lost_stops_it_then_lands_it(fault, reason):
    flight = Flight().flown()
    # A short loss is forgiven.
    flight.is_silent(40)
    assert flight.pilot.problem.startswith('link lost')
    flight.until(lambda: not flight.pilot.problem)
    assert flight.pilot.phase is MamboPhase.FLYING
    flight.goal = HOME.position
    flight.step(40)
    assert flight.speed > 0.2
    before = {name: getattr(flight, name) for name in fault}
    vars(flight).update(fault)
    began = flight.time
    flight.until(lambda: flight.pilot.problem)
    assert flight.pilot.problem.startswith(reason) and not flight.pilot.has_pose
    # Without new commands, or with those to hover.
    flight.until(lambda: flight.firmware.flying_state in (FlyingState.HOVERING, FlyingState.LANDED))
    assert flight.time - began <= AT_MOST
    flight.until_it_is(FlyingState.LANDED)
    assert flight.time - began <= 10.0
    vars(flight).update(before)
    flight.step(100)
    assert flight.pilot.problem.startswith(f'landed: {reason}')
    assert flight.firmware.take_offs == 1
    assert flight.pilot.permit(flight.time) == ''
    flight.up()


def drift(flight):
    flight.firmware.body.position[0] += 0.05


STOPPED = f'landed: take-off stopped, {UNTIL_ARM}'


@pytest.mark.parametrize(
    ('phase', 'fault', 'text'),
    [
        (None, lambda flight: flight.pilot.end('the end'), f'landed: the end, {UNTIL_ARM}'),
        (
            None,
            lambda flight: setattr(flight.firmware.charge, 'charge', 0.08),
            f'battery at 8 %, below 10 %, {UNTIL_ARM}',
        ),
        (None, drift, f'outside the geofence, -0.4 to 2.5 m, {UNTIL_ARM}'),
        (None, lambda flight: flight.firmware.land(), f'by itself, {UNTIL_ARM}'),
        (None, lambda flight: flight.firmware.emergency(), 'emergency'),
        (MamboPhase.TAKING_OFF, lambda flight: flight.pilot.stop(flight.time), STOPPED),
        (MamboPhase.CLIMBING, lambda flight: flight.pilot.stop(flight.time), STOPPED),
    ],
)
def test_what_else_lands_it_and_keeps_it_down(phase, fault, text):
    flight = Flight()
    if phase is None:
        flight.flown()
    else:
        flight.until(lambda: flight.pilot.phase is phase)
        assert flight.where[2] < HOME.position[2] - 0.1
    began = flight.time
    flight.until(lambda: fault(flight) or flight.pilot.problem)
    assert fault is drift or flight.time - began <= AT_MOST
    assert flight.where[0] < FENCE[0, 1] + 0.5 + 0.4 * AT_MOST
    down = FlyingState.LANDED, FlyingState.EMERGENCY
    flight.until(lambda: flight.firmware.flying_state in down)
    flight.step(200)
    assert text in flight.pilot.problem
    assert flight.firmware.take_offs == 1


def test_a_cancelled_goal_stops_it_then_lands_it_and_another_one_takes_it_up():
    flight = Flight().flown()
    pilot, firmware = flight.pilot, flight.firmware
    flight.goal = None
    # Where it hovers, a position that stays the same to the bit is no fault.
    pilot.hover()
    flight.sent = 'stuck'
    flight.step(100)
    assert pilot.problem == ''
    flight.sent = 'true'
    flight.flown().goal = None
    # No number is no command: it hovers as after a cancelled goal.
    with pytest.raises(ValueError, match='finite'):
        pilot.fly(np.array([0.1, math.nan, 0.0, 0.0]))
    assert flight.until_it_is(FlyingState.HOVERING) <= AT_MOST
    # A new goal soon after a cancelled one keeps it up.
    pilot.goal_cancelled(flight.time)
    flight.step(20)
    pilot.on_new_goal()
    flight.step(200)
    assert pilot.phase is MamboPhase.FLYING
    flight.flown().goal = None
    pilot.goal_cancelled(flight.time)
    hovers = flight.until_it_is(FlyingState.HOVERING)
    assert hovers <= AT_MOST
    assert hovers + flight.until_it_is(FlyingState.LANDED) >= pilot.settings.cancel_landing
    flight.step(50)
    pilot.on_new_goal()
    flight.step(50)
    assert pilot.problem == f'on the ground, {UNTIL_ARM}' and firmware.take_offs == 1
    # On the ground it ends the permission.
    assert pilot.permit(flight.time) == ''
    pilot.goal_cancelled(flight.time)
    flight.step(50)
    assert firmware.take_offs == 1
    assert pilot.permit(flight.time) == ''
    flight.up()
    assert firmware.take_offs == 2


@pytest.mark.parametrize(
    ('ignored', 'text'),
    [
        ('take_off', 'no take-off within 5 s'),
        ('pilot', 'altitude not reached within 5 s'),
    ],
)
def test_a_take_off_that_takes_too_long_is_given_up(ignored, text):
    flight = Flight(take_off_timeout=5.0)
    flight.pilot.home = Pose.from_yaw([*HOME.position[:2], 1.6], HOME.yaw)
    setattr(flight.firmware, ignored, lambda *_: None)
    flight.until(lambda: text in flight.pilot.problem)
    flight.until_it_is(FlyingState.LANDED)
    flight.step(50)
    assert flight.pilot.phase is MamboPhase.GROUND and UNTIL_ARM in flight.pilot.problem


def test_a_permission_ends_with_the_link():
    flight = Flight(pose='pose')
    # No pose yet: it stands.
    flight.step(20)
    assert flight.pilot.phase is MamboPhase.GROUND
    flight.is_silent(60)
    for _ in range(100):
        flight.pilot.update_pose(flight.time, flight.firmware.state)
        flight.step()
    assert UNTIL_ARM in flight.pilot.problem and flight.firmware.take_offs == 0
    # Nor is there one while nothing is received from it.
    flight.is_silent(60)
    assert 'link lost' in flight.pilot.permit(flight.time)
    flight.connected = False
    other = MamboPilot(flight, flight.motion, flight.pilot.settings, HOME, flight.pilot.volume)
    assert other.permit(flight.time) == 'connecting to the Mambo'
