"""Timeouts of filter and planner in simulated time, and their life cycle during a search."""

import time

import pytest
from node_kinds import KINDS
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from waiting import wait_until

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.qos import RELIABLE, UPDATES
from maasi_filter.ros.run_node import executor_of
from maasi_msgs.msg import AgentState, BatchMember, FilterUpdate, MeasurementBatch, PlanDecision

SECOND = 1_000_000_000
TIMEOUT = 0.3


class World(Node):
    """Clock, driver and, of filter and planner, the one that is not tested."""

    def __init__(self, context):
        super().__init__('world', context=context)
        self.clock = self.create_publisher(Clock, '/clock', RELIABLE)
        self.state = self.create_publisher(AgentState, '/rover/state', RELIABLE)
        self.batch = self.create_publisher(MeasurementBatch, '/measurement_batch', RELIABLE)
        self.updates, self.decisions = [], []
        self.create_subscription(FilterUpdate, '/filter_update', self.updates.append, UPDATES)
        self.create_subscription(PlanDecision, '/decisions', self.decisions.append, RELIABLE)
        self.number = 0
        self.own = executor_of(self, context)

    def begin(self, kind, **changes):
        """Start a node; its executor is turned together with that of the world."""
        self.tested = KINDS[kind].make(self.context, **changes)
        self.other = executor_of(self.tested, self.context)
        assert self.tested.trigger_configure().name == 'SUCCESS', self.tested.problem
        assert self.tested.trigger_activate().name == 'SUCCESS'
        return self.tested

    def simulate(self, nanoseconds):
        """Let the node use simulated time."""
        changed = self.tested.set_parameters([Parameter('use_sim_time', value=True)])
        assert changed[0].successful
        self.until(self.clock.get_subscription_count)
        self.tell(nanoseconds)

    def tell(self, nanoseconds):
        self.clock.publish(Clock(clock=stamp_to_ros(nanoseconds)))
        self.until(lambda: self.tested.get_clock().now().nanoseconds == nanoseconds)

    def until(self, condition):
        wait_until(condition, self.turn)

    def turn(self):
        self.own.spin_once(0.005)
        self.other.spin_once(0.005)

    def wait_in_vain(self):
        """Let much more wall time pass than a timeout."""
        end = time.monotonic() + 4.0 * TIMEOUT
        while time.monotonic() < end:
            self.turn()

    def ask(self):
        """Ask the filter for a batch that its robot never answers."""
        self.until(self.batch.get_subscription_count)
        self.number += 1
        members = [BatchMember(robot='rover', measurement=self.number)]
        self.batch.publish(MeasurementBatch(id=self.number, step=self.number, members=members))

    def stand(self, step):
        """Publish a state of the rover."""
        message = AgentState(robot='rover', step=step)
        message.header.frame_id = 'map'
        message.pose.pose.position.x, message.pose.pose.position.y = 0.4, 0.3
        message.pose.pose.orientation.w = 1.0
        self.state.publish(message)

    def close(self):
        self.own.shutdown()
        self.other.shutdown()
        self.tested.destroy_node()
        self.destroy_node()


@pytest.fixture
def world(context):
    made = World(context)
    yield made
    made.close()


def test_a_batch_is_given_up_in_simulated_time(world):
    node = world.begin('filter', batch_timeout=TIMEOUT)
    world.simulate(SECOND)
    world.until(lambda: world.count_publishers('/filter_update'))
    world.ask()
    world.until(lambda: node._batches.pending)
    world.wait_in_vain()
    assert not world.updates
    world.tell(2 * SECOND)
    world.until(lambda: world.updates)
    assert list(world.updates[0].missing) == ['rover']


def test_a_silent_robot_is_left_out_in_simulated_time(world):
    node = world.begin('planner', state_timeout=TIMEOUT)
    world.simulate(SECOND)
    world.until(world.state.get_subscription_count)
    world.stand(1)
    world.until(lambda: 'rover' in node._heard and 'rover' not in node._away)
    world.wait_in_vain()
    assert 'rover' not in node._away
    world.tell(2 * SECOND)
    world.until(lambda: 'rover' in node._away)
