"""What only the ground robot's driver does: the laser scan, and Nav2."""

import math
import sys

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from interfaces import played, with_interfaces
from numpy.testing import assert_allclose, assert_array_equal
from robot_team import NANOSECONDS, STEP, TURTLEBOT, parameters_of, stamped
from sensor_msgs.msg import LaserScan

from maasi_drivers.drivers import TurtlebotDriver
from maasi_filter.geometry.area import Area
from maasi_filter.ros.conversions import stamp_from_ros
from maasi_filter.ros.qos import RELIABLE
from maasi_msgs.msg import AgentState
from maasi_sim.simulation.sensors import LaserScanner, LaserSettings
from maasi_sim.simulation.sim_topics import scan_message

SCANNING = {'scan': {'timeout': 1.0, 'blocked_timeout': 3.0}}


class Scanned:
    """A team whose robot has a scanner, among obstacles that nobody told the driver of."""

    def __init__(self, team, centres=(), radii=()):
        self.team = team
        self.centres, self.radii = np.reshape(centres, (-1, 2)), np.array(radii, dtype=float)
        area = Area(team.settings.environment)
        self.scanner = LaserScanner(LaserSettings(), area, 1, 'rover')
        self.publisher = team.create_publisher(LaserScan, 'scan', RELIABLE)
        team.until(self.publisher.get_subscription_count)

    def message(self):
        step = max(self.team.step, 0)
        ranges = self.scanner.scan(
            self.team.body.robot_state().pose, step, self.centres, self.radii
        )
        message = scan_message(self.scanner.settings, 'rover/base_scan')
        message.ranges = ranges.tolist()
        return stamped(message, step * NANOSECONDS)

    def move(self, scan=True):
        self.team.move()
        if scan and self.team.step % 4 == 0:
            self.publisher.publish(self.message())
        gaps = np.hypot(*(self.centres - self.team.position[:2]).T) - self.radii
        assert gaps.min(initial=math.inf) > self.team.settings.radius


def test_without_a_scan_that_makes_sense_the_robot_is_stopped(play):
    driver, team = play(**SCANNING)
    robot = Scanned(team)
    robot.move()
    _, result = team.send_accepted([1.4, 1.5, 0.0])
    for _ in range(20):
        robot.move()
    assert team.state.goal_status == AgentState.MOVING
    bad, empty = robot.message(), robot.message()
    bad.angle_increment, empty.ranges = math.nan, []
    for message in (bad, empty):
        robot.publisher.publish(message)
    team.until(lambda: driver.dropped['scan'] == 2)
    team.until(lambda: robot.move(scan=False) or team.state.goal_status == AgentState.UNAVAILABLE)
    assert (team.step - 20) * STEP <= 1.5
    assert_array_equal(team.command, np.zeros(4))
    assert 'no scan for' in team.aborted(result) and 'no scan for' in team.state.reason
    team.until(lambda: robot.move() or team.state.goal_status == AgentState.ABORTED)
    assert team.accepts([1.4, 1.5, 0.0], live=robot.move)


def test_a_waypoint_that_cannot_be_reached_is_given_up(play):
    _, team = play(**SCANNING)
    robot = Scanned(team, [[0.9, 0.3]], [0.2])
    robot.move()
    _, result = team.send_accepted([0.9, 0.3, 0.0])
    reason = team.aborted(result, live=robot.move)
    assert 'blocked: ' in reason
    assert_array_equal(team.command, np.zeros(4))


# ---- Nav2 ------------------------------------------------------------------------------------


@pytest.fixture(scope='module')
def with_nav2(request):
    """Return an environment with nav2_msgs."""
    return with_interfaces('nav2_msgs', request.config.cache)


@pytest.fixture
def nav2(context, with_nav2):
    """Start what plays Nav2; return a queue of what it says, and its process."""
    with played(with_nav2, 'play_nav2.py') as made:
        yield made


@pytest.fixture
def stand(team):
    """Let the driver have odometry, but no motion: that is Nav2's."""
    return lambda: team.say() or team.executor_used.spin_once(timeout_sec=0.02)


@pytest.fixture
def await_event(team, stand, nav2):
    """Wait until Nav2 says an event; return all that it said up to it."""

    def await_event(event):
        lines = []
        while not lines or lines[-1]['event'] != event:
            team.until(lambda: stand() or not nav2[0].empty(), f'Nav2 never said {event}')
            lines.append(nav2[0].get())
        return lines

    return await_event


def send_first(team, position, stand):
    """Send a goal until Nav2 is there: the driver may find it later than the team the driver."""
    moving = AgentState.MOVING
    while True:
        _, result = team.send_accepted(position, live=stand)
        team.until(lambda r=result: stand() or r.done() or team.state.goal_status == moving)
        if not result.done() or result.result().result.reached:
            return result
        assert 'Nav2 not available' in result.result().result.reason


def test_nav2_drives_to_the_waypoints(nav2, with_nav2, process, team, stand, await_event):
    process(environment=with_nav2, navigation='nav2', pose_source='odometry', odometry_timeout=0.5)
    team.connect()
    team.awaken()

    def send(x):
        return team.send_accepted([x, 0.8, 0.0], live=stand)

    def nothing_is_commanded():
        since = team.step
        team.until(lambda: stand() or team.state.step > since + 10)
        sent = [stamp_from_ros(item.header.stamp) for item in team.commands]
        assert max(sent) <= since * NANOSECONDS

    # Reached.
    result = send_first(team, [0.3, 0.8, 0.0], stand)
    line = await_event('goal')[-1]
    assert line['frame'] == 'map'
    assert_allclose(line['position'], [0.3, 0.8, 0.0])
    offset = np.array([0.3, 0.8]) - team.start.position[:2]
    assert_allclose(2.0 * math.atan2(*line['turn']), math.atan2(*offset[::-1]), atol=0.02)
    team.ended(result, stand)
    assert result.result().result.reached
    # Given up by Nav2, and refused by it.
    assert 'Nav2 aborted it, error 208' in team.aborted(send(1.2)[1], stand)
    assert 'Nav2 rejected' in team.aborted(send(1.8)[1], stand)
    # While it drives the commands are Nav2's. A new goal preempts; Nav2 receives a cancellation.
    replaced = send(0.7)[1]
    await_event('goal')
    nothing_is_commanded()
    handle, result = send(0.9)
    lines = await_event('preempted')
    # Its own stop of the goal before would be one of the robot.
    assert 'cancelled' not in [line['event'] for line in lines]
    assert lines[-1]['position'][0] == pytest.approx(0.7)
    assert team.aborted(replaced, stand) == 'replaced'
    nothing_is_commanded()
    handle.cancel_goal_async()
    assert await_event('cancelled')[-1]['position'][0] == pytest.approx(0.9)
    assert team.ended(result, stand)[0] == GoalStatus.STATUS_CANCELED
    assert_array_equal(team.command, np.zeros(4))
    # Cancelled before Nav2 has answered.
    handle, result = send(0.95)
    handle.cancel_goal_async()
    assert await_event('cancelled')[-1]['position'][0] == pytest.approx(0.95)
    assert team.ended(result, stand)[0] == GoalStatus.STATUS_CANCELED
    # Refused by Nav2 while it drives: it stops.
    send(0.7)
    await_event('goal')
    result = send(1.8)[1]
    assert await_event('cancelled')[-1]['position'][0] == pytest.approx(0.7)
    assert 'Nav2 rejected' in team.aborted(result, stand)
    # A pose that hangs while the odometry's velocity says that it should not.
    result = send(0.7)[1]
    await_event('goal')
    team.body.step([0.2, 0.0, 0.0, 0.0], 1.0)
    assert await_event('cancelled')[-1]['position'][0] == pytest.approx(0.7)
    assert 'the pose has not changed for' in team.aborted(result, stand)
    team.body.step([0.0, 0.0, 0.0, 0.0], 2.0)
    team.until(lambda: stand() or team.state.goal_status == AgentState.ABORTED)
    # Nav2 dies while it drives.
    result = send(0.7)[1]
    await_event('goal')
    nav2[1].kill()
    reason = team.aborted(result, stand)
    assert_array_equal(team.command, np.zeros(4))
    # On a busy machine odometry may have been missed first, so it is sent until Nav2 is the reason.
    while 'Nav2' not in reason:
        assert 'no odometry for' in reason
        reason = team.aborted(send(0.7)[1], stand)
    assert 'no answer or feedback from Nav2' in reason or 'Nav2 not' in reason


def test_nav2_does_not_drive_a_robot_whose_pose_is_not_known(nav2, with_nav2, process, make_team):
    said, _ = nav2
    process(environment=with_nav2, navigation='nav2')
    team = make_team(TURTLEBOT | {'navigation': 'nav2'})
    team.connect()
    while 'Nav2 not available' in (reason := team.refused([0.7, 0.8, 0.0])):
        pass
    # Targets are placed in the frame in which Nav2 drives.
    assert reason == 'no pose on tf received yet'
    assert said.empty()


def test_nav2_that_is_not_installed_is_said(start_node, monkeypatch):
    # None stands for a module that cannot be imported, also where Nav2 is installed.
    monkeypatch.setitem(sys.modules, 'nav2_msgs', None)
    settings = TURTLEBOT | {'navigation': 'nav2', 'pose_source': 'odometry'}
    driver = start_node(TurtlebotDriver, parameter_overrides=parameters_of(settings))
    assert driver.trigger_configure().name == 'FAILURE'
    assert 'the package nav2_msgs is not installed' in driver.problem
