"""Statements of persons change where the planner sends the robots."""

import numpy as np
import pytest
from std_srvs.srv import Trigger
from test_coordinator import ROBOT, there
from test_planner_node import running, update_of

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.reports import MOST_REPORTS, Report
from maasi_filter.ros.qos import LATCHED_ALL
from maasi_msgs.msg import Report as ReportMessage
from maasi_planner.coordinator import Coordinator
from maasi_planner.node_settings import PlannerNodeSettings

PLANNERS = ['maasi', 'tour']
# The west of the field, and the east.
WEST = 'POLYGON ((0 0, 30 0, 30 60, 0 60, 0 0))'
EAST = 'POLYGON ((30 0, 60 0, 60 60, 30 60, 30 0))'
FLYER = {
    **ROBOT,
    'candidates': {'grid': [6, 6], 'spacing': 10.0, 'corner': [5.0, 5.0]},
    'sensor': {
        'detection': {'kind': 'box', 'probability': 0.9, 'lower': [-5, -5], 'upper': [5, 5]},
        'noise': {'range': 0.1, 'bearing': 0.1},
        'period': 1.0,
    },
}


def make(planner, robots=None):
    settings = {
        'step': 0.1,
        'environment': {'bounds': [[0.0, 60.0]] * 2, 'expected_targets': 2.0},
        'planner': {'name': planner},
        'robots': robots or {'a': FLYER},
    }
    return Coordinator(PlannerNodeSettings.model_validate(settings))


def destinations(coordinator, number=4, start=(30.0, 30.0)):
    """Return where the next decisions send the robot; it sees everything around each."""
    out, at, step = [], np.array(start), 0
    for _ in range(number):
        decision = coordinator.plan(step, there(a=tuple(at)))
        if decision is None or 'a' not in decision.robots:
            break
        chosen = decision.robots['a']
        for position in chosen.positions[::5]:
            pose = there(a=position[:2])['a'].state.pose
            coordinator.absorb({'a': pose}, [])
        at = chosen.waypoint[:2]
        out.append(at)
        step += len(chosen.positions) + 1
    return np.array(out)


def searched(zone, probability=0.98):
    return Report('searched', probability, zone=zone, position=[30.0, 30.0])


@pytest.mark.parametrize('planner', PLANNERS)
def test_robots_leave_out_ground_that_others_have_searched(planner):
    for zone, side in ((WEST, 1.0), (EAST, -1.0)):
        coordinator = make(planner)
        coordinator.use(searched(zone))
        assert coordinator.exploration.explored_fraction() == pytest.approx(0.49, abs=0.02)
        places = destinations(coordinator)
        assert len(places) >= 2
        assert (side * (places[:, 0] - 30.0) >= -5.0).all()


@pytest.mark.parametrize('planner', PLANNERS)
@pytest.mark.parametrize('corner', [(8.0, 8.0), (52.0, 8.0), (8.0, 52.0), (52.0, 52.0)])
def test_a_sighting_attracts_robots(planner, corner):
    coordinator = make(planner)
    coordinator.use(Report('sighting', 10.0, position=list(corner), radius=6.0))
    assert coordinator.area.expected_targets == 12.0
    places = destinations(coordinator, 3)
    assert np.hypot(*(places - corner).T).min() < 10.0


def test_a_sighting_resumes_a_finished_search_and_a_search_by_others_can_end_it():
    coordinator = make('maasi')
    coordinator.use(searched('POLYGON ((-1 -1, 61 -1, 61 61, -1 61, -1 -1))', 1.0))
    coordinator.plan(0, there(a=(30.0, 30.0)))
    assert coordinator.finished is not None
    coordinator.use(Report('sighting', 1.0, position=[50.0, 50.0], radius=6.0))
    assert coordinator.finished is None
    # A robot that stays plans again after its period.
    decision = coordinator.plan(10, there(a=(30.0, 30.0)))
    assert np.hypot(*(decision.robots['a'].waypoint[:2] - 50.0)) < 10.0


def test_keep_outs_that_change_leave_sightings_in_the_area():
    coordinator = make('maasi')
    coordinator.use(Report('sighting', 1.0, position=[50.0, 50.0], radius=6.0))
    coordinator.adopt_area(make('maasi').area)
    assert coordinator.area.expected_targets == 3.0
    assert coordinator.area is coordinator.exploration.area


@pytest.mark.parametrize('own', [False, True])
def test_a_search_that_begins_again_keeps_what_others_searched_and_sightings(own):
    """Without any measurement, a new search begins with e as before the first measurement."""
    robots = {'a': FLYER, 'b': {**FLYER, 'start': [50.0, 50.0, 1.0]}}
    settings = make('maasi', robots).settings
    if own:
        settings = settings.model_copy(
            update={'planner': settings.planner.model_copy(update={'agent_exploration': 'own'})}
        )
    generator = np.random.default_rng(7)
    for _ in range(10):
        coordinator, untouched = Coordinator(settings), Coordinator(settings)
        assert (coordinator.robots['a'].exploration is not None) == own
        for _ in range(5):
            x, y = generator.uniform(5.0, 55.0, 2)
            if generator.uniform() < 0.5:
                report = searched(f'{x} {y} 12', generator.uniform(0.2, 0.9))
            else:
                report = Report('sighting', 1.0, position=[x, y], radius=6.0)
            coordinator.use(report)
            untouched.use(report)
            pose = there(a=generator.uniform(5.0, 55.0, 2))['a'].state.pose
            coordinator.absorb({'a': pose, 'b': pose}, [])
        coordinator.begin_again()
        for one, other in zip(maps_of(coordinator), maps_of(untouched), strict=True):
            np.testing.assert_allclose(one.values, other.values, rtol=0.0, atol=1e-12)
        # Keep-outs that change later apply to both.
        environment = {**dict(settings.environment), 'keep_outs': ['20 20 9']}
        closed = Area(EnvironmentSettings.model_validate(environment))
        for team in (coordinator, untouched):
            team.adopt_area(closed)
        coordinator.begin_again()
        for one, other in zip(maps_of(coordinator), maps_of(untouched), strict=True):
            np.testing.assert_allclose(one.values, other.values, rtol=0.0, atol=1e-12)


def maps_of(coordinator):
    robots = coordinator.robots.values()
    return [coordinator.exploration, *(item.exploration for item in robots if item.exploration)]


def report_of(number, **changes):
    message = ReportMessage(id=number, kind=ReportMessage.SEARCHED, weight=0.5, zone='0.5 0.5 0.2')
    message.header.frame_id = 'map'
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def test_running_freely_reports_are_used_once_and_wrong_ones_are_dropped():
    with running() as team:
        publisher = team.node.create_publisher(ReportMessage, 'reports', LATCHED_ALL)
        team.until(lambda: publisher.get_subscription_count() == 1)
        e = team.tested.coordinator.exploration
        publisher.publish(report_of(1))
        team.until(lambda: e.explored_fraction() > 0.0)
        once = e.values.copy()
        assert once.min() == 0.5
        # A restarted filter repeats it; then come others.
        publisher.publish(report_of(1))
        sighting = {'kind': ReportMessage.SIGHTING, 'radius': 0.2}
        bad = [{'kind': 9}, {'zone': 'here'}, {'zone': ''}, {**sighting, 'radius': 0.0}]
        bad += [{'weight': weight} for weight in (float('nan'), 5.0, 0.0, -0.5)]
        bad += [{**sighting, 'weight': weight} for weight in (0.0, -1.0, 1e9)]
        for wrong in bad:
            publisher.publish(report_of(2, **wrong))
        message = report_of(6)
        message.header.frame_id = 'odom'
        publisher.publish(message)
        team.until(lambda: team.tested.dropped['bad report'] == len(bad) + 1)
        np.testing.assert_array_equal(e.values, once)
        # A search that begins again after its end, too.
        planner = team.tested.coordinator
        planner.absorb({'a': there(a=(1.0, 1.0))['a'].state.pose}, [])
        assert (e.values != once).any()
        planner.finished = 'no further finds'
        team.tested.modes.command('stop')
        client = team.node.create_client(Trigger, 'search/start')
        team.until(client.service_is_ready)
        answer = client.call_async(Trigger.Request())
        team.until(answer.done)
        assert answer.result().success
        np.testing.assert_array_equal(e.values, once)
        # A planner that begins again uses it again, until a new search clears it.
        team.tested.reset()
        np.testing.assert_array_equal(team.tested.coordinator.exploration.values, once)
        publisher.publish(report_of(0, kind=ReportMessage.CLEARED))
        team.until(lambda: team.tested.coordinator.exploration.values.min() == 1.0)
        # A node that is not active receives them, too, as they come only once.
        assert team.tested.trigger_deactivate().name == 'SUCCESS'
        publisher.publish(report_of(1))
        team.until(lambda: team.tested.coordinator.exploration.values.min() == 0.5)
        assert team.tested.trigger_activate().name == 'SUCCESS'
        np.testing.assert_array_equal(team.tested.coordinator.exploration.values, once)


def test_no_more_statements_are_stored_than_a_filter_accepts():
    with running() as team:
        reports = team.tested.reports
        for number in range(1, MOST_REPORTS + 4):
            reports._on_report(report_of(number, kind=ReportMessage.CONFIRMED, weight=0.9))
        assert len(reports._used) == MOST_REPORTS
        assert team.tested.dropped['bad report'] == 3


def test_in_lockstep_reports_are_used_with_the_update_that_includes_them():
    with running(lockstep=True) as team:
        publisher = team.node.create_publisher(ReportMessage, 'reports', LATCHED_ALL)
        team.until(lambda: publisher.get_subscription_count() == 1)
        for number in (1, 2):
            publisher.publish(report_of(number))
        node = team.tested
        team.until(lambda: len(node.reports._waiting) == 2)
        e = node.coordinator.exploration
        assert e.values.min() == 1.0
        node.reports.include(1)
        assert e.values.min() == 0.5
        node.reports.include(2)
        node.reports.include(2)
        assert e.values.min() == 0.25
        assert update_of(1, []).reports == 0
