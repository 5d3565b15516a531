"""A real `/clock` that goes back: every node lives on, and a robot without a pose stands."""

import signal
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Odometry
from node_kinds import KINDS
from rcl_interfaces.msg import Log
from rclpy.action import ActionClient
from rosgraph_msgs.msg import Clock
from scenario_runs import PATIENCE, Operator, alongside
from waiting import wait_until

from maasi_filter.ros.conversions import stamp_from_ros, stamp_to_ros
from maasi_filter.ros.qos import LATCHED_ALL, RELIABLE
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import AgentState
from maasi_sim.run.processes import NodeProcess

SECOND = 1_000_000_000
JUMPS = tuple(item * SECOND for item in (60, 5, 61, 0, 2))


class World(Operator):
    """Publishes `/clock`, and odometry of a rover; collects the messages of nodes."""

    def __init__(self, domain):
        super().__init__(domain)
        node = self.node
        self.clock = node.create_publisher(Clock, '/clock', RELIABLE)
        self.stamps = {}
        self.names, self.commands, self.states, self.logs = [], [], [], []
        subscribe = node.create_subscription
        subscribe(DiagnosticArray, '/diagnostics', self.on_diagnostics, 10)
        subscribe(Log, '/rosout', lambda item: self.logs.append(item.msg), LATCHED_ALL)
        subscribe(TwistStamped, '/rover/cmd_vel', self.commands.append, RELIABLE)
        subscribe(AgentState, '/rover/state', self.states.append, RELIABLE)
        self.odometry = node.create_publisher(Odometry, '/rover/odom', RELIABLE)

    def on_diagnostics(self, message):
        for status in message.status:
            self.names.append(status.name)
            self.stamps[status.name] = message.header.stamp

    def until(self, condition, *what):
        wait_until(condition, self.listen, *what, limit=PATIENCE)

    def listen(self):
        """Receive messages for a moment."""
        end = time.monotonic() + 0.02
        while (left := end - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=left)

    def tell(self, nanoseconds):
        self.clock.publish(Clock(clock=stamp_to_ros(nanoseconds)))

    def seen_at(self, nanoseconds, nodes):
        """Publish a time until all nodes, name to process, have diagnostics of that time."""
        stamp = stamp_to_ros(nanoseconds)

        def stamped():
            # Best effort: one message may be lost.
            self.tell(nanoseconds)
            for name, process in nodes.items():
                assert process.is_alive(), f'{name} {process.how_it_ended()}'
            # A sim stamps its own with the time that it publishes itself.
            return all(
                name in self.stamps if 'sim' in name else self.stamps.get(name) == stamp
                for name in nodes
            )

        self.until(stamped, f'diagnostics at {nanoseconds}')

    def stands(self):
        """Return whether the last commands are zeros."""
        return len(self.commands) >= 5 and not any(map(moves, self.commands[-5:]))


def moves(command):
    twist = command.twist
    return any((twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z))


@pytest.fixture
def world():
    with alongside(World) as made:
        yield made


@pytest.fixture
def start(tmp_path):
    running = []

    def make(kind, namespace='', **changes):
        command = KINDS[kind].command(tmp_path / f'{kind}.yaml', namespace, **changes)
        command += ['-p', 'use_sim_time:=true']
        running.append(NodeProcess(f'/{kind}', command, tmp_path / f'{kind}.log'))
        running[-1].start()
        return running[-1]

    yield make
    for process in running:
        process.kill()
        process.join()


def interrupted(process):
    process.signal(signal.SIGINT)
    process.join(PATIENCE)
    said = process.last_words(10_000)
    assert process.exitcode == 0 and 'Traceback' not in said, said
    return said


def is_active(world, name):
    client = world.node.create_client(GetState, f'{name}/get_state')
    world.until(client.service_is_ready, f'{name} has no services')
    future = client.call_async(GetState.Request())
    world.until(future.done, f'{name} does not answer')
    world.node.destroy_client(client)
    return future.result().current_state.label == 'active'


def test_every_type_of_node_lives_through_a_clock_that_goes_back(world, start):
    nodes = {f'/{kind}/{made.name}': start(kind, f'/{kind}') for kind, made in KINDS.items()}
    for time_ in JUMPS:
        world.seen_at(time_, nodes)
    assert all(is_active(world, name) for name in nodes)
    for process in nodes.values():
        assert 'clock jumped back by' in interrupted(process), process.name


class Rover:
    """Plays the robot of a driver that has been started."""

    def __init__(self, world):
        self.world = world
        self.now = self.step = 100 * SECOND
        self.position = 0.0
        world.until(world.odometry.get_subscription_count)
        world.until(lambda: world.node.count_publishers('/rover/cmd_vel'))
        self.client = ActionClient(world.node, GoToWaypoint, '/rover/go_to')
        world.until(self.client.server_is_ready)
        world.until(self.move)

    def move(self, step=0.0):
        """Go on in time and place; return whether the driver has answered."""
        states = self.world.states
        if states and stamp_from_ros(states[-1].header.stamp) >= self.step:
            self.now += SECOND // 20
            self.step = self.now
            self.position += step
        else:
            self.now += 1000  # it is waited for
        message = Odometry()
        message.header.stamp = stamp_to_ros(self.now)
        message.header.frame_id = 'odom'
        message.pose.pose.orientation.w = 1.0
        message.pose.pose.position.x = self.position
        # Odometry first: it is best effort, and must not be missing when its time has come.
        self.world.odometry.publish(message)
        self.world.tell(self.now)
        return self.world.commands and states

    def go(self):
        """Send it to a waypoint; return the future result once it moves."""
        goal = GoToWaypoint.Goal(goal_id=1)
        goal.waypoint.header.frame_id = 'map'
        goal.waypoint.pose.position.x, goal.waypoint.pose.position.y = 2.0, 1.0
        handle = self.client.send_goal_async(goal)
        self.world.until(handle.done)
        assert handle.result().accepted
        self.go_on()
        self.world.commands.clear()
        return handle.result().get_result_async()

    def go_on(self):
        self.world.until(lambda: self.move(0.005) and moves(self.world.commands[-1]))


def test_a_robot_stands_when_the_time_jumps_back_and_goes_on_with_a_new_pose(world, start):
    process = start('turtlebot')
    rover = Rover(world)
    result = rover.go()
    # Nothing of the robot comes any more: only the clock, from the start.

    def go_back():
        # Best effort: one message may be lost.
        world.tell(0)
        return result.done()

    world.until(go_back)
    world.until(world.stands)
    assert result.result().result.reason == 'time jumped back'
    world.until(lambda: world.states[-1].goal_status == AgentState.UNAVAILABLE)
    assert 'odometry' in world.states[-1].reason
    rover.now = rover.step = SECOND
    world.until(lambda: rover.move() and world.states[-1].goal_status != AgentState.UNAVAILABLE)
    assert process.is_alive()
    rover.client.destroy()


def test_a_slow_simulated_clock_ends_no_goal_and_leaves_no_robot_moving(world, start):
    start('turtlebot', odometry_timeout=0.5)
    rover = Rover(world)
    result = rover.go()
    # Time and odometry stand still, as on a busy machine; or it is a real robot without odometry.
    world.until(world.stands)
    assert world.states[-1].goal_status == AgentState.MOVING
    assert not result.done()
    rover.go_on()
    assert world.states[-1].goal_status == AgentState.MOVING
    # Now the odometry is silent in simulated time.

    def silent():
        # Odometry may still be on its way, and is then new again.
        rover.now += SECOND // 10
        world.tell(rover.now)
        return world.states[-1].goal_status == AgentState.UNAVAILABLE

    world.until(silent)
    assert 'no odometry for' in world.states[-1].reason
    world.until(result.done)
    rover.client.destroy()


def test_a_missing_clock_is_named(world, start):
    world.node.destroy_publisher(world.clock)
    process = start('guard')
    world.until(lambda: world.names.count('/rover/guard') >= 6)
    assert '/clock' in interrupted(process).partition('waiting for publishers of')[2]


def test_a_second_clock_that_says_zero_does_not_start_the_search_again(world, start):
    process = start('planner')
    nodes = {'/planner_node': process}
    other = world.node.create_publisher(Clock, '/clock', RELIABLE)
    world.until(lambda: other.get_subscription_count() and world.clock.get_subscription_count())

    def warned():
        # Of each publisher only the last message waits for a node that is busy.
        other.publish(Clock())
        world.listen()
        world.tell(SECOND)
        return any('it has 2 publishers (operator), allowed is one' in line for line in world.logs)

    world.seen_at(SECOND, nodes)
    world.until(warned)
    world.seen_at(5 * SECOND, nodes)
    assert 'the search starts again' not in interrupted(process)
