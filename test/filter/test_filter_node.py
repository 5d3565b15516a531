"""The filter node over real topics: batches, faults, and what it says of it."""

import math
import time
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from own_context import own_context
from rcl_interfaces.msg import Log
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from waiting import PATIENCE, wait_until

from maasi_filter import FilterSettings, make_filter
from maasi_filter.filter_node import FilterNode
from maasi_filter.ros.conversions import MOST_DETECTIONS
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.ros.parameters import flatten
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE, UPDATES
from maasi_filter.ros.run_node import executor_of
from maasi_msgs.msg import (
    BatchMember,
    Detection,
    DetectionArray,
    FilterUpdate,
    FoundTargetArray,
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


def overrides(settings):
    return [Parameter(name, value=value) for name, value in flatten(settings).items()]


class Team:
    """The rest of the team: planner and drivers."""

    def __init__(self, context):
        self.node = Node('team', context=context)
        self.updates = []
        self.found = []
        self.batch = self.node.create_publisher(MeasurementBatch, 'measurement_batch', RELIABLE)
        self.detections = {
            name: self.node.create_publisher(DetectionArray, f'{name}/detections', RELIABLE)
            for name in ('a', 'b')
        }
        self.node.create_subscription(FilterUpdate, 'filter_update', self.updates.append, UPDATES)
        self.node.create_subscription(FoundTargetArray, 'found_targets', self.found.append, LATCHED)
        self.counts = dict.fromkeys(('a', 'b'), 0)

    def measure(self, number, robots, seen, **changes):
        """Publish a batch, and what its robots see from (1, 1): lists of range and bearing."""
        members = [BatchMember(robot=name, measurement=self.counts[name]) for name in robots]
        stamp = rclpy.time.Time(seconds=0.1 * number).to_msg()
        self.batch.publish(MeasurementBatch(id=number, step=number, stamp=stamp, members=members))
        for name in robots:
            if name not in seen:
                continue
            message = DetectionArray(
                batch_id=number, step=number, robot=name, measurement=self.counts[name]
            )
            message.header.stamp = stamp
            message.header.frame_id = 'map'
            message.pose.pose.position.x = message.pose.pose.position.y = 1.0
            message.pose.pose.orientation.w = 1.0
            message.detections = [
                Detection(range=float(item[0]), bearing=float(item[1])) for item in seen[name]
            ]
            for path, value in changes.items():
                target = message
                *parts, last = path.split('__')
                for part in parts:
                    target = getattr(target, part)
                setattr(target, last, value)
            self.counts[name] += 1
            self.detections[name].publish(message)


@contextmanager
def running(**changes):
    """Run a node with the team around it; yield both, and how to wait for something."""
    with own_context() as context:
        settings = SETTINGS.model_copy(update=changes)
        node = FilterNode(context=context, parameter_overrides=overrides(settings))
        team = Team(context)
        own = executor_of(node, context)
        other = SingleThreadedExecutor(context=context)
        other.add_node(team.node)

        def turn():
            own.spin_once(0.01)
            other.spin_once(timeout_sec=0.01)

        until = partial(wait_until, turn=turn)

        try:
            assert node.trigger_configure().name == 'SUCCESS', node.problem
            node.trigger_activate()
            until(lambda: team.batch.get_subscription_count() == 1)
            until(lambda: all(item.get_subscription_count() for item in team.detections.values()))
            until(lambda: team.node.count_publishers('/filter_update') == 1)
            yield node, team, until
        finally:
            own.shutdown()
            other.shutdown()
            node.destroy_node()
            team.node.destroy_node()


@pytest.fixture
def world():
    with running() as everything:
        yield everything


def test_a_target_seen_again_and_again_is_found_with_class_and_identity(world):
    node, team, until = world
    for number in range(1, 9):
        detection = Detection(
            range=0.3, bearing=0.5, class_id='ball', score=0.5 + 0.04 * number, identity='tag_7'
        )
        team.measure(number, ['a', 'b'], {'a': [], 'b': []}, detections=[detection])
        until(lambda number=number: len(team.updates) == number)
    until(lambda: team.found and len(team.found[-1].targets) == 1)
    target = team.found[-1].targets[0]
    assert target.position.x == pytest.approx(1.0 + 0.3 * math.cos(0.5), abs=0.02)
    assert target.position.y == pytest.approx(1.0 + 0.3 * math.sin(0.5), abs=0.02)
    assert (target.class_id, target.score, target.identity) == ('ball', 1.0, 'tag_7')
    assert [update.batch_id for update in team.updates] == list(range(1, 9))
    assert [item.robot for item in team.updates[0].members] == ['a', 'b']
    assert {item.pose.position.x for item in team.updates[-1].members} == {1.0}
    assert not node.dropped


def test_the_filter_of_the_papers_counts_detections_of_found_targets_which_are_no_fault():
    settings = FilterSettings(
        preset='paper_000', found_radius=0.05, removal_distance=0.1, jitter_deviation=0.003
    )
    with running(filter=settings) as (node, team, until):
        reports = []
        team.node.create_subscription(DiagnosticArray, '/diagnostics', reports.append, 10)
        for number in range(1, 20):
            team.measure(number, ['a', 'b'], {'a': [(0.3, 0.5)], 'b': [(0.3, 0.5)]})
            until(lambda number=number: len(team.updates) == number)
        until(lambda: team.found and len(team.found[-1].targets) == 1)
        target = team.found[-1].targets[0]
        assert target.position.x == pytest.approx(1.0 + 0.3 * math.cos(0.5), abs=0.02)
        assert target.position.y == pytest.approx(1.0 + 0.3 * math.sin(0.5), abs=0.02)
        assert node.status()['found'] == 1
        assert node.status()['detections of found targets'] > 0
        assert not node.dropped
        reports.clear()
        until(lambda: reports)
        status = reports[-1].status[0]
        assert status.level == DiagnosticStatus.OK and status.message == 'active'


def test_detections_that_do_not_fit_are_said_in_log_and_diagnostics(world):
    _, team, until = world
    reports, lines = [], []
    team.node.create_subscription(DiagnosticArray, '/diagnostics', reports.append, 10)
    team.node.create_subscription(Log, '/rosout', lines.append, LATCHED_ALL)
    until(lambda: team.node.count_publishers('/rosout') >= 2)
    generator = np.random.default_rng(1)
    for number in range(1, 41):
        # Many times the believed noise, once the target is found.
        error = (0.01 if number < 5 else 0.15) * generator.standard_normal()
        team.measure(number, ['a'], {'a': [(0.3 + error, 0.5)]})
        until(lambda number=number: len(team.updates) == number)
    reports.clear()
    until(lambda: reports and any('a: detections of found' in item.msg for item in lines))
    status = reports[-1].status[0]
    assert status.level == DiagnosticStatus.WARN
    assert status.message.startswith('active; a: detections of found targets are')


def test_a_missing_robot_is_named_and_its_late_answer_is_a_batch_of_its_own(world):
    _, team, until = world
    team.measure(1, ['a', 'b'], {'a': []})
    until(lambda: len(team.updates) == 1)
    assert list(team.updates[0].missing) == ['b']
    late = DetectionArray(batch_id=1, step=1, robot='b')
    late.header.frame_id = 'map'
    late.pose.pose.orientation.w = 1.0
    team.detections['b'].publish(late)
    until(lambda: len(team.updates) == 2)
    assert [item.robot for item in team.updates[1].members] == ['b']


def test_what_is_said_again_counts_once():
    """Planner and drivers do so where a node was started again."""
    with running(batch_timeout=PATIENCE) as (node, team, until):
        seen = [(0.3, 0.5)]
        team.measure(1, ['a', 'b'], {'a': seen})
        team.counts['a'] = 0
        team.measure(1, ['a', 'b'], {'a': seen, 'b': seen})
        until(lambda: team.updates)
        team.measure(2, ['a'], {'a': []})
        until(lambda: len(team.updates) == 2)
        assert [update.batch_id for update in team.updates] == [1, 2]
        assert [item.robot for item in team.updates[0].members] == ['a', 'b']
        assert not node.dropped


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'header__frame_id': 'odom'}, 'bad detections'),
        ({'robot': 'nobody'}, 'bad detections'),
        ({'pose__pose__position__x': math.nan}, 'bad detections'),
        ({'pose__pose__orientation__w': 0.0}, 'bad detections'),
        ({'pose__covariance': [math.nan] * 36}, 'bad detections'),
        ({'detections': [Detection(range=math.nan)]}, 'bad detection'),
        ({'detections': [Detection(range=-1.0)]}, 'bad detection'),
        ({'detections': [Detection(range=1.0, bearing=9.0)]}, 'bad detection'),
        ({'detections': [Detection(range=1.0, covariance=[1.0])]}, 'bad detection'),
        (
            {'detections': [Detection(range=1.0, covariance=[1.0, 2.0, 2.0, 1.0])]},
            'bad detection',
        ),
    ],
)
def test_what_is_wrong_is_dropped_and_counted_and_the_node_goes_on(world, changes, reason):
    node, team, until = world
    reports = []
    team.node.create_subscription(DiagnosticArray, '/diagnostics', reports.append, 10)
    team.measure(1, ['a'], {'a': [(0.3, 0.5)]}, **changes)
    until(lambda: len(team.updates) == 1)
    assert node.dropped[reason] == 1
    if changes == {'robot': 'nobody'}:
        until(lambda: reports and reports[-1].status[0].level == DiagnosticStatus.WARN)
        assert reports[-1].status[0].message == 'active; dropped: bad detections 1'
    assert team.updates[0].expected_number == 0.0
    team.measure(2, ['a'], {'a': [(0.3, 0.5)]})
    until(lambda: len(team.updates) == 2)
    assert team.updates[1].expected_number > 0.0


def test_detections_of_a_far_too_large_message_are_not_read(world):
    node, team, until = world
    team.measure(1, ['a'], {'a': [(0.3, 1e-4 * index) for index in range(4000)]})
    until(lambda: len(team.updates) == 1)
    assert node.dropped == {'too large message': 1} and list(team.updates[0].missing) == ['a']
    team.measure(2, ['a'], {'a': [(0.3, 0.5)]})
    until(lambda: len(team.updates) == 2)
    assert not team.updates[1].missing


def test_a_stamp_before_the_last_one_is_dropped(world):
    node, team, until = world
    team.measure(5, ['a'], {'a': []})
    until(lambda: len(team.updates) == 1)
    early = rclpy.time.Time(seconds=0.2).to_msg()
    team.measure(6, ['a'], {'a': []}, header__stamp=early)
    until(lambda: len(team.updates) == 2)
    assert node.dropped['bad detections'] == 1
    assert list(team.updates[1].missing) == ['a']


def test_one_detection_from_the_future_does_not_silence_its_robot(world):
    node, team, until = world
    for number in (1, 2, 3):
        future = {'header__stamp': rclpy.time.Time(seconds=40.0).to_msg()} if number == 2 else {}
        team.measure(number, ['a'], {'a': [(0.3, 0.5)]}, **future)
        until(lambda number=number: len(team.updates) == number)
    far = rclpy.time.Time(seconds=1e6).to_msg()
    team.measure(4, ['a'], {'a': [(0.3, 0.5)]}, header__stamp=far)
    until(lambda: len(team.updates) == 4)
    assert list(team.updates[3].missing) == ['a'] and node.dropped['bad detections'] == 1
    team.measure(5, ['a'], {'a': [(0.3, 0.5)]})
    until(lambda: len(team.updates) == 5)
    assert not team.updates[2].missing and not team.updates[4].missing


def test_detections_that_are_equal_or_too_many_are_counted_and_cost_no_time(world):
    node, team, until = world
    team.measure(1, ['a'], {'a': [(0.3, 0.5)] * 3_000})
    until(lambda: len(team.updates) == 1)
    assert node.dropped['equal detection'] == 2_999
    assert team.updates[0].found == 0
    many = [(0.3 + 1e-5 * k, 0.5) for k in range(3_000)]
    begin = time.monotonic()
    team.measure(2, ['a'], {'a': many})
    until(lambda: len(team.updates) == 2)
    assert node.dropped['too many detections'] == 3_000 - MOST_DETECTIONS
    assert time.monotonic() - begin < 10.0


@pytest.mark.parametrize('number', [2**64 - 1, 2**63])
def test_an_absurd_batch_is_refused_and_the_next_one_is_not(world, number):
    node, team, until = world
    team.measure(1, ['a'], {'a': []})
    until(lambda: len(team.updates) == 1)
    team.batch.publish(MeasurementBatch(id=number, step=number))
    until(lambda: node.dropped['bad batch'] == 1)
    team.measure(2, ['a'], {'a': []})
    until(lambda: len(team.updates) == 2)
    assert team.updates[1].batch_id == 2


def seen_from_a(team, until, numbers):
    for number in numbers:
        before = len(team.updates)
        team.measure(number, ['a'], {'a': [(0.3, 0.5), (0.25, -1.0)]})
        until(lambda before=before: len(team.updates) == before + 1)


def test_a_node_saves_on_a_timer_and_another_one_goes_on_to_the_bit(tmp_path):
    file = tmp_path / 'state.maasi'
    with running() as (_, team, until):
        seen_from_a(team, until, range(1, 9))
        until(lambda: team.found[-1].batch_id == 8)
        expected = [update.expected_number for update in team.updates]
        targets = list(team.found[-1].targets)
    assert len(targets) == 2
    with running(save_file=str(file), save_period=0.05) as (_, team, until):
        seen_from_a(team, until, [1])
        file.unlink(missing_ok=True)
        until(file.exists)
        first = [update.expected_number for update in team.updates]
    # The file is the timer's: the node was destroyed without being told to end.
    with running(save_file=str(file)) as (_, team, until):
        seen_from_a(team, until, range(2, 9))
        until(lambda: team.found[-1].batch_id == 8)
        assert first + [update.expected_number for update in team.updates] == expected
        again = list(team.found[-1].targets)
    assert [target.position for target in again] == [target.position for target in targets]
    assert [list(target.covariance) for target in again] == [
        list(target.covariance) for target in targets
    ]


def test_a_node_that_cannot_save_goes_on(tmp_path):
    with running(save_file=str(tmp_path / 'nowhere' / 'state'), save_period=0.01) as (
        node,
        team,
        until,
    ):
        seen_from_a(team, until, range(1, 4))
        node.trigger_deactivate()
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


def test_a_node_says_once_which_topics_nobody_publishes(world, capfd):
    _, _, until = world
    said = ''

    def has_said():
        nonlocal said
        said += capfd.readouterr().err
        return 'active, waiting for publishers of' in said

    until(has_said)
    assert '/found_targets/kept' in said.partition('waiting for publishers of')[2].splitlines()[0]
