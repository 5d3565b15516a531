"""What the driver says to an autopilot, against a fake one, in simulated time."""

import math

import numpy as np
import pytest
from mavlink_play import FIRMWARES, HEIGHTS, Play, mavlink
from numpy.testing import assert_allclose
from pydantic import ValidationError

from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.links.mavlink import estimate
from maasi_drivers.links.mavlink.estimate import (
    FlightOrigin,
    swap_enu_ned,
    swap_flu_frd,
    swap_orientation,
    swap_yaw,
)
from maasi_drivers.links.mavlink.firmware import ARDUCOPTER, ARDUSUB, PX4_COPTER, identify
from maasi_drivers.links.mavlink.link import make_sender
from maasi_drivers.links.mavlink.protocol import ReportLog
from maasi_drivers.links.mavlink.vehicle import Phase
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.models.pose import Pose

# What the robot may take until it has stopped [s], and what counts as that [m/s].
AT_MOST, STOPPED = 1.5, 0.1
SPEED = 0.4
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
firmwares = pytest.mark.parametrize('firmware', FIRMWARES)


@pytest.mark.parametrize('yaw', [0.0, 0.3, 2.0, -3.0])
def test_north_east_down_is_east_north_up(yaw):
    assert_allclose(swap_enu_ned([1.0, 2.0, 3.0]), [2.0, 1.0, -3.0])
    assert_allclose(swap_flu_frd([1.0, 2.0, 3.0]), [1.0, -2.0, -3.0])
    assert swap_yaw(0.0) == pytest.approx(math.pi / 2)
    assert swap_yaw(swap_yaw(yaw)) == pytest.approx(yaw)
    half = 0.5 * yaw
    ned = np.array([math.cos(half), 0.0, 0.0, math.sin(half)])
    pose = Pose(np.zeros(3), swap_orientation(ned))
    # Forward, left and up of the body, in ENU.
    forward, left, up = pose.rotation().T
    assert_allclose(forward, swap_enu_ned([math.cos(yaw), math.sin(yaw), 0.0]), atol=1e-12)
    assert_allclose(left, swap_enu_ned([math.sin(yaw), -math.cos(yaw), 0.0]), atol=1e-12)
    assert_allclose(up, [0.0, 0.0, 1.0], atol=1e-12)
    assert_allclose(np.abs(swap_orientation(swap_orientation(ned)) @ ned), 1.0)


def test_a_heartbeat_tells_the_firmware():
    assert identify(3, 2) is ARDUCOPTER
    assert identify(3, 12) is ARDUSUB
    assert identify(12, 2) is PX4_COPTER
    with pytest.raises(ValueError, match='HEARTBEAT: read autopilot 3, type 10'):
        identify(3, 10)


@pytest.mark.parametrize(
    'changes, word',
    [
        ({'geofence': [[0, 1], [1, 0], [0, 1]]}, 'geofence'),
        ({'system': 240}, 'own_system'),
        ({'lead': math.nan}, 'lead'),
        ({'url': ''}, 'url'),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, word):
    with pytest.raises(ValidationError, match=word):
        MavlinkSettings.model_validate(changes)


@firmwares
def test_it_is_armed_rises_flies_to_a_target_and_stays_there(firmware):
    play = Play(firmware).fly()
    assert play.armed
    assert play.mode in ('GUIDED', 'OFFBOARD')
    play.run(4.0)
    assert play.position[2] == pytest.approx(HEIGHTS[firmware], abs=0.1)
    assert_allclose(play.position[:2], 0.0, atol=0.1)
    assert play.speed < STOPPED
    took_off = play.commands(mavlink.MAV_CMD_NAV_TAKEOFF)
    assert bool(took_off) == (firmware == 'arducopter')
    assert play.fault == ''
    target = np.array([1.0, -2.0, HEIGHTS[firmware] + 0.3])
    play.vehicle.set_target(target, -1.0)
    play.run(12.0)
    assert_allclose(play.position, target, atol=0.05)
    assert play.autopilot.body.yaw == pytest.approx(-1.0, abs=0.01)
    telemetry = play.estimate.telemetry
    assert_allclose(telemetry.position, target, atol=0.08)
    assert Pose(np.zeros(3), telemetry.orientation).yaw == pytest.approx(-1.0, abs=0.01)
    assert play.autopilot.crashed == ''
    # In flight a stop does not land it.
    play.vehicle.stop()
    play.run(2.0)
    assert play.vehicle.flying and play.mode in ('GUIDED', 'OFFBOARD')


NO_LINK_FAILSAFE = 'failsafe FS_GCS_ENABLE is 0, and require_failsafe is true'
OTHER_STATION = 'MAV_GCS_SYSID_HI is 255: any ground station with an id from'


@pytest.mark.parametrize(
    ('firmware', 'changes', 'parameters', 'text'),
    [
        *((firmware, {'arm': False}, {}, 'arm is false') for firmware in FIRMWARES),
        ('arducopter', {}, None, 'the driver is not active'),
        ('arducopter', {}, {'FS_GCS_ENABLE': 0}, NO_LINK_FAILSAFE),
        ('arducopter', {}, {'SYSID_MYGCS': 255}, 'SYSID_MYGCS is 255, mavlink.own_system is 240'),
        ('arducopter', {}, {'MAV_GCS_SYSID_HI': 255}, OTHER_STATION),
        # A failsafe that turns the motors off is none.
        ('px4', {}, {'COM_OBL_RC_ACT': 6}, 'failsafe COM_OBL_RC_ACT is 6, and require_failsafe is'),
        ('px4', {}, {'COM_OBL_RC_ACT': 7}, 'failsafe COM_OBL_RC_ACT is 7, and require_failsafe is'),
        ('ardusub', {}, {'FS_GCS_ENABLE': 2}, 'failsafe FS_GCS_ENABLE is 2, and require_failsafe'),
    ],
)
def test_nothing_is_armed(firmware, changes, parameters, text):
    play = Play(firmware, {'parameters': parameters or {}}, **changes)
    play.vehicle.active = parameters is not None
    play.run(10.0)
    assert play.phase is Phase.WAITING
    assert f'vehicle: not armed: {text}' in play.fault
    assert not play.commands(ARM) and not play.armed
    assert not play.commands(mavlink.MAV_CMD_DO_SET_MODE)
    assert not play.sent('SET_POSITION_TARGET_LOCAL_NED')
    for name, value in (parameters or {}).items():
        assert f'{name} is {value}' in play.said
        if 'failsafe' in text:
            assert f'{name} is {value}, which does not help' in play.said
    if text == NO_LINK_FAILSAFE:
        # A correction after the refusal does not take it off.
        assert UNTIL_ARM in play.fault
        for value in (5.0, 0.0):
            play.autopilot._sender.param_value_send(b'FS_GCS_ENABLE', value, 9, 1, 0)
            play.run(20.0)
            assert UNTIL_ARM in play.fault and not play.commands(ARM)
        assert NO_LINK_FAILSAFE in play.permit()
        play.autopilot._sender.param_value_send(b'FS_GCS_ENABLE', 5.0, 9, 1, 0)
        play.run(20.0)
        assert not play.commands(ARM)
        play.permitted().fly()


@pytest.mark.parametrize('stopped', [False, True])
def test_a_permission_that_is_not_used_or_stopped_ends(stopped):
    play = Play(autopilot={'charge': 0.01}, arm_timeout=10.0)
    play.run(8.0)
    assert play.phase is Phase.ARMING and not play.armed
    assert 'PreArm: Battery below minimum' in play.fault
    assert 'MAV_CMD_COMPONENT_ARM_DISARM: FAILED' in play.said
    if stopped:
        play.vehicle.forbid()
    else:
        play.run(6.0)
        assert 'not armed within 10 s (PreArm: Battery below minimum arming capacity' in play.said
    play.autopilot.charge = 1.0
    armed = len(play.commands(ARM))
    play.run(20.0)
    assert len(play.commands(ARM)) == armed and not play.armed
    assert play.fault == f'vehicle: not armed: {UNTIL_ARM}'


@pytest.mark.parametrize('component', [1, 190, 191])
def test_nothing_is_armed_while_another_program_has_the_id_of_the_driver(component):
    play = Play()
    play.station = (240, component)
    play.run(10.0)
    assert not play.commands(ARM)
    assert 'another program sends with system id 240' in play.fault
    play.station = None
    play.run(6.0)
    play.permitted().fly()
    # In the air it is reported: the failsafe would not act now.
    play.reports.clear()
    play.station = (240, component)
    play.run(2.0)
    assert 'another program sends with system id 240' in play.said


def test_two_drivers_of_one_vehicle_on_two_links_hear_each_other():
    senders = {make_sender(240).srcComponent for _ in range(200)}
    assert len(senders) > 20
    # No ground station, companion computer, camera or radio has one of them.
    assert senders <= set(range(25, 68))


@pytest.mark.parametrize(
    ('kind', 'values'),
    [('command_ack', (0, 0, 0, 0, 240, 190)), ('system_time', (0, 0))],
)
def test_the_id_of_the_driver_shows_in_other_messages_than_heartbeats(kind, values):
    """Behind a router that keeps programs apart, and on a link where heartbeats do not come."""
    play = Play()
    play.run(1.0)
    source = (1, 1) if kind == 'command_ack' else (240, 190)
    getattr(mavlink.MAVLink(play.to_driver, *source), f'{kind}_send')(*values)
    play.run(3.0)
    assert 'another program sends with system id 240' in play.fault
    assert not play.commands(ARM)


def test_a_ground_station_of_its_own_id_does_not_keep_the_failsafe_from_acting():
    play = Play().fly()
    play.station = (255, 190)
    play.go(SPEED)
    play.driver_lives = False
    play.run(AT_MOST + 8.0)
    assert play.autopilot.mode == play.autopilot.firmware.land


@pytest.mark.parametrize('drift', [-0.05, 0.05])
def test_a_barometer_that_drifts_before_arming_does_not_keep_it_at_its_take_off(drift):
    play = Play(autopilot={'barometer_drift': drift, 'estimator_time': 12.0})
    play.fly()
    assert abs(play.autopilot.height_error) > 0.55
    play.run(4.0)
    # Above the ground, whatever the barometer says.
    assert play.position[2] == pytest.approx(HEIGHTS['arducopter'], abs=0.1)
    assert play.estimate.origin[2] == pytest.approx(play.autopilot.height_error, abs=0.05)
    assert len(play.commands(mavlink.MAV_CMD_NAV_TAKEOFF)) == 1


def test_what_a_take_off_leaves_over_is_flown_by_set_point():
    play = Play()
    play.until(lambda: play.phase is Phase.ARMING)
    # Home is set by somebody else, half a metre lower than where it stands.
    play.until(lambda: play.armed)
    play.autopilot._home = -0.5
    play.fly()
    play.run(4.0)
    assert play.position[2] == pytest.approx(HEIGHTS['arducopter'], abs=0.1)


def test_a_vehicle_that_does_not_rise_lands_and_says_why():
    play = Play(rise_timeout=6.0)
    play.autopilot.body.climb = 0.0
    play.run(20.0)
    assert 'it came no nearer to its height in 6 s: at ' in play.fault
    assert 'm of 2.0 m' in play.fault
    assert not play.armed


def test_a_take_off_that_was_accepted_is_not_asked_for_again():
    play = Play(rise_timeout=20.0)
    play.autopilot.body.climb = 0.03
    play.until(lambda: play.phase is Phase.RISING)
    play.run(8.0)
    assert len(play.commands(mavlink.MAV_CMD_NAV_TAKEOFF)) == 1
    assert 'MAV_CMD_NAV_TAKEOFF' not in play.said


def test_a_mode_that_was_changed_before_arming_and_is_back_lets_it_go_on():
    play = Play(autopilot={'charge': 0.01})
    play.until(lambda: play.phase is Phase.ARMING)
    play.autopilot.take_mode('LOITER')
    play.run(3.0)
    assert play.phase is Phase.RELEASED
    play.autopilot.charge = 1.0
    play.autopilot.take_mode('GUIDED')
    play.run(10.0)
    assert 'GUIDED is back' in play.said
    assert play.fault == f'vehicle: not armed: {UNTIL_ARM}'
    play.permitted().fly()


@pytest.mark.parametrize(
    ('second_gnss', 'lost', 'muted', 'text'),
    [
        (False, False, 'EKF_STATUS_REPORT', 'no EKF_STATUS_REPORT any more'),
        (False, False, 'GPS_RAW_INT', 'GNSS is lost (no GPS_RAW_INT any more)'),
        (False, True, '', 'GNSS is lost (GPS_RAW_INT.fix_type 1)'),
        (True, True, 'GPS2_RAW', 'GNSS is lost (GPS_RAW_INT.fix_type 1, no GPS2_RAW any more)'),
    ],
)
def test_the_loss_of_position_or_its_status_is_seen_in_flight(second_gnss, lost, muted, text):
    play = Play(autopilot={'second_gnss': second_gnss}).fly().go(SPEED)
    if lost:
        play.autopilot.gnss_lost_at = play.autopilot.now
    if second_gnss:
        # One of two receivers is enough.
        play.run(12.0)
        assert play.fault == ''
    play.autopilot.muted = {muted}
    if muted:
        play.run(2.5)
        assert play.fault == ''
    play.run(1.5)
    assert play.fault == f'vehicle: {text}'
    play.autopilot.muted = set()
    play.run(9.0)
    estimate_lost = 'vehicle: the autopilot has lost its position estimate'
    assert play.fault == (estimate_lost if lost and not second_gnss else '')


def test_a_status_that_another_program_turned_off_is_asked_for_again():
    play = Play().fly()
    play.autopilot.periods['EKF_STATUS_REPORT'] = math.inf
    play.run(10.0)
    assert play.fault == ''
    assert math.isfinite(play.autopilot.periods['EKF_STATUS_REPORT'])


def test_an_autopilot_that_restarts_before_it_is_armed_is_asked_anew():
    play = Play(permitted=False, origin='here')
    play.run(10.0)
    play.autopilot.restart()
    play.driver_lives = False
    play.run(3.0)
    # It is carried once its EKF has an origin.
    play.autopilot.body.position[:2] = [3.0, 4.0]
    play.driver_lives = True
    play.autopilot.parameters['FS_GCS_ENABLE'] = 0.0
    play.run(12.0)
    assert 'the autopilot has restarted' in play.said
    # Messages, parameters and origin are those of the new start.
    assert 'FS_GCS_ENABLE is 0' in play.fault
    assert_allclose(play.estimate.origin[:2], [3.0, 4.0], atol=0.05)
    play.autopilot.parameters['FS_GCS_ENABLE'] = 5.0
    play.autopilot.restart()
    play.run(12.0)
    play.permitted().fly()


@firmwares
def test_nothing_takes_off_before_the_service_is_called(firmware):
    play = Play(firmware, permitted=False)
    play.run(20.0)
    assert play.fault == f'vehicle: not armed: {UNTIL_ARM}'
    assert not play.commands(ARM)
    assert not play.commands(mavlink.MAV_CMD_DO_SET_MODE)
    play.permitted().fly()
    # One call is for one take-off.
    play.vehicle.finish('land')
    play.run(20.0)
    if firmware == 'ardusub':
        play.autopilot.disarm('Disarming motors')
        play.run(2.0)
    assert UNTIL_ARM in play.fault
    assert not play.armed
    play.permitted().fly()


def test_a_driver_restarted_while_its_vehicle_lands_does_not_take_off_again():
    play = Play().fly()
    play.driver_lives = False
    play.run(7.0)
    assert play.mode == 'LAND'
    play.restart_driver()
    play.run(2.0)
    assert play.armed
    assert 'it is flown in LAND' in play.permit()
    play.run(20.0)
    assert not play.armed
    assert play.mode == 'LAND'
    assert play.fault == f'vehicle: not armed: {UNTIL_ARM}'
    assert not play.commands(ARM)[1:]
    play.permitted().fly()


def test_a_driver_restarted_in_the_air_sends_it_nowhere_before_it_may():
    play = Play().fly().go(SPEED)
    play.restart_driver()
    play.run(6.0)
    sent = len(play.sent('SET_POSITION_TARGET_LOCAL_NED'))
    here = play.position.copy()
    for _ in range(200):
        play.lead(SPEED)
        play.turn()
    assert len(play.sent('SET_POSITION_TARGET_LOCAL_NED')) == sent
    assert_allclose(play.position, here, atol=0.05)
    assert 'not by this driver' in play.fault
    assert play.vehicle.in_air
    # Its end is not the end of what others fly.
    play.vehicle.finish('land')
    play.run(2.0)
    assert play.mode == 'GUIDED'
    play.permitted().fly()


def far_away(memory, origin):
    """Return a vehicle in the air, away from its start and from the origin of its local frame."""
    play = Play(memory=memory, origin=origin, autopilot={'barometer_drift': -0.1})
    play.driver_lives = False
    play.run(3.0)
    play.autopilot.body.position[:2] = [3.0, 4.0]
    play.driver_lives = True
    play.fly().go(SPEED)
    play.run(3.0)
    return play


@pytest.mark.parametrize('origin', ['here', 'local'])
@pytest.mark.parametrize('landed', [False, True])
def test_a_restarted_driver_has_the_map_and_the_heights_of_before(tmp_path, origin, landed):
    play = far_away(tmp_path / 'new' / 'origin.json', origin)
    before = play.estimate.origin
    assert before[2] < -0.2
    if landed:
        play.vehicle.finish('land')
        play.until(lambda: play.phase is Phase.STOPPED)
    play.restart_driver()
    play.run(6.0)
    assert_allclose(play.estimate.origin, before, atol=1e-6)
    assert 'the origin of the flight before is kept' in play.said
    play.permitted().fly()
    assert_allclose(play.estimate.origin[:2], before[:2], atol=1e-6)


def test_a_driver_that_finds_its_vehicle_in_the_air_does_not_guess_where_it_is():
    play = far_away(None, 'here')
    play.restart_driver()
    play.run(6.0)
    assert 'its place in the map is not known' in play.fault
    assert 'its place in the map is not known' in play.permit()
    assert play.estimate.telemetry is None
    # After a landing it is not at its start either.
    play.autopilot.take_mode('LAND')
    play.until(lambda: not play.armed)
    play.run(3.0)
    assert 'its place in the map is not known' in play.permit()


@pytest.mark.parametrize('change', ['autopilot', 'start', 'ground', 'broken', 'host'])
def test_an_origin_of_another_time_or_map_is_not_used(tmp_path, change, monkeypatch):
    path, start, booted = tmp_path / 'origin.json', [1.0, 2.0, 3.0], 50.0
    settings, log = MavlinkSettings(origin='here'), ReportLog()
    FlightOrigin(settings, start, path, log).keep(np.array([4.0, 5.0, 6.0]), booted)
    here = np.array([7.0, 8.0, 9.0])
    found = FlightOrigin(settings, start, path, log).find(here, booted + 1.0, True)
    assert_allclose(found, [4.0, 5.0, 6.0])
    if change == 'autopilot':
        booted += 60.0
    elif change == 'start':
        start = [1.0, 2.5, 3.0]
    elif change == 'ground':
        settings = MavlinkSettings(origin='here', ground=0.5)
    elif change == 'host':
        monkeypatch.setattr(estimate, '_host_boot', lambda: 'another')
    else:
        path.write_text(path.read_text()[:-9])
    assert FlightOrigin(settings, start, path, log).find(here, booted, True) is None
    assert_allclose(FlightOrigin(settings, start, path, log).find(here, booted, False), here)


@pytest.mark.parametrize('share', [0.2, 0.7])
@firmwares
def test_a_stop_ends_a_take_off(firmware, share):
    play = Play(firmware)
    height = HEIGHTS[firmware]
    play.until(lambda: abs(play.position[2]) > share * abs(height))
    assert play.phase is Phase.RISING
    play.vehicle.stop()
    farthest = 0.0
    for _ in range(1000):
        play.turn()
        farthest = max(farthest, abs(play.position[2]))
    assert farthest < (share + 0.3) * abs(height)
    assert play.mode in ('LAND', 'AUTO.LAND', 'SURFACE')
    assert 'its take-off was stopped' in play.fault
    assert play.position[2] == pytest.approx(0.0, abs=0.1)
    assert play.armed == (firmware == 'ardusub')


def test_a_permission_needs_a_vehicle_that_is_heard_and_ends_with_the_link():
    play = Play(permitted=False, autopilot={'estimator_time': 20.0})
    play.to_driver.cut = True
    play.run(5.0)
    assert play.permit() == 'vehicle: nothing heard yet'
    play.to_driver.cut = False
    play.run(3.0)
    assert play.permit() == ''
    play.to_driver.cut = True
    play.run(2.0)
    play.to_driver.cut = False
    play.run(25.0)
    assert play.fault == f'vehicle: not armed: {UNTIL_ARM}'
    assert not play.commands(ARM)
    play.to_driver.cut = True
    play.run(2.0)
    assert 'nothing heard' in play.permit()


def test_two_batteries_are_two():
    play = Play(autopilot={'charge': 0.8, 'more_batteries': [0.05]})
    seen = set()
    for _ in range(500):
        play.turn()
        seen.add(round(play.estimate.charge, 2))
    assert seen - {-1.0} <= {0.05, 0.8}
    assert play.estimate.charge == pytest.approx(0.05)
    first = Play(autopilot={'charge': 0.8, 'more_batteries': [0.05]}, battery=0)
    first.run(5.0)
    assert first.vehicle.estimate.charge == pytest.approx(0.8)


def test_before_the_estimate_nothing_is_asked_for():
    # Nor need there be a failsafe for the link where it is not required.
    settings = {'estimator_time': 15.0, 'parameters': {'FS_GCS_ENABLE': 0}}
    play = Play(autopilot=settings, require_failsafe=False)
    play.run(14.0)
    assert 'no position estimate yet' in play.fault
    assert not play.commands(ARM)
    play.fly()


@pytest.mark.parametrize('kind', [{'vehicle': 'submarine'}, {'vehicle': 'copter', 'system': 7}])
def test_vehicles_of_another_kind_or_id_are_left_alone(kind):
    play = Play(**kind)
    play.run(8.0)
    assert not play.armed
    assert not play.sent('COMMAND_LONG')
    assert ('is left alone' in play.fault) == ('system' not in kind)


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_targets_that_are_not_finite_are_refused(bad):
    play = Play().fly()
    with pytest.raises(ValueError, match='setpoint: got'):
        play.vehicle.set_target([0.0, bad, 2.0], 0.0)
    with pytest.raises(ValueError, match='setpoint: got'):
        play.vehicle.set_target([0.0, 0.0, 2.0], bad)
    play.run(2.0)
    assert play.autopilot.crashed == ''
    # The fake would crash, as an ArduPilot did.
    sender = mavlink.MAVLink(play.to_autopilot, 240, 190)
    sender.set_position_target_local_ned_send(0, 1, 1, 1, 0x9F8, bad, *[0.0] * 10)
    play.run(1.0)
    assert 'not finite' in play.autopilot.crashed and 'floating point exception' in play.said


@firmwares
def test_a_dead_driver_leaves_a_vehicle_that_stops(firmware):
    play = Play(firmware).fly().go(SPEED)
    before = play.position.copy()
    assert play.speed > 0.7 * SPEED
    play.driver_lives = False
    play.run(AT_MOST)
    assert play.speed < STOPPED or play.autopilot.mode == play.autopilot.firmware.land
    assert np.linalg.norm((play.position - before)[:2]) <= SPEED + 0.05
    # The autopilot's own failsafe ends it.
    play.run(8.0)
    assert play.autopilot.mode == play.autopilot.firmware.land


@firmwares
def test_with_a_cut_link_it_stops_and_the_driver_says_so(firmware):
    play = Play(firmware).fly().go(SPEED)
    play.cut()
    play.run(AT_MOST)
    assert play.level_speed < STOPPED
    assert play.fault == 'link: nothing heard from system 1'
    assert not play.vehicle.flying
    assert 'link: nothing heard for 0.6 s' in play.said
    if firmware == 'arducopter':
        # It holds where it is once the link is back; the others have landed or surfaced.
        play.to_driver.cut = play.to_autopilot.cut = False
        play.run(1.0)
        assert play.vehicle.flying and 'link: it is back' in play.said
        play.run(2.0)
        assert play.speed < STOPPED


def test_a_position_that_is_frozen_or_not_finite_is_no_news():
    play = Play().fly()
    play.autopilot.freeze()
    play.run(0.2)
    last = play.estimate.telemetry
    play.run(AT_MOST)
    assert play.estimate.telemetry is last
    assert play.estimate.dropped['LOCAL_POSITION_NED that is frozen'] > 10
    play.autopilot.frozen = (math.nan, *[0.0] * 5)
    play.run(1.0)
    assert play.estimate.telemetry is last
    assert play.estimate.dropped['LOCAL_POSITION_NED that is not finite'] > 10


@firmwares
def test_when_the_pilot_takes_the_mode_the_driver_lets_go(firmware):
    play = Play(firmware).fly().go(SPEED)
    play.autopilot.take_mode({'px4': 'POSCTL'}.get(firmware, 'ALT_HOLD'))
    play.run(AT_MOST)
    assert 'the pilot has taken over: mode' in play.fault
    assert 'the driver lets go' in play.said
    sent = len(play.to_autopilot.messages)
    for _ in range(200):
        play.lead(SPEED)
        play.turn()
    # Heartbeats go on, as the autopilot would miss them; nothing else does.
    kinds = {item.get_type() for item in play.to_autopilot.messages[sent:]}
    assert kinds == {'HEARTBEAT'}
    # The end of the driver is no reason to take it back.
    play.vehicle.finish('land')
    assert play.vehicle.at_rest
    play.run(1.0)
    assert play.mode in ('POSCTL', 'ALT_HOLD')


def test_a_pilot_can_take_the_mode_in_a_take_off():
    play = Play()
    play.until(lambda: play.phase is Phase.RISING)
    play.autopilot.take_mode('LOITER')
    play.run(2.0)
    assert play.phase is Phase.RELEASED and play.mode == 'LOITER'


def test_a_pilot_can_give_the_mode_back():
    play = Play().fly().go(SPEED)
    play.autopilot.take_mode('LOITER')
    play.run(2.0)
    here = play.position.copy()
    play.autopilot.take_mode('GUIDED')
    play.run(3.0)
    assert play.vehicle.flying
    assert 'the pilot gives GUIDED back' in play.said
    assert_allclose(play.position, here, atol=0.15)


@firmwares
@pytest.mark.parametrize('ending', ['hold', 'land'])
def test_the_end_is_to_hold_or_to_land(firmware, ending):
    play = Play(firmware).fly().go(SPEED)
    play.vehicle.finish(ending)
    play.run(AT_MOST)
    assert play.vehicle.at_rest
    assert play.level_speed < STOPPED
    fake = play.autopilot
    assert fake.mode == (fake.firmware.land if ending == 'land' else fake.firmware.hold)
    play.run(8.0)
    if ending == 'land':
        assert fake.body.position[2] == pytest.approx(0.0, abs=0.05)
    else:
        assert fake.armed
        assert play.speed < 0.02


def test_a_vehicle_that_is_disarmed_in_the_air_is_left_alone():
    play = Play().fly().go(SPEED)
    play.autopilot.disarm('Crash: Disarming')
    play.run(AT_MOST)
    assert play.phase is Phase.STOPPED
    assert 'by the autopilot or the pilot (Crash: Disarming)' in play.fault
    assert 'disarmed by the autopilot or the pilot (Crash: Disarming)' in play.said
    armed = len(play.commands(ARM))
    play.run(10.0)
    assert len(play.commands(ARM)) == armed


def test_a_copter_that_the_pilot_has_in_the_air_is_taken_over_without_arming():
    play = Play().fly()
    other = Play(arm=False, permitted=False)
    other.autopilot.armed = True
    other.autopilot.body.position = play.position.copy()
    other.autopilot.take_mode('GUIDED')
    other.run(6.0)
    assert 'it is armed in GUIDED, not by this driver' in other.vehicle.fault
    assert not other.sent('SET_POSITION_TARGET_LOCAL_NED')
    assert other.permit() == ''
    other.run(0.5)
    assert other.vehicle.flying
    assert not other.commands(ARM)


def test_commands_that_are_lost_are_said_again():
    play = Play()
    lossy = np.random.default_rng(5)
    write = play.to_autopilot.write
    play.to_autopilot.write = lambda data: write(data) if lossy.random() > 0.4 else None
    play.fly()
    assert play.armed
