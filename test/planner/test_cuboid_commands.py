"""The planner of buildings moves its robot only after `start`, and stops it by the services."""

import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from own_context import own_context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from waiting import wait_until

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.parameters import flatten
from maasi_filter.ros.qos import RELIABLE
from maasi_filter.ros.run_node import executor_of
from maasi_msgs.msg import AgentState, CuboidDecision, SearchLink, SearchLinkArray
from maasi_planner.buildings.cuboid_planner_node import CuboidPlannerNode
from maasi_planner.buildings.settings import CuboidPlannerSettings

SETTINGS = CuboidPlannerSettings.model_validate(
    {
        'environment': {'bounds': [[0.0, 100.0], [0.0, 100.0], [0.0, 40.0]]},
        'start': [20.0, 20.0, 5.0],
        'objects': [[60.0, 60.0, 10.0, 20.0, 20.0, 20.0]],
        'hazard': {'failures': False},
    }
)


class Flight:
    """A drone that flies as it is commanded, step by step, without other robots."""

    def __init__(self, context):
        self.node = Node('flight', context=context)
        self.planner = CuboidPlannerNode(
            context=context,
            namespace='/rover',
            parameter_overrides=[
                Parameter(name, value=value) for name, value in flatten(SETTINGS).items()
            ],
        )
        assert self.planner.trigger_configure().name == 'SUCCESS'
        assert self.planner.trigger_activate().name == 'SUCCESS'
        self.own = executor_of(self.planner, context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.commands, self.states, self.links, self.decisions = [], [], [], []
        node = self.node
        node.create_subscription(TwistStamped, 'rover/cmd_vel', self.commands.append, RELIABLE)
        node.create_subscription(AgentState, 'rover/state', self.states.append, RELIABLE)
        node.create_subscription(SearchLink, 'rover/link/tx', self.links.append, RELIABLE)
        node.create_subscription(CuboidDecision, 'rover/decision', self.decisions.append, RELIABLE)
        self.odometry = node.create_publisher(Odometry, 'rover/odom', RELIABLE)
        self.heard = node.create_publisher(SearchLinkArray, 'rover/link/rx', RELIABLE)
        self.step, self.place = 0, [0.0, 0.0, 0.0]
        self.until(
            lambda: (
                self.odometry.get_subscription_count() == 1
                and self.heard.get_subscription_count() == 1
                and all(
                    self.node.count_publishers(f'rover/{topic}') == 1
                    for topic in ('cmd_vel', 'state', 'link/tx', 'decision')
                )
            )
        )

    def turn(self):
        self.own.spin_once(0.005)
        self.executor.spin_once(timeout_sec=0.005)

    def until(self, condition):
        wait_until(condition, self.turn)

    def move(self):
        """Do a step with the last command, until the robot has told its state to the others."""
        self.step += 1
        message = Odometry()
        message.header.stamp = stamp_to_ros(self.step * 1_000_000_000)
        velocity = self.command
        self.place = [place + speed for place, speed in zip(self.place, velocity, strict=True)]
        point, twist = message.pose.pose.position, message.twist.twist.linear
        point.x, point.y, point.z = self.place
        twist.x, twist.y, twist.z = velocity
        message.pose.pose.orientation.w = 1.0
        self.odometry.publish(message)
        self.until(lambda: self.links and self.links[-1].step == self.step)

    def fly(self, steps):
        """Do steps, also hearing that nobody is in range; return the commands that came in them."""
        given = []
        for _ in range(steps):
            self.move()
            self.heard.publish(SearchLinkArray(step=self.step))
            self.until(lambda: self.states and self.states[-1].step == self.step)
            self.until(lambda: self.commands[-1].header.stamp.sec == self.step)
            given.append(self.command)
        return given

    @property
    def command(self):
        if not self.commands:
            return [0.0, 0.0, 0.0]
        linear = self.commands[-1].twist.linear
        return [linear.x, linear.y, linear.z]

    def call(self, word):
        client = self.node.create_client(Trigger, f'rover/search/{word}')
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        self.node.destroy_client(client)
        return future.result()


@pytest.fixture
def flight():
    with own_context() as context:
        flight = Flight(context)
        yield flight
        flight.own.shutdown()
        flight.executor.shutdown()
        flight.planner.destroy_node()
        flight.node.destroy_node()


def test_a_robot_among_buildings_moves_only_while_it_searches(flight):
    still = [0.0, 0.0, 0.0]
    assert flight.fly(3) == [still] * 3
    assert flight.states[-1].goal_status == AgentState.IDLE
    assert flight.states[-1].reason == 'waiting for start'
    assert not flight.call('pause').success
    home = flight.call('home')
    assert not home.success and 'no home' in home.message
    assert flight.call('start').success
    assert any(command != still for command in flight.fly(3))
    assert flight.states[-1].goal_status == AgentState.MOVING
    frames = [item[-1].header.frame_id for item in (flight.states, flight.commands)]
    assert frames == ['map', 'rover/base_link']
    known = len(flight.commands)
    assert flight.call('pause').success
    # At once, not with the next step.
    flight.until(lambda: len(flight.commands) > known)
    assert flight.command == still
    assert flight.fly(2) == [still] * 2
    assert flight.states[-1].reason == 'paused'
    assert flight.call('resume').success
    assert any(command != still for command in flight.fly(3))
    assert flight.call('stop').success
    flight.until(lambda: flight.command == still)
    assert flight.fly(2) == [still] * 2
    assert not flight.call('resume').success


def test_a_snapshot_of_a_step_without_decision_is_in_the_next_decision(flight):
    assert flight.call('start').success
    flight.fly(1)
    centre = flight.planner.agent.mission.centres[0]
    flight.place = list(centre - SETTINGS.start - flight.command)  # odom begins at the start
    flight.move()
    assert flight.links[-1].visited[0]
    assert flight.decisions[-1].step < flight.step
    flight.fly(1)
    flight.until(lambda: flight.decisions[-1].step == flight.step)
    assert 0 in [shot.cuboid for shot in flight.decisions[-1].snapshots]
    assert [shot.cuboid for decision in flight.decisions[:-1] for shot in decision.snapshots] == []
    flight.fly(1)
    flight.until(lambda: flight.decisions[-1].step == flight.step)
    assert 0 not in [shot.cuboid for shot in flight.decisions[-1].snapshots]
