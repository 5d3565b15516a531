"""Reports: what is gathered from a run's messages, how it is scored, what is written."""

import csv
import json
import math

import cv2
import numpy as np
import pytest
import shapely
from geometry_msgs.msg import Point
from matplotlib.colors import to_hex
from pymap3d import geodetic2enu
from rclpy.serialization import serialize_message
from report_check import check_report
from test_scenario import PLAIN

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_msgs import msg
from maasi_sim.run.bag import load_types
from maasi_sim.run.log import RunEnd
from maasi_sim.run.report_files import write_report
from maasi_sim.run.scores import score, scoring_radius
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.run.targets.observer import TargetObserver
from maasi_sim.run.targets.report import build_report, target_summary
from maasi_sim.run.targets.report_figure import plot_report
from maasi_sim.run.topics import within
from maasi_sim.scenario.loading import load_scenario, scenario_from_values

TYPES = load_types()
ROBOT = PLAIN['robots']['mambo']


def write(record, folder):
    report = write_report(TargetMission(record.name, record.scenario), record, folder)
    return check_report(report)


class Run:
    """Messages of a run in which everything is put in by hand."""

    def __init__(self, scenario, namespace='', observer=None):
        self.scenario = scenario
        self.observer = observer or TargetObserver('hand', scenario, 7, TYPES)
        self.namespace = namespace
        self.found = []
        self.batch = 0
        self.step(0.0, scenario.names())

    def send(self, topic, message, time):
        stamped = message.header if hasattr(message, 'header') else message
        stamped.stamp = stamp_to_ros(round(time * 1e9))
        if hasattr(message, 'step'):
            message.step = round(time / self.scenario.step)
        own = topic in ('/decisions', '/found_targets', '/filter_update')
        topic = within(self.namespace, topic) if own else topic
        self.observer.add(topic, serialize_message(message))

    def state(self, time, robot, position, status=1, reason=''):
        state = msg.AgentState(robot=robot, goal_status=status, reason=reason)
        state.pose.pose.position = point(position)
        self.send(f'/{robot}/state', state, time)

    def decide(self, time, robots, explored=0.0):
        """Publish a decision; `robots`: name to waypoint, or None for one that stays."""
        made = [
            msg.RobotDecision(robot=name, chosen=-1 if place is None else 0, waypoint=point(place))
            for name, place in robots.items()
        ]
        self.send('/decisions', msg.PlanDecision(explored=explored, robots=made), time)

    def give_up(self, time):
        decision = msg.PlanDecision(explored=0.99, reason=f'nothing left for {self.namespace}')
        self.send('/decisions', decision, time)

    def declare(self, time, position, robot='mambo', deviation=0.01):
        """Add a found target to what the next update publishes."""
        size = self.scenario.dimension
        found = msg.FoundTarget(id=len(self.found) + 1, position=point(position), robot=robot)
        found.covariance = deviation**2 * np.diag(np.arange(3) < size).reshape(-1)
        found.measurement, found.batch_id = 3, self.batch + 1
        found.stamp = stamp_to_ros(round(time * 1e9))
        found.class_id, found.score, found.identity = 'cup', 0.8, 'tag_3'
        self.found.append(found)

    def update(self, time, robots=('mambo',), latched=True):
        self.batch += 1
        if latched:
            array = msg.FoundTargetArray(batch_id=self.batch, targets=self.found)
            self.send('/found_targets', array, time)
        update = msg.FilterUpdate(
            batch_id=self.batch,
            members=[msg.BatchMember(robot=name, measurement=self.batch) for name in robots],
            expected_number=1.5,
            found=len(self.found),
            newly_found=[item for item in self.found if item.batch_id == self.batch],
        )
        self.send('/filter_update', update, time)
        self.observer.settle()

    def step(self, time, robots):
        self.send('/lockstep/step', msg.LockstepStep(robots=robots), time)

    def record(self, reason='time_limit', time=1.0, wall=1.0, events=()):
        return self.observer.record(RunEnd(reason, time, wall, list(events)))

    def report(self, *end):
        return build_report(self.record(*end))


def point(position):
    x, y, z = [*map(float, position or ()), 0.0, 0.0, 0.0][:3]
    return Point(x=x, y=y, z=z)


def scenario_of(targets, **changes):
    content = PLAIN | {
        'targets': {'positions': targets} if targets else {'count': 0},
        'robots': PLAIN['robots'] | {'second': ROBOT | {'start': [1.5, 1.5, 1.0]}},
        'filter': {'removal_distance': 0.05},
        'stop': 'all_found' if targets else 'planner_done',
    }
    return scenario_from_values(content | changes, 'hand')


TARGETS = [[0.5, 0.5], [1.5, 0.5], [1.0, 1.5]]


@pytest.fixture
def run():
    return Run(scenario_of(TARGETS))


def test_radius_of_scoring_and_matching_within_it():
    # Three times the removal distance, at most half the smallest distance of two targets.
    near = [[0.0, 0.0], [0.2, 0.0], [1.0, 1.0]]
    scenario = scenario_of(TARGETS)
    for truth, radius in ((TARGETS, 0.15), (near, 0.1), (near[:1], 0.15), (np.zeros((0, 2)), 0.15)):
        assert scoring_radius(scenario, np.array(truth)) == pytest.approx(radius)
    with pytest.raises(ValueError, match='truth: '):
        scoring_radius(scenario, np.ones((2, 2)))
    given = scenario_of(TARGETS, scoring={'radius': 0.3})
    assert scoring_radius(given, np.array(near)) == 0.3
    # One to one.
    scores = score([[0.5, 0.51], [0.5, 0.52], [1.5, 0.5]], TARGETS, 0.15)
    assert (scores.match.true_found, scores.match.false_found, scores.match.missed) == (2, 1, 1)
    assert not scores.complete


def test_report_of_a_complete_run(run, tmp_path):
    run.decide(0.0, {'mambo': [0.5, 0.5], 'second': [1.0, 1.5]}, explored=0.1)
    for step, position in enumerate(([0.5, 0.5, 1.0], [0.5, 0.8, 1.0], [0.9, 0.8, 1.0])):
        run.state(0.05 * step, 'mambo', position)
    run.declare(0.5, [0.51, 0.5])
    run.update(0.5, ['mambo', 'second'])
    run.declare(0.7, [1.5, 0.49], 'second')
    run.declare(0.7, [1.0, 1.0])
    run.update(0.7, ['second'])
    assert run.observer.completed is None
    run.decide(0.7, {'mambo': None, 'second': [1.5, 0.5]}, explored=0.4)
    run.declare(0.9, [1.0, 1.51])
    run.update(0.9, ['mambo'])
    assert run.observer.completed.step == 18
    # Of those that are true, as on the page.
    assert (run.observer.found, run.observer.false_found) == (3, 1)
    report = write(run.record('all_found', 1.0, 0.3), tmp_path)
    assert json.loads((tmp_path / 'report.json').read_text()) == report
    picture = cv2.imread(str(tmp_path / 'report.png')).astype(int)
    assert picture.shape[0] > 600 and picture.shape[1] > 1000
    # Something of every kind of mark is there: found (green) and false (pink).
    for colour in ((0x73, 0x9E, 0x00), (0x7E, 0x00, 0xE6)):
        assert (np.abs(picture - colour).max(axis=2) < 12).sum() > 20
    text = target_summary(report)
    for words in ('3 of 3 targets found, 1 false', 'all targets found', '3 x real time'):
        assert words in text
    table = list(csv.DictReader((tmp_path / 'found_targets.csv').open()))
    rows = [('0.51', '0'), ('1.5', '1'), ('1.0', ''), ('1.0', '2')]
    assert [(row['x'], row['target']) for row in table] == rows
    assert not (tmp_path / 'found_targets.geojson').exists()
    expected = {
        'true_found': 3,
        'missed': 0,
        'false_found': 1,
        'rmse': pytest.approx(0.01),
        'measurements': {'mambo': 2, 'second': 2},
        'measurements_to_find_all': 4,
        'time_to_find_all': pytest.approx(0.9),
        'decisions': 3,
        'distance': {'mambo': pytest.approx(0.7), 'second': 0.0},
        'real_time_factor': pytest.approx(3.0),
        'scoring': {'radius': pytest.approx(0.15), 'c': pytest.approx(0.15), 'p': 2.0},
    }
    assert {name: report[name] for name in expected} == expected
    assert report['found'][1]['agent'] == 'second'
    assert report['found'][1]['covariance'][0][0] == pytest.approx(1e-4)
    gospa = report['gospa']
    assert gospa['false'] == pytest.approx(0.5 * 0.15**2)
    assert gospa['missed'] == 0.0
    assert gospa['total'] == pytest.approx(math.sqrt(3e-4 + gospa['false']))


def test_a_map_program_gets_ways_and_what_was_explored(tmp_path):
    origin = {'latitude': 46.0, 'longitude': 23.5, 'altitude': 350.0}
    environment = PLAIN['environment'] | {'origin': origin}
    run = Run(scenario_of(TARGETS, environment=environment))
    way = np.array([[0.5, 0.5, 1.0], [0.5, 1.3, 1.0], [1.1, 1.3, 1.2], [1.1, 1.3, 1.2]])
    # A robot stands for a while, and each leg has a thousand states.
    legs = np.concatenate([np.linspace(*way[i : i + 2], 1000) for i in range(3)])
    for k, place in enumerate(legs.tolist()):
        run.state(0.05 * k, 'mambo', place)
    run.state(0.0, 'second', [1.5, math.nan, 1.0])
    for k, place in enumerate(way[[0, 2]].tolist()):
        seen = msg.DetectionArray(batch_id=k + 1, robot='mambo')
        seen.pose.pose.position, seen.pose.pose.orientation.w = point(place), 1.0
        run.send('/mambo/detections', seen, 0.5 + 0.05 * k)
    run.update(0.5)
    write(run.record('time_limit', 200.0), tmp_path)
    explored, line = json.loads((tmp_path / 'ways.geojson').read_text())['features']
    assert '<name>Path of mambo' in (tmp_path / 'map_files' / 'search.kml').read_text()

    def placed(degrees):
        lon, lat = np.array(degrees)[:, :2].T
        return np.stack(geodetic2enu(lat, lon, 350.0, *origin.values())[:2], axis=1)

    properties, places = line['properties'], np.array(line['geometry']['coordinates'])
    assert (properties['kind'], properties['robot']) == ('way', 'mambo')
    assert properties['length'] == pytest.approx(1.4 + math.hypot(0.6, 0.2) - 0.6, abs=1e-6)
    assert len(places) == len(properties['times']) < 800
    assert properties['times'][0] == 0.0 and properties['times'][-1] == pytest.approx(149.95)
    assert places[[0, -1], 2] == pytest.approx([351.0, 351.2], abs=1e-3)
    ends = placed(places[[0, -1]])
    assert ends == pytest.approx(way[[0, -1], :2], abs=2e-3)
    # No corner is cut.
    assert np.linalg.norm(placed(places) - way[1, :2], axis=1).min() < 5e-3
    # Two fields of view of 0.4 m by 0.4 m, to half a cell of the exploration function.
    shape = shapely.transform(shapely.from_geojson(json.dumps(explored['geometry'])), placed)
    bounds = np.array(environment['bounds'])
    area = float(np.prod(np.ptp(bounds, axis=1)))
    assert shape.area == pytest.approx(0.32, abs=0.06)
    assert explored['properties']['share'] == pytest.approx(0.98 * shape.area / area, rel=0.02)
    assert shapely.contains_xy(shape, *way[[0, 2], :2].T).all()
    assert not shapely.contains_xy(shape, *way[1, :2])
    assert all(part.exterior.is_ccw for part in shape.geoms)


@pytest.fixture
def two_filters():
    """Return a run of each robot, with one observer: each has its own filter."""
    planner = {'name': 'maas', 'coordination': 'independent'}
    scenario = scenario_of(TARGETS, planner=planner)
    first = Run(scenario, namespace='mambo')
    return first, Run(scenario, namespace='second', observer=first.observer)


@pytest.mark.parametrize('turned', [False, True])
def test_targets_of_several_filters_count_once_whoever_speaks_first(two_filters, turned):
    one, two = two_filters
    one.declare(0.5, TARGETS[0])
    two.declare(0.5, TARGETS[1], 'second')
    pair = [(one, 'mambo'), (two, 'second')]
    for run, name in pair[::-1] if turned else pair:
        run.update(0.5, [name])
    # Each takes over what the other one has found; that is not found twice.
    one.found.append(two.found[0])
    two.found.append(one.found[0])
    for run, name in pair[::-1] if turned else pair:
        if name == 'mambo':
            run.declare(0.9, TARGETS[2])
        run.update(0.9, [name])
    for run, name in pair:
        run.update(0.95, [name])
    observer = one.observer
    assert observer.end_step == 18
    report = one.report('all_found', 1.0, 0.3)
    found = [(item['id'], item['agent']) for item in report['found']]
    assert found == [(1, 'mambo'), (2, 'second'), (3, 'mambo')]
    assert (report['true_found'], report['false_found']) == (3, 0)
    assert report['time_to_find_all'] == pytest.approx(0.9)
    # Both measured at the last step.
    assert report['measurements'] == {'mambo': 2, 'second': 2}
    assert report['measurements_to_find_all'] == 3


def test_planners_of_several_robots_are_done_together(two_filters):
    for run, time in zip(two_filters, (1.0, 1.5)):
        assert run.observer.settled is None
        run.give_up(time)
    assert (run.observer.settled, run.observer.end_step) == ('nothing left for second', 30)


def test_planner_without_a_robot_is_not_waited_for(two_filters):
    one, two = two_filters
    one.give_up(1.0)
    # Without any robot, not everything is searched.
    for time, robots in ((1.2, ['mambo', 'second']), (1.3, []), (1.4, ['mambo', 'second'])):
        one.step(time, robots)
        assert one.observer.settled is None
    one.step(1.5, ['mambo'])
    assert one.observer.settled == 'nothing left for mambo'
    # A robot that comes back does not take the ending back.
    one.step(2.0, ['mambo', 'second'])
    two.give_up(2.5)
    assert one.observer.end_step == 30


def test_planner_of_a_robot_that_cannot_go_on_is_not_waited_for(two_filters):
    one, two = two_filters
    one.give_up(1.0)
    two.state(1.5, 'second', [0.0, 0.0])
    assert one.observer.settled is None
    two.state(1.6, 'second', [0.0, 0.0], status=5, reason='its battery is empty')
    assert (one.observer.settled, one.observer.end_step) == ('nothing left for mambo', 32)


def test_what_comes_after_the_end_does_not_count(run):
    for time, position in zip((0.5, 0.6, 0.7, 0.8), [*TARGETS, [0.2, 0.2]]):
        run.declare(time, position)
        run.decide(time, {'mambo': position})
        run.state(time, 'mambo', [time, 0.0, 1.0])
        run.update(time)
    record = run.record('all_found', 5.0, 1.0)
    report = build_report(record)
    numbers = len(report['found']), report['measurements']['mambo'], report['decisions']
    assert numbers == (3, 3, 3)
    assert report['distance']['mambo'] == pytest.approx(0.2)
    assert record.end_time == pytest.approx(0.7)


def test_updates_after_the_planner_is_done_do_not_count(run):
    run.update(0.9)
    run.give_up(1.0)
    for time in (1.0, 1.0 + run.scenario.step):
        run.update(time)
    assert run.report('planner_done', 1.0, 1.0)['measurements']['mambo'] == 2


def test_updates_alone_tell_what_was_found_and_refined_positions_win(run):
    run.update(0.4, latched=False)
    run.declare(0.5, [0.6, 0.5])
    run.update(0.5, latched=False)
    assert run.observer.found == 1 and run.record().progress[-1].true_found == 1
    run.found[0].position.x = 0.501
    run.update(0.6)
    # A filter that was restarted publishes an update again.
    run.batch, run.found[0].position.x = 1, 0.6
    run.update(0.5, latched=False)
    (found,) = run.record().found_targets
    assert found.position[0] == pytest.approx(0.501)
    assert run.observer.measurements == 3


def test_completeness_that_is_lost_again_does_not_count():
    run = Run(scenario_of(TARGETS[:1], stop='planner_done'))
    run.declare(0.5, [0.5, 0.5])
    for time, x in ((0.5, 0.5), (0.6, 1.9), (0.7, 0.5)):
        run.found[0].position.x = x
        run.update(time)
    assert run.report('planner_done', 1.0, 1.0)['measurements_to_find_all'] == 3


def test_report_without_targets_and_of_a_run_in_which_nothing_happened(run, tmp_path):
    report = write(run.record('interrupted', 0.0, 0.0), tmp_path)
    assert (report['true_found'], report['missed'], report['real_time_factor']) == (0, 3, None)
    assert (tmp_path / 'report.png').stat().st_size > 10_000
    run = Run(scenario_of([]))
    run.decide(0.0, {'mambo': [0.5, 0.5]}, explored=0.99)
    run.update(0.5)
    report = write(run.record('planner_done', 1.0, 1.0), tmp_path)
    assert report['targets'] == [] and report['gospa']['total'] == 0.0
    assert report['rmse'] is None and report['measurements_to_find_all'] is None


def test_robots_that_cannot_go_on_are_events_among_those_of_nodes(run):
    stale = {'status': 5, 'reason': 'odometry is stale'}
    for time, said in ((0.0, {}), (0.5, stale), (0.6, stale), (0.9, {})):
        run.state(time, 'mambo', [0.5, 0.5, 1.0], **said)
    node = {'time': 0.7, 'node': '/filter_node', 'event': 'restarted'}
    assert run.report('time_limit', 1.0, 1.0, [node])['events'] == [
        {'time': 0.5, 'agent': 'mambo', 'event': 'lost', 'reason': 'odometry is stale'},
        node,
        {'time': 0.9, 'agent': 'mambo', 'event': 'joined'},
    ]


def labels_of(figure):
    """Return the labels of a figure's legend, which must be whole."""
    figure.canvas.draw()
    (legend,) = figure.legends
    box, whole = legend.get_window_extent(), figure.bbox
    assert whole.x0 <= box.x0 and box.x1 <= whole.x1 and whole.y0 <= box.y0 and box.y1 <= whole.y1
    return {text.get_text() for text in legend.get_texts()}


def test_picture_in_space():
    run = Run(load_scenario('ranging_pair_3d'))
    for name in ('drone1', 'drone2'):
        run.state(0.0, name, [1.0, 1.0, 1.0])
        run.state(1.0, name, [100.0, 50.0, 30.0])
    run.declare(0.5, list(run.observer.log.truth[0] + 0.5), 'drone1', deviation=1.0)
    run.update(0.5, ['drone1', 'drone2'])
    figure = plot_report(run.record())
    assert {'drone1', 'drone2', 'true target', 'found target'} <= labels_of(figure)
    views = [(axes.get_xlabel()[:1], axes.get_ylabel()[:1]) for axes in figure.axes[:3]]
    assert views == [('x', 'y'), ('x', 'z'), ('z', 'y')]


def test_picture_shows_missed_and_false_targets_and_ellipses_that_can_be_seen(run):
    run.state(0.5, 'mambo', [0.5, 0.5, 1.0])
    run.declare(0.5, [0.51, 0.5], deviation=1e-6)
    run.declare(0.5, [1.0, 1.0], deviation=0.1)
    run.found[1].covariance[:5] = 0.01, 0.003, 0.0, 0.003, 0.004
    run.update(0.5)
    figure = plot_report(run.record())
    labels = labels_of(figure)
    assert {'missed', 'false target'} <= labels
    (sigma,) = [label for label in labels if 'sigma' in label]
    assert 'at least' in sigma
    world = figure.axes[0]
    drawn = [patch for patch in world.patches if 'Ell' in repr(patch)]
    small, large = sorted(drawn, key=lambda patch: patch.width)
    colours = [to_hex(patch.get_edgecolor()) for patch in (small, large)]
    assert colours == ['#009e73', '#e6007e']
    assert small.width == pytest.approx(2 * 0.012 * 2.0)
    # Its axis is a principal one of the covariance.
    axis = np.array([math.cos(math.radians(large.angle)), math.sin(math.radians(large.angle))])
    spread = np.array([[0.01, 0.003], [0.003, 0.004]])
    assert spread @ axis == pytest.approx((large.width / 6.0) ** 2 * axis)
    (missed,) = [line for line in world.lines if line.get_label() == 'missed']
    assert sorted(zip(*missed.get_data())) == [(1.0, 1.5), (1.5, 0.5)]
