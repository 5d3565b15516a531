"""Timeouts of filter and planner are in simulated time."""

import time
from contextlib import closing

import pytest
from node_kinds import KINDS
from player import Player
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.qos import RELIABLE, UPDATES
from maasi_msgs.msg import AgentState, BatchMember, FilterUpdate, MeasurementBatch

SECOND = 1_000_000_000
TIMEOUT = 0.3


class World(Player):
    def __init__(self, context, kind, **changes):
        super().__init__(context, 'world')
        self.start(KINDS[kind].made, KINDS[kind].settings.model_copy(update=changes))
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

    def wait_in_vain(self):
        """Let much more wall time pass than a timeout."""
        end = time.monotonic() + 4.0 * TIMEOUT
        self.until(lambda: time.monotonic() > end)


@pytest.fixture
def world(context, request):
    with closing(World(context, **request.param)) as made:
        yield made


@pytest.mark.parametrize('world', [{'kind': 'filter', 'batch_timeout': TIMEOUT}], indirect=True)
def test_a_batch_is_given_up_in_simulated_time(world):
    updates = world.collect(FilterUpdate, '/filter_update', UPDATES)
    world.until(lambda: world.node.count_publishers('/filter_update'))
    # Its robot never answers.
    members = [BatchMember(robot='rover', measurement=1)]
    batch = MeasurementBatch(id=1, step=1, members=members)
    world.publisher(MeasurementBatch, '/measurement_batch').publish(batch)
    world.until(lambda: world.tested.batches.pending)
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
    world.until(lambda: 'rover' in node.states and 'rover' not in node._away)
    world.wait_in_vain()
    assert 'rover' not in node._away
    world.tell(2 * SECOND)
    world.until(lambda: 'rover' in node._away)
