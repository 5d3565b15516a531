"""The planner of buildings moves its robot only after `start`, and stops it by the services."""

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from player import Player

from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.qos import RELIABLE
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
STILL = [0.0, 0.0, 0.0]


class Flight(Player):
    """A drone that flies as it is commanded, step by step, without other robots."""

    def __init__(self, context):
        super().__init__(context, 'flight')
        self.start(CuboidPlannerNode, SETTINGS, namespace='/rover')
        self.commands = self.collect(TwistStamped, 'rover/cmd_vel')
        self.states = self.collect(AgentState, 'rover/state')
        self.links = self.collect(SearchLink, 'rover/link/tx')
        self.decisions = self.collect(CuboidDecision, 'rover/decision')
        self.odometry = self.node.create_publisher(Odometry, 'rover/odom', RELIABLE)
        self.heard = self.node.create_publisher(SearchLinkArray, 'rover/link/rx', RELIABLE)
        self.step, self.place = 0, STILL
        topics = [f'rover/{topic}' for topic in ('cmd_vel', 'state', 'link/tx', 'decision')]
        self.until(
            lambda: (
                self.odometry.get_subscription_count() == 1
                and self.heard.get_subscription_count() == 1
                and all(self.node.count_publishers(topic) == 1 for topic in topics)
            )
        )

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
            return STILL
        linear = self.commands[-1].twist.linear
        return [linear.x, linear.y, linear.z]


def test_a_robot_among_buildings_moves_only_while_it_searches(context):
    flight = Flight(context)

    def moves():
        return any(command != STILL for command in flight.fly(3))

    def shots():
        """Return the cuboids whose snapshots a step's decision has."""
        flight.fly(1)
        flight.until(lambda: flight.decisions and flight.decisions[-1].step == flight.step)
        return [shot.cuboid for shot in flight.decisions[-1].snapshots]

    assert not moves()
    assert flight.states[-1].goal_status == AgentState.IDLE
    assert flight.states[-1].reason == 'waiting for start'
    assert not flight.call('rover/search/pause').success
    home = flight.call('rover/search/home')
    assert not home.success and 'pause, stop' in home.message
    assert flight.call('rover/search/start').success
    assert moves()
    assert flight.states[-1].goal_status == AgentState.MOVING
    frames = [item[-1].header.frame_id for item in (flight.states, flight.commands)]
    assert frames == ['map', 'rover/base_link']
    known = len(flight.commands)
    assert flight.call('rover/search/pause').success
    # At once, not with the next step.
    flight.until(lambda: len(flight.commands) > known)
    assert flight.command == STILL
    assert not moves()
    assert flight.states[-1].reason == 'paused'
    assert flight.call('rover/search/resume').success
    assert moves()
    assert flight.call('rover/search/stop').success
    flight.until(lambda: flight.command == STILL)
    assert not moves()
    assert not flight.call('rover/search/resume').success

    # A snapshot of a step without decision is in the next decision.
    assert flight.call('rover/search/start').success
    assert shots() == []
    centre = flight.tested.agent.mission.centres[0]
    flight.place = list(centre - SETTINGS.start - flight.command)  # odom begins at the start
    flight.move()
    assert flight.links[-1].visited[0]
    assert flight.decisions[-1].step < flight.step
    assert 0 in shots()
    assert 0 not in shots()
    flight.close()
