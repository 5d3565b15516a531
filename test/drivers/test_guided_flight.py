"""How a drone under ArduCopter flies to its goals, leaves zones, and stops, against a fake one."""

import re
from pathlib import Path

import numpy as np
import pytest
import shapely
from guided_play import GuidedPlay

from maasi_drivers.agent.waypoint_follower import GoalStatus
from maasi_drivers.links.mavlink.phases import VehiclePhase
from maasi_filter.geometry.geodesy import geodetic
from maasi_sim.scenario.loading import load_scenario


@pytest.fixture
def guided(monkeypatch):
    """Return a function that starts a drone, which has risen to its height."""

    def start(**changes):
        play = GuidedPlay(monkeypatch, **changes).fly().run(6.0)
        assert play.fault == '' and play.position[2] == pytest.approx(30.0, abs=3.5)
        play.speeds.clear()
        return play

    return start


@pytest.mark.parametrize('speed', [2.0, 5.0, 8.0])
def test_it_flies_at_the_speed_that_is_planned_with(guided, speed):
    play = guided(motion={'speed': speed})
    far = 18.0 * speed
    play.go_to(far, 0.0, 30.0).run(12.0)
    cruise = play.speeds[-100:]
    assert min(cruise) > 0.95 * speed and max(play.speeds) < 1.02 * speed
    play.arrives()
    assert play.away(far, 0.0) <= 1.1
    play.run(10.0)
    assert play.away(far, 0.0) < 0.2 and play.speed < 0.05


def test_it_stops_soon_without_a_goal_and_does_not_fly_back(guided):
    play = guided().go_to(150.0, 0.0, 30.0)
    play.run(8.0)
    here = play.position.copy()
    play.driver.end_goal(GoalStatus.CANCELED, 'cancelled')
    play.link.hold()
    east = []
    play.run(12.0, lambda: east.append(play.position[0]))
    # 8 m/s are braked with 2.5 m/s^2 in 12.8 m.
    assert 12.0 < play.away(*here) < 17.0 and play.speed < 0.05
    assert np.diff(east).min() > -0.01


# The circles of the flights, and a polygon: they lie over the drone.
ZONES = {'12 m': '3 0 12', '5 m': '3 0 5', 'polygon': 'POLYGON ((-4 -9, 9 -9, 9 9, -4 9, -4 -9))'}


@pytest.mark.parametrize('zone', ZONES.values(), ids=ZONES)
def test_it_leaves_a_zone_drawn_over_it_by_the_exit_and_stays_until_it_is_sent(guided, zone):
    play = guided()
    play.draw(zone).run(10.0)
    # Nothing moves without a goal, and nothing is at fault.
    assert play.away(0.0, 0.0) < 0.3 and play.fault == ''
    keep_out = play.driver.follower.motion.keep_out
    assert not keep_out.is_free(play.position)
    far = keep_out.exit_from(play.position)
    began = play.now
    play.go_to(*far).until(lambda: keep_out.is_free(play.position), 30.0)
    distance = play.away(0.0, 0.0)
    # As it would fly from rest to rest.
    assert play.now - began < 2.0 * np.sqrt(distance / 2.5) + 2.5, (distance, play.now - began)
    play.arrives(10.0)
    # From there on it searches.
    play.go_to(-60.0, 50.0, 30.0).arrives()
    assert play.fault == '' and not play.driver.ended


def test_a_goal_whose_way_only_leaves_a_zone_goes_on_and_others_end(guided):
    play = guided().go_to(60.0, 0.0, 30.0).run(4.0)
    x = float(play.position[0])
    play.draw([[x - 8.0, -8.0], [x + 5.0, -8.0], [x + 5.0, 8.0], [x - 8.0, 8.0]])
    play.arrives()
    assert not play.driver.ended and play.fault == ''
    play.go_to(-60.0, 0.0, 30.0).run(2.0)
    play.draw([[-45.0, -8.0], [-25.0, -8.0], [-25.0, 8.0], [-45.0, 8.0]])
    assert play.driver.ended == ['path blocked by a keep-out zone']
    play.run(8.0)
    assert play.speed < 0.05 and play.driver.follower.motion.keep_out.is_free(play.position)


@pytest.mark.parametrize('limit', ['fence', 'stuck'])
def test_a_rejected_setpoint_is_a_fault_with_its_reason(guided, limit):
    if limit == 'fence':
        play = guided(parameters={'FENCE_TYPE': 7, 'FENCE_RADIUS': 50.0})
    else:
        play = guided()
        play.autopilot.muted.add('POSITION_TARGET_LOCAL_NED')
        play.autopilot._go_to = lambda *_: None
    play.go_to(80.0, 0.0, 30.0)
    play.until(lambda: play.fault, 60.0)
    assert 'the autopilot rejected the set-point (' in play.fault
    assert 'outside of its own fence' in play.fault
    assert play.driver.ended == [play.fault]
    play.run(10.0)
    assert play.speed < 0.05 and play.fault == '' and play.away(0.0, 0.0) < 50.0
    if limit == 'fence':
        # It goes elsewhere.
        play.go_to(-20.0, 10.0, 30.0).arrives()
        assert play.fault == ''


@pytest.mark.parametrize(('action', 'mode'), [(1, 'RTL'), (2, 'LAND'), (4, 'BRAKE')])
def test_the_autopilot_that_acts_on_its_fence_is_not_taken_for_the_pilot(guided, action, mode):
    play = guided(parameters={'FENCE_ACTION': action}).go_to(60.0, 0.0, 30.0).run(4.0)
    x, y, _ = play.position.tolist()
    play.draw(f'{x} {y} 15')
    play.until(lambda: play.phase is VehiclePhase.RELEASED, 10.0)
    play.run(0.1)
    assert f'fence breached: the autopilot has taken control: mode {mode}' in (play.fault)
    assert 'the pilot' not in play.fault and 'the pilot' not in play.said
    sent = len(play.sent('SET_POSITION_TARGET_LOCAL_NED'))
    play.run(2.0)
    assert len(play.sent('SET_POSITION_TARGET_LOCAL_NED')) == sent
    # A pilot is one.
    other = guided()
    other.autopilot.set_mode('LOITER')
    other.run(2.0)
    assert other.fault == 'vehicle: the pilot has taken over: mode LOITER'


def test_bounds_are_an_area_and_it_comes_back_from_outside(guided):
    play = guided(environment={'bounds': [[-30.0, 30.0], [-30.0, 30.0]]})
    assert len(play.autopilot.fence.items) == 4
    play.go_to(20.0, 0.0, 30.0).run(2.0)
    play.body.position[:2] = 51.0, 0.0
    play.run(0.1)
    assert ' m outside of the area' in play.fault and 'returning' in play.fault
    assert ' m outside the geofence' in play.driver.ended[0]
    play.until(lambda: play.fault == '', 60.0).run(5.0)
    assert play.position[0] < 30.6 and play.speed < 0.05
    # At the side of the box noise is no fault.
    play.go_to(30.3, 0.0, 30.0).arrives()
    for _ in range(50):
        play.body.position[0] += 0.004
        play.run(0.1)
        assert play.fault == ''


def random_zone(generator, centre, size):
    """Return a circle or a polygon around a place."""
    x, y = centre
    if generator.uniform() < 0.5:
        return f'{x:.1f} {y:.1f} {size:.1f}'
    angles = np.sort(generator.uniform(0.0, 2.0 * np.pi, 7))
    reach = size * generator.uniform(0.7, 1.3, 7)
    ring = np.stack([x + reach * np.cos(angles), y + reach * np.sin(angles)], axis=1)
    shape = shapely.MultiPoint(ring).convex_hull
    return shape.wkt


@pytest.mark.parametrize('seed', range(900, 903))
def test_no_setpoint_is_rejected_while_zones_appear_over_it_and_around(guided, seed):
    """Whatever is drawn: it stops or goes on, leaves when it is sent out, and is never at fault."""
    generator = np.random.default_rng(seed)
    play = guided(parameters={'FENCE_ACTION': 0})
    rejected, take = [], play.autopilot._go_to

    def go_to(place, yaw):
        if play.autopilot.fence.breach(place, float(place[2])):
            rejected.append(place)
        take(place, yaw)

    play.autopilot._go_to = go_to
    for _ in range(3):
        play.draw()
        play.run(3.0)
        goal = generator.uniform(-120.0, 120.0, 2)
        if play.away(*goal) > 40.0:
            play.go_to(*goal, 30.0)
        play.run(generator.uniform(1.0, 8.0))
        here = play.position[:2] + generator.uniform(-5.0, 5.0, 2)
        around = generator.uniform(-60.0, 60.0, (4, 2)) + here
        zones = [random_zone(generator, here, generator.uniform(6.0, 14.0))]
        zones += [random_zone(generator, place, generator.uniform(4.0, 10.0)) for place in around]
        play.draw(*zones).run(3.0)
        if play.driver.follower.current is None:
            play.run(10.0)
            assert play.speed < 0.05
            keep_out = play.driver.follower.motion.keep_out
            exit_point = keep_out.exit_from(play.position)
            if exit_point is not None:
                play.go_to(*exit_point)
        if play.driver.follower.current is not None:
            play.arrives()
        assert play.driver.follower.exit_from(play.position) is None
        assert play.fault == '' and not rejected


@pytest.mark.parametrize('seed', range(900, 904))
def test_where_the_driver_dies_it_stops_in_free_space(guided, seed):
    """Killed, hung or cut off: its last set-point is where it may be."""
    generator = np.random.default_rng(seed)
    zones = [
        f'{x:.1f} {y:.1f} {radius:.1f}'
        for x, y, radius in generator.uniform([20.0, -60.0, 3.0], [110.0, 60.0, 12.0], (8, 3))
    ]
    play = guided(environment={'keep_outs': zones})
    keep_out = play.driver.follower.motion.keep_out
    goal = next(
        point
        for point in generator.uniform([90.0, -60.0], [120.0, 60.0], (50, 2))
        if keep_out.is_free([*point, 30.0]) and keep_out.exit_from([*point, 30.0]) is None
    )
    play.go_to(*goal, 30.0)
    play.run(generator.uniform(6.0, 14.0), lambda: check(play, keep_out))
    before, speed = play.position.copy(), play.speed
    play.driver_lives = False
    play.to_driver.cut = play.to_autopilot.cut = bool(seed % 2)
    play.autopilot.parameters['FS_GCS_TIMEOUT'] = 60.0
    play.run(9.0, lambda: check(play, keep_out))
    assert play.speed < 0.05
    # As long as it brakes, and a second.
    assert play.away(*before) < speed**2 / 5.0 + 1.6 * speed + 2.0


def check(play, keep_out):
    assert keep_out.is_free(play.position), play.position


def test_at_home_a_drone_that_is_not_charged_lands(guided):
    play = guided(mavlink={'home_timeout': 20.0})
    # After its take-off it waits for a goal.
    play.run(30.0)
    assert play.phase is VehiclePhase.FLYING
    play.autopilot.charge = 0.4
    play.go_to(40.0, 0.0, 30.0).arrives().run(30.0)
    assert play.phase is VehiclePhase.FLYING
    play.go_to(0.0, 0.0, 30.0).arrives()
    # One that is charged there does not.

    def charge():
        play.autopilot.charge += 0.02 * 0.001

    play.run(40.0, charge)
    assert play.phase is VehiclePhase.FLYING
    play.until(lambda: play.phase is VehiclePhase.ENDING, 25.0).run(0.1)
    assert play.mode == 'LAND'
    play.until(lambda: not play.autopilot.armed, 90.0).run(2.0)
    assert 'battery not charging at home (44 %)' in play.fault
    play.run(20.0)
    assert not play.autopilot.armed and play.body.grounded


DOCS = Path(__file__).parents[2] / 'docs'


@pytest.mark.parametrize('name', ['drone_sitl', 'field_sitl'])
def test_by_the_words_of_the_document_it_arms_rises_and_flies_in_its_fence(monkeypatch, name):
    scenario = load_scenario(DOCS / f'{name}.yaml')
    ((robot_name, robot),) = scenario.robots.items()
    text = (DOCS / 'robots_mavlink.md').read_text()
    assert f'docs/{name}.yaml' in text and f'team_command arm {robot_name}' in text
    block = re.search(r'<!-- not run: a file for ArduPilot -->\n((?:    \w+ \d+\n)+)', text)[1]
    parameters = {key: float(value) for key, value in map(str.split, block.splitlines())}
    assert parameters['FENCE_ENABLE'] == 1.0 and parameters['FENCE_TYPE'] == 4.0
    # The command of the document starts it at the `start` of the scenario.
    homes = re.findall(r'--home ([-\d.]+),([-\d.]+),', text)
    home = [[float(north), float(east)] for north, east in homes][name == 'field_sitl']
    place = geodetic(np.array([robot.start]), scenario.environment.origin)[0, :2]
    np.testing.assert_allclose(home, place, atol=2e-7)
    play = GuidedPlay(
        monkeypatch,
        environment=scenario.environment,
        motion=robot.motion.model_dump(),
        parameters=parameters,
        start=robot.start,
        mavlink=robot.mavlink.model_dump() | {'lead': 1.0},
    ).fly()
    assert 'fence: uploaded and verified' in play.said and 'FENCE_ENABLE is 1' in play.said
    assert play.fault == '' and 'less than motion.acceleration' not in play.said
    x, y, z = robot.start
    play.go_to(x + 4.0, y + 6.0, z).arrives()
    assert play.fault == '' and play.phase is VehiclePhase.FLYING


def test_what_the_document_says_of_a_fence_that_is_not_there(monkeypatch):
    play = GuidedPlay(monkeypatch, mavlink={'fence': 'none'}, motion={'acceleration': 3.0})
    play.run(20.0)
    assert not play.autopilot.armed
    assert 'PreArm: Fences enabled, but none selected' in play.said
    assert '2.5 m/s^2, less than motion.acceleration, 3' in play.said
