"""What the driver knows of a vehicle: frames, its position in the map, its battery."""

import math

import numpy as np
import pytest
from mavlink_play import AT_MOST, TAKE_OFF, Play
from numpy.testing import assert_allclose

from maasi_drivers.links.mavlink import estimate
from maasi_drivers.links.mavlink.estimate import (
    FlightOrigin,
    swap_enu_ned,
    swap_flu_frd,
    swap_orientation,
    swap_yaw,
)
from maasi_drivers.links.mavlink.phases import VehiclePhase
from maasi_drivers.links.mavlink.protocol import ReportLog
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.models.pose import Pose


@pytest.mark.parametrize('yaw', [0.0, 0.3, 2.0, -3.0])
def test_north_east_down_is_east_north_up(yaw):
    assert_allclose(swap_enu_ned([1.0, 2.0, 3.0]), [2.0, 1.0, -3.0])
    assert_allclose(swap_flu_frd([1.0, 2.0, 3.0]), [1.0, -2.0, -3.0])
    assert swap_yaw(yaw) == pytest.approx(math.remainder(math.pi / 2 - yaw, math.tau))
    ned = np.array([math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)])
    enu = Pose(np.zeros(3), swap_orientation(ned))
    # As it lies flat, forward says all.
    forward = swap_enu_ned([math.cos(yaw), math.sin(yaw), 0.0])
    assert_allclose(enu.rotation()[:, 0], forward, atol=1e-12)
    assert_allclose(enu.rotation()[:, 2], [0.0, 0.0, 1.0], atol=1e-12)
    assert_allclose(np.abs(swap_orientation(enu.orientation) @ ned), 1.0)


@pytest.mark.parametrize(('drift', 'home'), [(-0.05, 0.0), (0.05, 0.0), (0.0, -0.5)])
def test_a_barometer_that_drifts_before_arming_does_not_keep_it_at_its_take_off(drift, home):
    play = Play(autopilot={'barometer_drift': drift, 'estimator_time': 12.0})
    play.until(lambda: play.autopilot.armed)
    # Set by another person, lower than where it stands.
    play.autopilot._home = home
    play.fly().run(4.0)
    assert abs(play.autopilot.height_error) > 0.55 or home
    # Above the ground, whatever the barometer says.
    assert play.body.position[2] == pytest.approx(play.height, abs=0.1)
    origin = play.vehicle.estimate.origin
    assert origin[2] == pytest.approx(play.autopilot.height_error, abs=0.05)
    assert len(play.commands(TAKE_OFF)) == 1


@pytest.mark.parametrize(
    ('second_gnss', 'lost', 'muted', 'text'),
    [
        (False, False, 'EKF_STATUS_REPORT', 'EKF_STATUS_REPORT lost'),
        (False, False, 'GPS_RAW_INT', 'GNSS fix lost (GPS_RAW_INT lost)'),
        (False, True, '', 'GNSS fix lost (GPS_RAW_INT.fix_type 1)'),
        (True, True, 'GPS2_RAW', 'GNSS fix lost (GPS_RAW_INT.fix_type 1, GPS2_RAW lost)'),
    ],
)
def test_the_loss_of_position_or_its_status_is_seen_in_flight(second_gnss, lost, muted, text):
    play = Play(autopilot={'second_gnss': second_gnss}).fly().go()
    if lost:
        play.autopilot.gnss.lost_at = play.autopilot.now
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
    assert play.fault == '' and math.isfinite(play.autopilot.periods['EKF_STATUS_REPORT'])


def far_away(memory, origin):
    """Return a vehicle in the air, away from its start and from the origin of its local frame."""
    play = Play(memory=memory, origin=origin, autopilot={'barometer_drift': -0.1})
    play.without_driver(3.0, position=[3.0, 4.0])
    return play.fly().go()


@pytest.mark.parametrize('origin', ['here', 'local'])
@pytest.mark.parametrize('landed', [False, True])
def test_a_restarted_driver_has_the_map_and_the_heights_of_before(tmp_path, origin, landed):
    play = far_away(tmp_path / 'new' / 'origin.json', origin)
    before = play.vehicle.estimate.origin
    assert before[2] < -0.2
    if landed:
        play.vehicle.finish('land')
        play.until(lambda: play.phase is VehiclePhase.STOPPED)
    play.start_driver()
    play.run(6.0)
    assert_allclose(play.vehicle.estimate.origin, before, atol=1e-6)
    assert 'the origin of the previous flight' in play.said
    play.permitted().fly()
    assert_allclose(play.vehicle.estimate.origin[:2], before[:2], atol=1e-6)


def test_a_driver_that_finds_its_vehicle_in_the_air_does_not_guess_where_it_is():
    play = far_away(None, 'here')
    play.start_driver()
    play.run(6.0)
    assert 'position in the map is unknown' in play.fault
    assert play.vehicle.estimate.telemetry is None
    # After a landing it is not at its start either.
    play.autopilot.set_mode('LAND')
    play.until(lambda: not play.autopilot.armed).run(3.0)
    assert 'position in the map is unknown' in play.permit()


@pytest.mark.parametrize('change', ['autopilot', 'start', 'ground', 'broken', 'host'])
def test_an_origin_of_another_time_or_map_is_not_used(tmp_path, change, monkeypatch):
    path, log = tmp_path / 'origin.json', ReportLog()
    before, here = np.array([4.0, 5.0, 6.0]), np.array([7.0, 8.0, 9.0])

    def origin(start=(1.0, 2.0, 3.0), ground=0.0):
        settings = MavlinkSettings(origin='here', ground=ground)
        return FlightOrigin(settings, list(start), path, log)

    origin().keep(before, 50.0)
    assert_allclose(origin().find(here, 51.0, True), before)
    if change == 'host':
        monkeypatch.setattr(estimate, '_host_boot', lambda: 'another')
    elif change == 'broken':
        path.write_text(path.read_text()[:-9])
    other = {'start': {'start': (1.0, 2.5, 3.0)}, 'ground': {'ground': 0.5}}.get(change, {})
    booted = 110.0 if change == 'autopilot' else 50.0
    assert origin(**other).find(here, booted, True) is None
    assert_allclose(origin(**other).find(here, booted, False), here)


def test_two_batteries_are_two():
    charges = {}
    for counted in (-1, 0):
        play = Play(autopilot={'charge': 0.8, 'more_batteries': [0.05]}, battery=counted)
        seen = charges[counted] = []
        play.run(10.0, lambda seen=seen, play=play: seen.append(play.vehicle.estimate.charge))
    assert charges[-1][-1] == pytest.approx(0.05)
    assert charges[0][-1] == pytest.approx(0.8) and min(charges[0]) in (-1.0, 0.8)


def test_a_position_that_is_frozen_or_not_finite_is_no_news():
    play = Play().fly()
    play.autopilot.frozen = play.autopilot._position()
    play.run(0.2)
    data = play.vehicle.estimate
    last = data.telemetry
    play.run(AT_MOST)
    play.autopilot.frozen = (math.nan, *[0.0] * 5)
    play.run(1.0)
    assert data.telemetry is last
    for what in ('frozen', 'invalid'):
        assert data.dropped[f'{what} LOCAL_POSITION_NED'] > 10
