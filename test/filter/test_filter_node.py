"""The filter node over real topics: batches, faults, and what it says of it."""

import math
import time
from collections import Counter
from contextlib import contextmanager
from functools import reduce

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from own_context import own_context
from player import Player
from pymap3d import geodetic2enu
from rcl_interfaces.msg import Log
from searches import same
from waiting import PATIENCE

from maasi_filter import FilterSettings, make_filter
from maasi_filter.filter_node import FilterNode
from maasi_filter.geometry.geodesy import OriginSettings
from maasi_filter.ros.conversions import MOST_DETECTIONS
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE, UPDATES
from maasi_msgs.msg import (
    BatchMember,
    Detection,
    DetectionArray,
    FilterUpdate,
    FoundFixArray,
    FoundTargetArray,
    KeepOuts,
    MeasurementBatch,
)

BOX = {'kind': 'box', 'probability': 0.98, 'lower': [-0.5, -0.5], 'upper': [0.5, 0.5]}
NOISE = {'range': 0.01, 'bearing': 0.03}
SETTINGS = FilterNodeSettings.model_validate(
    {
        'environment': {'bounds': [[0.0, 2.0], [0.0, 2.0]]},
        'filter': {'method': 'pmb'},
        'robots': {name: {'sensor': {'detection': BOX, 'noise': NOISE}} for name in ('a', 'b')},
        'batch_timeout': 0.3,
    }
)


class Team(Player):
    """The rest of the team: planner and drivers."""

    def __init__(self, context):
        super().__init__(context, 'team')
        self.updates = self.collect(FilterUpdate, 'filter_update', UPDATES)
        self.found = self.collect(FoundTargetArray, 'found_targets', LATCHED)
        self.batch = self.node.create_publisher(MeasurementBatch, 'measurement_batch', RELIABLE)
        self.detections = {
            name: self.node.create_publisher(DetectionArray, f'{name}/detections', RELIABLE)
            for name in ('a', 'b')
        }
        self.counts = dict.fromkeys(('a', 'b'), 0)

    def measure(self, number, seen, robots=None, **changes):
        """Publish a batch, and what its robots see from (1, 1): lists of range and bearing."""
        members = [
            BatchMember(robot=name, measurement=self.counts[name]) for name in robots or seen
        ]
        stamp = rclpy.time.Time(seconds=0.1 * number).to_msg()
        self.batch.publish(MeasurementBatch(id=number, step=number, stamp=stamp, members=members))
        for name, values in seen.items():
            message = DetectionArray(
                batch_id=number, step=number, robot=name, measurement=self.counts[name]
            )
            message.header.stamp = stamp
            message.header.frame_id = 'map'
            message.pose.pose.position.x = message.pose.pose.position.y = 1.0
            message.pose.pose.orientation.w = 1.0
            message.detections = [Detection(range=float(r), bearing=float(b)) for r, b in values]
            for path, value in changes.items():
                *parts, last = path.split('__')
                setattr(reduce(getattr, parts, message), last, value)
            self.counts[name] += 1
            self.detections[name].publish(message)

    def step(self, number, seen, robots=None, **changes):
        """Play a batch, and return its update."""
        before = len(self.updates)
        self.measure(number, seen, robots, **changes)
        self.until(lambda: len(self.updates) == before + 1)
        return self.updates[-1]

    def see(self, *numbers):
        """Let robot a see two targets once in each of some batches."""
        for number in numbers:
            self.step(number, {'a': [(0.3, 0.5), (0.25, -1.0)]})


@contextmanager
def running(**changes):
    with own_context() as context:
        team = Team(context)
        try:
            team.start(FilterNode, SETTINGS.model_copy(update=changes))
            writers = [team.batch, *team.detections.values()]
            team.until(lambda: all(item.get_subscription_count() for item in writers))
            team.until(lambda: team.node.count_publishers('/filter_update') == 1)
            yield team
        finally:
            team.close()


@pytest.fixture
def team():
    with running() as everything:
        yield everything


SEEN = [(0.3, 0.5)]


def test_a_target_seen_again_and_again_is_found_with_class_and_identity(team):
    for number in range(1, 9):
        detection = Detection(
            range=0.3, bearing=0.5, class_id='ball', score=0.5 + 0.04 * number, identity='tag_7'
        )
        team.step(number, {'a': [], 'b': []}, detections=[detection])
    team.until(lambda: team.found and len(team.found[-1].targets) == 1)
    target = team.found[-1].targets[0]
    assert target.position.x == pytest.approx(1.0 + 0.3 * math.cos(0.5), abs=0.02)
    assert target.position.y == pytest.approx(1.0 + 0.3 * math.sin(0.5), abs=0.02)
    assert (target.class_id, target.score, target.identity) == ('ball', 1.0, 'tag_7')
    assert [update.batch_id for update in team.updates] == list(range(1, 9))
    assert [item.robot for item in team.updates[0].members] == ['a', 'b']
    assert {item.pose.position.x for item in team.updates[-1].members} == {1.0}
    assert not team.tested.dropped
    # A missing robot is named, and its late answer is a separate batch.
    assert list(team.step(9, {'a': []}, ['a', 'b']).missing) == ['b']
    late = DetectionArray(batch_id=9, step=9, robot='b', measurement=team.counts['b'])
    late.header = team.updates[-1].header
    late.pose.pose.orientation.w = 1.0
    team.detections['b'].publish(late)
    team.until(lambda: len(team.updates) == 10)
    assert [item.robot for item in team.updates[9].members] == ['b']


def test_keep_outs_outlive_their_publisher_and_nothing_is_born_in_them(team):
    publisher = team.node.create_publisher(KeepOuts, 'keep_outs', LATCHED)
    team.until(lambda: publisher.get_subscription_count())
    # Around what is seen.
    zone = '1.3 1.1 0.3'
    publisher.publish(KeepOuts(version=4, zones=[zone]))
    team.until(lambda: team.tested.area.region is not None)
    team.node.destroy_publisher(publisher)
    received = team.collect(KeepOuts, 'keep_outs', LATCHED_ALL)
    team.until(lambda: received)
    assert (received[-1].version, list(received[-1].zones)) == (4, ['1.3 1.1 0.3'])
    for number in range(1, 6):
        update = team.step(number, {'a': SEEN})
        assert update.expected_number < 1e-3 and not update.newly_found


def test_found_targets_are_on_the_earth_where_the_map_has_an_origin(team):
    team.step(1, {'a': SEEN})
    assert not team.node.count_publishers('/found_targets/fixes')
    origin = OriginSettings(latitude=-33.0, longitude=18.5, altitude=20.0)
    environment = SETTINGS.environment.model_copy(update={'origin': origin})
    with running(environment=environment) as team:
        team.see(*range(1, 9))
        team.until(lambda: team.found and len(team.found[-1].targets) == 2)
        fixes = team.collect(FoundFixArray, 'found_targets/fixes', LATCHED)
        team.until(lambda: fixes and list(fixes[-1].ids) == [1, 2])
        latest, found = fixes[-1], team.found[-1]
        assert (latest.header, latest.batch_id) == (found.header, found.batch_id)
        for fix, target in zip(latest.fixes, found.targets):
            place = fix.latitude, fix.longitude, fix.altitude
            east, north, up = geodetic2enu(*place, -33.0, 18.5, 20.0)
            assert (east, north, up) == pytest.approx(
                (target.position.x, target.position.y, 0.0), abs=1e-6
            )
            assert np.array_equal(fix.position_covariance, target.covariance)
            assert fix.header.stamp == target.stamp and fix.position_covariance_type == 3


def test_the_filter_of_the_papers_counts_detections_of_found_targets_which_are_no_fault():
    settings = FilterSettings(
        preset='paper_000', found_radius=0.05, removal_distance=0.1, jitter_deviation=0.003
    )
    with running(filter=settings) as team:
        reports = team.collect(DiagnosticArray, '/diagnostics')
        for number in range(1, 20):
            team.step(number, {'a': SEEN, 'b': SEEN})
        status = team.tested.status()
        assert status['found'] == 1 and status['detections of found targets'] > 0
        assert not team.tested.dropped
        reports.clear()
        team.until(lambda: reports)
        status = reports[-1].status[0]
        assert status.level == DiagnosticStatus.OK and status.message == 'active'


def test_detections_that_do_not_fit_are_said_in_log_and_diagnostics(team):
    reports = team.collect(DiagnosticArray, '/diagnostics')
    lines = team.collect(Log, '/rosout', LATCHED_ALL)
    team.until(lambda: team.node.count_publishers('/rosout') >= 2)
    generator = np.random.default_rng(1)
    for number in range(1, 41):
        # Many times the believed noise, once the target is found.
        error = (0.01 if number < 5 else 0.15) * generator.standard_normal()
        team.step(number, {'a': [(0.3 + error, 0.5)]})
    reports.clear()
    team.until(lambda: reports and any('a: detections of found' in item.msg for item in lines))
    status = reports[-1].status[0]
    assert status.level == DiagnosticStatus.WARN
    assert status.message.startswith('active; a: detections of found targets are')


def test_what_is_said_again_counts_once():
    """Planner and drivers do so where a node was started again."""
    with running(batch_timeout=PATIENCE) as team:
        team.measure(1, {'a': SEEN}, ['a', 'b'])
        team.counts['a'] = 0
        team.step(1, {'a': SEEN, 'b': SEEN})
        team.step(2, {'a': []})
        assert [update.batch_id for update in team.updates] == [1, 2]
        assert [item.robot for item in team.updates[0].members] == ['a', 'b']
        assert not team.tested.dropped


WRONG = [
    ({'robot': 'nobody'}, 'bad detections'),
    ({'header__frame_id': 'odom'}, 'bad detections'),
    ({'pose__pose__position__x': math.nan}, 'bad detections'),
    ({'pose__pose__orientation__w': 0.0}, 'bad detections'),
    ({'pose__covariance': [math.nan] * 36}, 'bad detections'),
    ({'detections': [Detection(range=math.nan)]}, 'bad detection'),
    ({'detections': [Detection(range=-1.0)]}, 'bad detection'),
    ({'detections': [Detection(range=1.0, bearing=9.0)]}, 'bad detection'),
    ({'detections': [Detection(range=1.0, covariance=[1.0])]}, 'bad detection'),
    ({'detections': [Detection(range=1.0, covariance=[1.0, 2, 2, 1])]}, 'bad detection'),
]


def test_what_is_wrong_is_dropped_and_counted_and_the_node_goes_on(team):
    reports, dropped = team.collect(DiagnosticArray, '/diagnostics'), Counter()
    for number, (changes, reason) in enumerate(WRONG, start=1):
        assert team.step(number, {'a': SEEN}, **changes).expected_number == 0.0
        dropped[reason] += 1
        assert team.tested.dropped == dropped, changes
        if number == 1:
            team.until(lambda: reports and reports[-1].status[0].level == DiagnosticStatus.WARN)
            assert reports[-1].status[0].message == 'active; dropped: bad detections 1'
    update = team.step(11, {'a': [(0.3, 1e-4 * index) for index in range(4000)]})
    assert team.tested.dropped['too large message'] == 1 and list(update.missing) == ['a']
    for count, number in enumerate((2**64 - 1, 2**63), start=1):
        team.batch.publish(MeasurementBatch(id=number, step=number))
        team.until(lambda count=count: team.tested.dropped['bad batch'] == count)
    update = team.step(12, {'a': SEEN * 3_000})
    assert update.expected_number > 0.0 and update.found == 0 and not update.missing
    assert team.tested.dropped['equal detection'] == 2_999
    begin = time.monotonic()
    team.step(13, {'a': [(0.3 + 1e-5 * k, 0.5) for k in range(3_000)]})
    assert team.tested.dropped['too many detections'] == 3_000 - MOST_DETECTIONS
    assert time.monotonic() - begin < 10.0


def test_one_stamp_before_or_far_after_the_others_does_not_silence_its_robot(team):
    early, future, far = (
        {'header__stamp': rclpy.time.Time(seconds=time).to_msg()} for time in (0.2, 40.0, 1e6)
    )
    for number, change, dropped in (
        (5, {}, 0),
        (6, early, 1),
        (7, future, 1),
        (8, {}, 1),
        (9, far, 2),
        (10, {}, 2),
    ):
        update = team.step(number, {'a': SEEN}, **change)
        assert list(update.missing) == (['a'] if change in (early, far) else [])
        assert team.tested.dropped['bad detections'] == dropped


def test_a_node_saves_on_a_timer_and_another_one_goes_on_to_the_bit(tmp_path):
    file = tmp_path / 'state.maasi'
    with running(save_file=str(file), save_period=0.05) as team:
        team.see(*range(1, 9))
        file.unlink(missing_ok=True)
        team.until(file.exists)
        before = team.tested.filter
    assert len(before.found_targets) == 2
    # The file is the timer's: the node was destroyed without being told to end.
    with running(save_file=str(file)) as team:
        same(team.tested.filter, before)


def test_a_node_that_cannot_save_goes_on(tmp_path):
    with running(save_file=str(tmp_path / 'nowhere' / 'state'), save_period=0.01) as team:
        team.see(1, 2, 3)
        team.tested.trigger_deactivate()
        assert team.updates[-1].found == 2


@pytest.mark.parametrize('wrong', ['damaged', 'elsewhere'])
def test_a_file_that_cannot_be_used_is_refused_with_the_reason(tmp_path, wrong):
    file = tmp_path / 'state.maasi'
    bounds = SETTINGS.environment.array()
    if wrong == 'elsewhere':
        bounds = bounds + 0.5
    make_filter(FilterSettings(), bounds, np.random.default_rng(0)).save(file)
    if wrong == 'damaged':
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(bytes(content))
    reason = 'checksum' if wrong == 'damaged' else 'bounds'
    with (
        pytest.raises(AssertionError, match=f'save_file: .*{reason}'),
        running(save_file=str(file)),
    ):
        pass
