"""Timeouts of filter and planner are in simulated time."""

import time
from contextlib import closing

import pytest
from node_kinds import KINDS
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from waiting import wait_until

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.qos import RELIABLE, UPDATES
from maasi_filter.ros.run_node import executor_of
from maasi_msgs.msg import AgentState, BatchMember, FilterUpdate, MeasurementBatch

SECOND = 1_000_000_000
TIMEOUT = 0.3


class World:
    def __init__(self, context, kind, **changes):
        self.node = Node('world', context=context)
        self.tested = KINDS[kind].make(context, **changes)
        self.executors = [executor_of(node, context) for node in (self.node, self.tested)]
        assert self.tested.trigger_configure().name == 'SUCCESS', self.tested.problem
        assert self.tested.trigger_activate().name == 'SUCCESS'
        (changed,) = self.tested.set_parameters([Parameter('use_sim_time', value=True)])
        assert changed.successful
        self.clock = self.publisher(Clock, '/clock')
        self.tell(SECOND)

    def publisher(self, kind, topic):
        made = self.node.create_publisher(kind, topic, RELIABLE)
        self.until(made.get_subscription_count)
        return made

    def tell(self, nanoseconds):
        self.clock.publish(Clock(clock=stamp_to_ros(nanoseconds)))
        self.until(lambda: self.tested.get_clock().now().nanoseconds == nanoseconds)

    def until(self, condition):
        wait_until(condition, self.turn)

    def turn(self):
        for executor in self.executors:
            executor.spin_once(0.005)

    def wait_in_vain(self):
        """Let much more wall time pass than a timeout."""
        end = time.monotonic() + 4.0 * TIMEOUT
        while time.monotonic() < end:
            self.turn()

    def close(self):
        for executor in self.executors:
            executor.shutdown()
        self.tested.destroy_node()
        self.node.destroy_node()


@pytest.fixture
def world(context, request):
    with closing(World(context, **request.param)) as made:
        yield made


@pytest.mark.parametrize('world', [{'kind': 'filter', 'batch_timeout': TIMEOUT}], indirect=True)
def test_a_batch_is_given_up_in_simulated_time(world):
    updates = []
    world.node.create_subscription(FilterUpdate, '/filter_update', updates.append, UPDATES)
    world.until(lambda: world.node.count_publishers('/filter_update'))
    # Its robot never answers.
    members = [BatchMember(robot='rover', measurement=1)]
    batch = MeasurementBatch(id=1, step=1, members=members)
    world.publisher(MeasurementBatch, '/measurement_batch').publish(batch)
    world.until(lambda: world.tested._batches.pending)
    world.wait_in_vain()
    assert not updates
    world.tell(2 * SECOND)
    world.until(lambda: updates)
    assert list(updates[0].missing) == ['rover']


@pytest.mark.parametrize('world', [{'kind': 'planner', 'state_timeout': TIMEOUT}], indirect=True)
def test_a_silent_robot_is_left_out_in_simulated_time(world):
    node = world.tested
    state = AgentState(robot='rover', step=1)
    state.header.frame_id = 'map'
    state.pose.pose.position.x, state.pose.pose.position.y = 0.4, 0.3
    state.pose.pose.orientation.w = 1.0
    world.publisher(AgentState, '/rover/state').publish(state)
    world.until(lambda: 'rover' in node._heard and 'rover' not in node._away)
    world.wait_in_vain()
    assert 'rover' not in node._away
    world.tell(2 * SECOND)
    world.until(lambda: 'rover' in node._away)
