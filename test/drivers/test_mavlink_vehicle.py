"""What the driver says to an autopilot, against a fake one, in simulated time."""

import math
from functools import partial

import numpy as np
import pytest
from mavlink_play import (
    ARM,
    AT_MOST,
    HEIGHTS,
    NOT_ARMED,
    PERIOD,
    TAKE_OFF,
    Play,
    RoutingAutopilot,
    mavlink,
)
from numpy.testing import assert_allclose

from maasi_drivers.links.mavlink.firmware import identify
from maasi_drivers.links.mavlink.link import make_sender
from maasi_drivers.links.mavlink.phases import VehiclePhase
from maasi_filter.models.pose import Pose

# What counts as stopped [m/s].
STOPPED = 0.1
MODE = mavlink.MAV_CMD_DO_SET_MODE
SETPOINT = 'SET_POSITION_TARGET_LOCAL_NED'
firmwares = pytest.mark.parametrize('firmware', HEIGHTS)


@firmwares
def test_it_is_armed_rises_flies_to_a_target_and_stays_there(firmware):
    play = Play(firmware, permitted=False)
    play.run(10.0)
    assert play.fault == NOT_ARMED and not play.commands(ARM) and not play.commands(MODE)
    play.permitted().fly()
    # Where nobody turns it, it keeps its heading.
    assert play.body.yaw == pytest.approx(0.3)
    assert bool(play.commands(TAKE_OFF)) == (firmware == 'arducopter')
    target = np.array([1.0, -2.0, play.height + 0.3])
    play.vehicle.set_target(target, -1.0)
    play.run(12.0)
    assert_allclose(play.body.position, target, atol=0.05)
    assert play.body.yaw == pytest.approx(-1.0, abs=0.01)
    telemetry = play.vehicle.estimate.telemetry
    assert_allclose(telemetry.position, target, atol=0.08)
    assert Pose(np.zeros(3), telemetry.orientation).yaw == pytest.approx(-1.0, abs=0.01)
    # In flight a stop does not land it.
    play.vehicle.stop()
    play.run(2.0)
    assert play.vehicle.flying and play.mode in ('GUIDED', 'OFFBOARD') and play.fault == ''
    # One call of the service is for one take-off.
    play.vehicle.finish('land')
    play.run(20.0)
    assert len(play.commands(ARM)) == 1 and play.phase is not VehiclePhase.FLYING


NO_LINK_FAILSAFE = 'failsafe FS_GCS_ENABLE is 0, and require_failsafe is true'
OTHER_PROGRAM = 'another program uses system id 240'
OTHER_STATION = 'MAV_GCS_SYSID_HI is 255: any ground station with an id from'


@pytest.mark.parametrize(
    ('firmware', 'changes', 'parameters', 'text'),
    [
        *((firmware, {'arm': False}, {}, 'arm is false') for firmware in HEIGHTS),
        ('arducopter', {}, None, 'the driver is not active'),
        ('arducopter', {}, {'FS_GCS_ENABLE': 0}, NO_LINK_FAILSAFE),
        ('arducopter', {}, {'SYSID_MYGCS': 255}, 'SYSID_MYGCS is 255, mavlink.own_system is 240'),
        ('arducopter', {}, {'MAV_GCS_SYSID_HI': 255}, OTHER_STATION),
        # A failsafe that turns the motors off is none.
        ('px4', {}, {'COM_OBL_RC_ACT': 6}, 'failsafe COM_OBL_RC_ACT is 6, and require_failsafe is'),
        ('px4', {}, {'COM_OBL_RC_ACT': 7}, 'failsafe COM_OBL_RC_ACT is 7, and require_failsafe is'),
        ('ardusub', {}, {'FS_GCS_ENABLE': 2}, 'failsafe FS_GCS_ENABLE is 2, and require_failsafe'),
        ('arducopter', {'vehicle': 'submarine'}, {}, 'released'),
        ('arducopter', {'system': 7}, {}, 'no heartbeat yet'),
    ],
)
def test_nothing_is_armed(firmware, changes, parameters, text):
    play = Play(firmware, {'parameters': parameters or {}}, **changes)
    play.vehicle.active = parameters is not None
    play.run(10.0)
    waits = play.phase is VehiclePhase.WAITING
    assert f'vehicle: {"not armed: " * waits}{text}' in play.fault
    # Whether it is asked for messages.
    assert bool(play.sent('COMMAND_LONG')) == waits
    assert not play.commands(ARM) and not play.commands(MODE) and not play.sent(SETPOINT)
    for name, value in (parameters or {}).items():
        assert (
            f'{name} is {value}{", which does not stop the vehicle" * ("failsafe" in text)}'
            in play.said
        )
    if text == NO_LINK_FAILSAFE:
        assert NO_LINK_FAILSAFE in play.permit()
        # A correction after the refusal does not take it off.
        play.autopilot._sender.param_value_send(b'FS_GCS_ENABLE', 5.0, 9, 1, 0)
        play.stands(20.0)


@pytest.mark.parametrize('end', ['', 'forbid', 'finish'])
def test_a_permission_that_is_not_used_or_stopped_ends(end):
    play = Play(autopilot={'charge': 0.01}, arm_timeout=10.0)
    play.run(8.0)
    assert play.phase is VehiclePhase.ARMING and 'PreArm: Battery below minimum' in play.fault
    assert 'MAV_CMD_COMPONENT_ARM_DISARM: FAILED' in play.said
    if end:
        getattr(play.vehicle, end)(*['land'] * (end == 'finish'))
    else:
        play.run(6.0)
        assert 'not armed within 10 s (PreArm: Battery below minimum arming capacity' in play.said
    play.autopilot.charge = 1.0
    play.stands(20.0)


def sends(play, kind, source, values):
    getattr(mavlink.MAVLink(play.to_driver, *source), f'{kind}_send')(*values)


@pytest.mark.parametrize(
    'stranger',
    [
        *(partial(Play.beat, system=240, component=component) for component in (1, 190)),
        # Behind a router that keeps programs apart, and on a link without heartbeats.
        partial(sends, kind='command_ack', source=(1, 1), values=(0, 0, 0, 0, 240, 190)),
        partial(sends, kind='system_time', source=(240, 190), values=(0, 0)),
    ],
)
def test_nothing_is_armed_while_another_program_has_the_id_of_the_driver(stranger):
    play = Play()
    play.stranger = partial(stranger, play)
    play.run(10.0)
    assert OTHER_PROGRAM in play.fault and not play.commands(ARM)
    play.stranger = lambda: None
    play.stands(6.0)
    play.reports.clear()
    # An answer to its own commands is not one to another program.
    own = play.vehicle._sender.srcComponent
    sends(play, 'command_ack', (1, 1), (0, 0, 0, 0, 240, own))
    play.run(2.0)
    assert OTHER_PROGRAM not in play.said
    # In the air it is reported: the failsafe would not act now.
    play.stranger = partial(stranger, play)
    play.run(2.0)
    assert OTHER_PROGRAM in play.said
    # Two drivers differ, also from ground stations, companion computers, cameras and radios.
    senders = {make_sender(240).srcComponent for _ in range(200)}
    assert len(senders) > 20 and senders <= set(range(25, 68))


@pytest.mark.parametrize('phase', [VehiclePhase.ARMING, VehiclePhase.RISING])
def test_a_mode_that_was_changed_before_arming_and_is_back_lets_it_go_on(phase):
    play = Play(autopilot={'charge': 0.01 if phase is VehiclePhase.ARMING else 1.0})
    play.until(lambda: play.phase is phase)
    play.autopilot.set_mode('LOITER')
    play.run(3.0)
    assert play.phase is VehiclePhase.RELEASED and play.mode == 'LOITER'
    if phase is VehiclePhase.RISING:
        return
    play.autopilot.charge = 1.0
    play.autopilot.set_mode('GUIDED')
    play.stands(10.0)
    assert 'GUIDED is back' in play.said


def test_an_autopilot_that_restarts_before_it_is_armed_is_asked_anew():
    play = Play(permitted=False, origin='here')
    play.run(10.0)
    play.autopilot.restart()
    # It is carried once its EKF has an origin.
    play.without_driver(3.0, position=[3.0, 4.0])
    play.autopilot.parameters['FS_GCS_ENABLE'] = 0.0
    play.run(12.0)
    assert 'the autopilot has restarted' in play.said
    # Messages, parameters and origin are those of the new start.
    assert 'FS_GCS_ENABLE is 0' in play.fault
    assert_allclose(play.vehicle.estimate.origin[:2], [3.0, 4.0], atol=0.05)
    play.autopilot.parameters['FS_GCS_ENABLE'] = 5.0
    play.autopilot.restart()
    play.run(2.0)
    # A permission is for the autopilot from which data was received.
    play.permitted().autopilot.restart()
    play.stands(12.0)


def disarmed(play):
    """The pilot disarms it; the answer to the request to arm it was lost."""
    play.autopilot._sender.command_ack_send = lambda *_: None
    play.until(lambda: play.phase is VehiclePhase.RISING)
    play.autopilot.disarm('Disarming motors')


@pytest.mark.parametrize('begun', [0.0, 10.0])
def test_two_autopilots_with_one_id_are_named_once_and_not_flown(begun):
    play = Play(permitted=False)
    play.run(begun)
    other = twin(play)
    for _ in range(25):
        play.run(1.0, before=other)
    said = [text for _, text in play.reports if text.startswith('several autopilots answer')]
    assert len(said) == 1 and 'as system 1' in said[0] and 'SYSID_THISMAV' in said[0]
    assert sum('has restarted' in text for _, text in play.reports) <= 2
    assert play.permit() == f'{said[0]}: restart the driver' and said[0] in play.fault
    assert not play.autopilot.armed and not play.commands(ARM)


def twin(play):
    """Add an autopilot with the same ID that has been running longer; return its turn."""
    other = RoutingAutopilot(
        play.autopilot.settings,
        mavlink.MAVLink(play.to_driver, 1, 1),
        0.3,
        np.random.default_rng(2),
    )
    other.advance(30.0)
    first = play.autopilot.handle
    play.autopilot.handle = lambda message: (first(message), other.handle(message))
    return lambda: other.advance(PERIOD)


RESTARTED = 'the autopilot has restarted: restart the driver'


@pytest.mark.parametrize(
    ('fault', 'words', 'answer'),
    [
        (lambda play: setattr(play.body, 'climb', 0.0), 'no climb for 6 s', ''),
        (disarmed, 'disarmed: by the autopilot or the pilot (Disarming motors)', ''),
        (lambda play: play.fly().go().autopilot.restart(), f'disarmed: {RESTARTED}', RESTARTED),
    ],
)
def test_what_ends_a_flight_and_keeps_it_down(fault, words, answer):
    play = Play(rise_timeout=6.0)
    fault(play)
    play.run(20.0)
    assert words in play.fault.replace('Arming motors; ', '')
    assert ('m of 2 m' in play.fault) == ('climb' in words)
    assert play.phase is VehiclePhase.STOPPED and not play.autopilot.armed
    assert play.permit() == answer


def test_a_driver_restarted_while_its_vehicle_lands_does_not_take_off_again():
    play = Play().fly()
    play.without_driver(7.0)
    play.start_driver()
    play.run(2.0)
    assert 'it is flying in LAND' in play.permit()
    play.stands(20.0)


def test_a_driver_restarted_in_the_air_sends_it_nowhere_before_it_may():
    play = Play().fly().go()
    play.start_driver()
    play.run(6.0)
    sent, here = len(play.sent(SETPOINT)), play.body.position.copy()
    play.run(4.0, play.lead)
    assert len(play.sent(SETPOINT)) == sent
    assert_allclose(play.body.position, here, atol=0.05)
    assert 'by another program' in play.fault and play.vehicle.in_air
    # Its end is not the end of what others fly.
    play.vehicle.finish('land')
    play.run(2.0)
    assert play.mode == 'GUIDED'
    play.permitted().fly()


@firmwares
def test_a_stop_before_it_is_armed_keeps_it_where_it_is(firmware):
    play = Play(firmware)
    play.until(lambda: play.phase is VehiclePhase.STARTING).vehicle.stop()
    play.stands(20.0)


@pytest.mark.parametrize('share', [0.2, 0.7])
@firmwares
def test_a_stop_ends_a_take_off(firmware, share):
    play = Play(firmware)
    height = abs(play.height)
    play.until(lambda: abs(play.body.position[2]) > share * height)
    assert play.phase is VehiclePhase.RISING
    play.vehicle.stop()
    heights = []
    play.run(20.0, lambda: heights.append(abs(play.body.position[2])))
    assert max(heights) < (share + 0.3) * height
    assert heights[-1] == pytest.approx(0.0, abs=0.1)
    assert play.mode in ('LAND', 'SURFACE')
    assert 'take-off stopped' in play.fault
    assert play.autopilot.armed == (firmware == 'ardusub')


def test_a_permission_needs_a_vehicle_that_is_heard_and_ends_with_the_link():
    # Nor need there be a failsafe for the link where it is not required.
    settings = {'estimator_time': 20.0, 'parameters': {'FS_GCS_ENABLE': 0}}
    play = Play(permitted=False, autopilot=settings, require_failsafe=False).unheard(5.0)
    assert play.permit() == 'vehicle: no heartbeat yet'
    play.run(3.0)
    assert play.permit() == '' and 'no position estimate yet' in play.fault
    play.unheard(2.0).stands(25.0)
    play.vehicle.finish('land')
    play.until(lambda: not play.autopilot.armed).unheard(2.0)
    assert 'no message' in play.permit()


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ValueError, match='HEARTBEAT: read autopilot 3, type 10'):
        identify(3, 10)
    play = Play().fly()
    for position, yaw in (([0.0, math.inf, 2.0], 0.0), ([0.0, 0.0, 2.0], math.nan)):
        with pytest.raises(ValueError, match='setpoint: got'):
            play.vehicle.set_target(position, yaw)


@firmwares
@pytest.mark.parametrize('lives', [False, True])
def test_a_dead_driver_leaves_a_vehicle_that_stops(firmware, lives):
    """And so does one whose link is cut."""
    play = Play(firmware).fly().go()
    before = play.body.position.copy()
    assert play.speed > 0.28
    play.driver_lives, play.to_driver.cut, play.to_autopilot.cut = lives, lives, lives
    # That of another ground station does not keep the failsafe from acting.
    play.stranger = partial(play.beat, 255, 190)
    play.run(AT_MOST)
    assert play.speed < STOPPED or play.autopilot.mode == play.autopilot.firmware.land
    assert np.linalg.norm((play.body.position - before)[:2]) <= 0.45
    if lives:
        assert play.fault == 'link: no message from system 1' and not play.vehicle.flying
        assert 'link lost: no message for 0.6 s' in play.said
    play.run(8.0)
    assert play.autopilot.mode == play.autopilot.firmware.land


PILOT = {'arducopter': 'ALT_HOLD', 'px4': 'POSCTL', 'ardusub': 'ALT_HOLD'}


@firmwares
def test_when_the_pilot_takes_the_mode_the_driver_lets_go(firmware):
    play = Play(firmware).fly().go()
    play.autopilot.set_mode(PILOT[firmware])
    play.run(AT_MOST)
    assert 'the pilot has taken over: mode' in play.fault
    assert 'the driver releases the vehicle' in play.said
    sent = len(play.to_autopilot.messages)
    play.run(4.0, play.lead)
    # Heartbeats go on, as the autopilot would miss them; nothing else does.
    assert {item.get_type() for item in play.to_autopilot.messages[sent:]} == {'HEARTBEAT'}
    # The end of the driver is no reason to take it back.
    play.vehicle.finish('land')
    assert play.vehicle.at_rest
    play.run(1.0)
    assert play.mode == PILOT[firmware]
    # The pilot gives it back: it stays where it is; PX4 is not taken back.
    here = play.body.position.copy()
    # Without set-points it would leave OFFBOARD before a heartbeat shows it.
    play.autopilot.parameters['COM_OF_LOSS_T'] = 60.0
    play.autopilot.set_mode('OFFBOARD' if firmware == 'px4' else 'GUIDED')
    play.run(3.0)
    back = firmware != 'px4'
    assert play.vehicle.flying == ('the pilot returned control in GUIDED' in play.said) == back
    assert not back or np.linalg.norm(play.body.position - here) < 0.15


@firmwares
@pytest.mark.parametrize('ending', ['hold', 'land'])
def test_the_end_is_to_hold_or_to_land(firmware, ending):
    play = Play(firmware).fly().go()
    play.vehicle.finish(ending)
    play.run(AT_MOST)
    assert play.vehicle.at_rest and play.speed < STOPPED
    assert play.autopilot.mode == getattr(play.autopilot.firmware, ending)
    play.run(8.0)
    height = 0.0 if ending == 'land' else play.height
    assert play.body.position[2] == pytest.approx(height, abs=0.2)


@firmwares
@pytest.mark.parametrize('answered', [True, False])
def test_a_pilot_who_takes_the_mode_while_it_is_told_to_land_has_it(firmware, answered):
    play = Play(firmware).fly()
    play.vehicle.finish('land')
    land = play.autopilot.firmware.land
    if not answered:
        play.autopilot._sender.command_ack_send = lambda *_: None
    play.until(lambda: play.autopilot.mode == land)
    if answered:
        play.turn()  # before a heartbeat has shown that it lands
    else:
        play.until(lambda: play.vehicle.at_rest)
    asked = len(play.commands(MODE))
    play.autopilot.set_mode(PILOT[firmware])
    play.run(3.0)
    assert play.phase is VehiclePhase.RELEASED and play.mode == PILOT[firmware]
    assert len(play.commands(MODE)) == asked


def test_an_accepted_landing_that_a_heartbeat_denies_is_asked_for_again():
    play = Play().fly()
    play.vehicle.finish('land')
    play.until(lambda: play.mode == 'LAND').turn()
    play.autopilot.set_mode('GUIDED')
    play.run(3.0)
    assert play.mode == 'LAND'


def test_commands_that_are_lost_are_said_again():
    play = Play()
    lossy = np.random.default_rng(5)
    write = play.to_autopilot.write
    play.to_autopilot.write = lambda data: write(data) if lossy.random() > 0.4 else None
    play.fly()
