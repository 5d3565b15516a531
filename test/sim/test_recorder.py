"""The recorder: what it writes down, and with which time."""

import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from small_field import SMALL_FIELD
from waiting import wait_until

from maasi_filter.ros.conversions import stamp_from_ros, stamp_to_ros
from maasi_filter.ros.qos import RELIABLE
from maasi_msgs.msg import AgentState, BatchMember, DetectionArray, FilterUpdate, LockstepStep
from maasi_sim.run import recorder_node
from maasi_sim.run.bag import Bag, BagWriter, load_types
from maasi_sim.run.log import RunEnd
from maasi_sim.run.missions import load_mission
from maasi_sim.run.recorder_node import Recorder
from maasi_sim.run.topics import STEP

SCENARIO = SMALL_FIELD | {'robots': {'rover': SMALL_FIELD['robots']['drone']}}


class Session:
    def __init__(self, folder, number, context):
        file = folder / 'scenario.yaml'
        file.write_text(yaml.safe_dump(SCENARIO))
        types = load_types()
        mission = load_mission(file)
        self.path = folder / 'bag'
        self.bag = BagWriter(self.path, types)
        self.recorder = Recorder(number, mission.observer(types), mission.scenario.step, self.bag)
        self.node = rclpy.create_node('robot', context=context)
        self.clock = self.node.create_publisher(Clock, '/clock', RELIABLE)
        self.odometry = self.node.create_publisher(Odometry, '/rover/odom', RELIABLE)

    def turn(self, limit=None):
        self.recorder.discover()
        time.sleep(0.02)
        self.recorder.drain(limit)

    def until(self, condition):
        wait_until(condition, self.turn)

    def connect(self, *publishers):
        own = publishers or (self.clock, self.odometry)
        self.until(lambda: all(item.get_subscription_count() for item in own))
        self.until(lambda: not self.recorder.unmatched())

    def move(self, *times):
        before = self.recorder.last_seen.get('/rover/odom')
        for nanoseconds in times:
            message = Odometry()
            message.header.stamp = stamp_to_ros(nanoseconds)
            self.odometry.publish(message)
        self.until(lambda: self.recorder.last_seen.get('/rover/odom') != before)

    def tell(self, nanoseconds):
        self.clock.publish(Clock(clock=stamp_to_ros(nanoseconds)))
        self.until(lambda: self.recorder.time == nanoseconds)

    def odometry_in_bag(self):
        """Return stamp and log time of each message [ns], once all is written."""
        self.recorder.finish()
        self.recorder.drain()
        self.bag.close()
        with Bag(self.path) as bag:
            read = list(bag.messages(['/rover/odom']))
        return [(stamp_from_ros(item.message.header.stamp), item.time) for item in read]


@pytest.fixture
def session(tmp_path, domain, context):
    made = Session(tmp_path, domain.number, context)
    yield made
    made.bag.close()
    made.recorder.close()
    made.node.destroy_node()


def test_no_stamp_is_ahead_of_the_time_of_its_message(session):
    session.connect()
    session.tell(10**9)
    session.move(2 * 10**9)
    session.tell(2 * 10**9)
    # One stamped by another clock is recorded at once.
    session.move(2 * 10**9 + 1, 1_700_000_000 * 10**9)
    session.tell(3 * 10**9)
    read = sorted(session.odometry_in_bag())
    assert [stamp for stamp, _ in read] == [2 * 10**9, 2 * 10**9 + 1, 1_700_000_000 * 10**9]
    assert all(stamp <= log_time < 3 * 10**9 for stamp, log_time in read[:2]), read
    assert 2 * 10**9 <= read[2][1] < 3 * 10**9


def test_what_belongs_to_the_step_at_the_limit_is_dropped_also_before_that_step(session):
    steps = session.node.create_publisher(LockstepStep, '/lockstep/step', RELIABLE)
    session.connect(steps, session.odometry)
    for number in (3, 4):
        steps.publish(LockstepStep(step=number, stamp=stamp_to_ros(number * 10**8)))
        wait_until(lambda n=number: session.recorder.step == n, lambda: session.turn(2 * 10**8))
    for stamp in (5 * 10**8, 4 * 10**8):
        message = Odometry()
        message.header.stamp = stamp_to_ros(stamp)
        session.odometry.publish(message)
    seen = session.recorder.last_seen
    wait_until(lambda: '/rover/odom' in seen, lambda: session.turn(2 * 10**8))
    assert [stamp for stamp, _ in session.odometry_in_bag()] == [4 * 10**8]


def test_the_share_explored_is_that_of_the_planners_diagnostics(session):
    publisher = session.node.create_publisher(DiagnosticArray, '/diagnostics', 10)
    session.connect(publisher)
    for name, value in (('/planner_node', '0.25'), ('/planner_node', '?'), ('/camera', '0.9')):
        values = [KeyValue(key='explored', value=value)]
        publisher.publish(DiagnosticArray(status=[DiagnosticStatus(name=name, values=values)]))
    session.until(lambda: '/camera' in session.recorder.pop_heartbeats())
    assert session.recorder.explored == 0.25
    error, fine = DiagnosticStatus.ERROR, DiagnosticStatus.OK
    # An error is a complaint once, until it is over.
    for level, complaints in ((error, 1), (error, 0), (fine, 0), (error, 1)):
        status = DiagnosticStatus(name='/planner_node', level=level, message='refused')
        publisher.publish(DiagnosticArray(status=[status]))
        session.until(lambda: '/planner_node' in session.recorder.pop_heartbeats())
        assert session.recorder.pop_complaints() == ['/planner_node: refused'] * complaints
    session.connect()
    assert session.recorder.unmatched() == []
    loose = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    other = session.node.create_publisher(Odometry, '/rover/odom', loose)
    # The reader that is there already is reliable.
    session.until(lambda: session.recorder.unmatched() == ['/rover/odom'])
    session.node.destroy_publisher(other)
    session.until(lambda: session.recorder.unmatched() == [])


LATE, STATE = 'the recording lacks the first 6.0 s of /rover/state', '/rover/state'


def test_topics_of_each_step_that_are_missing_or_begin_late_are_gaps(session):
    recorder = session.recorder
    recorder.time = 40 * 10**9
    for joined, first, gaps in (
        (False, {STEP: 0, STATE: 0}, []),
        (False, {STEP: 0, STATE: 6}, [LATE]),
        (False, {STEP: 0}, [f'the recording lacks {STATE}']),
        (True, {STEP: 30, STATE: 31}, []),
        (True, {STEP: 30, STATE: 36}, [LATE]),
        (True, {STEP: 30, STATE: 0}, []),
        # Without any step its robots are unknown.
        (True, {}, [f'the recording lacks {STEP}']),
    ):
        recorder.first = {topic: time * 10**9 for topic, time in first.items()}
        recorder.robots = ['rover'] if first else []
        assert recorder.gaps(joined, patience=5.0) == gaps


def test_a_state_of_the_last_step_counts_also_after_the_end(session):
    steps = session.node.create_publisher(LockstepStep, '/lockstep/step', RELIABLE)
    states = session.node.create_publisher(AgentState, '/rover/state', RELIABLE)
    session.connect(steps, states)
    stamps = {step: stamp_to_ros(step * 10**8) for step in (3, 4)}
    steps.publish(LockstepStep(step=3, robots=['rover'], stamp=stamps[3]))
    session.until(lambda: session.recorder.step == 3)
    session.recorder.finish()
    for step in (4, 3):
        state = AgentState(step=step, robot='rover')
        state.header.stamp = stamps[step]
        state.pose.pose.position.x = 0.1 * step
        states.publish(state)
    session.until(lambda: '/rover/state' in session.recorder.last_seen)
    record = session.recorder.observer.record(RunEnd('time_limit', 10.0, 1.0))
    assert [place[1] for place in record.trajectories['rover']] == pytest.approx([0.3])


@pytest.mark.parametrize('seed', range(3))
def test_the_recording_holds_what_the_updates_up_to_the_end_used(session, seed):
    draw, last = np.random.default_rng(seed), 20
    steps, updates, seen = (
        session.node.create_publisher(kind, topic, RELIABLE)
        for kind, topic in (
            (LockstepStep, STEP),
            (FilterUpdate, '/filter_update'),
            (DetectionArray, '/rover/detections'),
        )
    )
    session.connect(steps, updates, seen)
    recorder = session.recorder
    # A robot measures up to four steps after it was asked, and messages overtake each other.
    asked = np.arange(1, last + 5)
    measured = asked + draw.integers(0, 5, len(asked))
    late = measured + draw.integers(0, 3, len(asked))
    for step in range(1, last + 1):
        for index in np.flatnonzero(late == step).tolist():
            publish_detections(seen, index, int(measured[index]))
        publish_update(updates, step, asked.tolist().index(step))
        steps.publish(LockstepStep(step=step, robots=['rover'], stamp=stamp_to_ros(step * 10**8)))
        if draw.random() < 0.5:
            session.turn()
    session.until(lambda: recorder.step == last)
    recorder.observer.end_step = last
    rest = [index for index in range(len(asked)) if late[index] > last]
    after = threading.Timer(
        0.1, lambda: [publish_detections(seen, index, int(measured[index])) for index in rest]
    )
    after.start()
    recorder.finish()
    after.join()
    assert recorder.observer.lacking(last) == []
    recorder.drain()
    session.bag.close()
    with Bag(session.path) as bag:
        held = {item.message.measurement for item in bag.messages(['/rover/detections'])}
    used = set(np.flatnonzero(asked <= last).tolist())
    assert used <= held <= used | set(np.flatnonzero(measured <= last).tolist())


def publish_detections(publisher, index, step):
    message = DetectionArray(measurement=index, step=step, robot='rover')
    message.header.stamp = stamp_to_ros(step * 10**8)
    message.pose.pose.orientation.w = 1.0
    publisher.publish(message)


def publish_update(publisher, step, index):
    message = FilterUpdate(batch_id=step, step=step)
    message.header.stamp = stamp_to_ros(step * 10**8)
    message.members = [BatchMember(robot='rover', measurement=index)]
    publisher.publish(message)


def test_a_measurement_that_never_arrives_is_a_gap(session, monkeypatch):
    monkeypatch.setattr(recorder_node, '_LAST_PATIENCE', 0.1)
    steps = session.node.create_publisher(LockstepStep, STEP, RELIABLE)
    updates = session.node.create_publisher(FilterUpdate, '/filter_update', RELIABLE)
    session.connect(steps, updates)
    publish_update(updates, 1, 7)
    steps.publish(LockstepStep(step=1, robots=['rover'], stamp=stamp_to_ros(10**8)))
    session.until(lambda: session.recorder.step == 1)
    session.until(lambda: '/filter_update' in session.recorder.last_seen)
    session.recorder.finish()
    lacks = 'the recording lacks measurement 7 of rover, used by an update'
    assert lacks in session.recorder.gaps(False, 5.0)


PEER = """
import rclpy
from maasi_filter.ros.qos import LATCHED, RELIABLE
from maasi_msgs.msg import AgentState, LockstepDone
rclpy.init()
node = rclpy.create_node('peer')
states = node.create_publisher(AgentState, '/rover/state', RELIABLE)
ready = node.create_publisher(LockstepDone, '/lockstep/ready', LATCHED)
ready.publish(LockstepDone(node='/peer'))
rclpy.spin(node)
"""


def test_a_node_that_does_not_know_the_recorder_yet_is_waited_for(session):
    recorder = session.recorder
    peer = subprocess.Popen([sys.executable, '-c', PEER])
    try:
        publishers = recorder.node.count_publishers
        wait_until(lambda: '/peer' in recorder.receive_ready() and publishers('/rover/state'))
        # It learns of no subscription that is made from now on, as on a busy machine.
        peer.send_signal(signal.SIGSTOP)
        session.turn()
        session.until(lambda: not recorder.unmatched())
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            assert recorder.unanswered(['/peer']) == ['/peer']
            session.turn()
        peer.send_signal(signal.SIGCONT)
        session.until(lambda: not recorder.unanswered(['/peer']))
        # Of a node that is started again the report of the process before does not count.
        recorder.ready.discard('/peer')
        assert '/peer' not in recorder.receive_ready()
    finally:
        peer.kill()
        peer.wait()
