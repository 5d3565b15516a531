"""The simulation node over real topics, against nodes that play the rest of the team."""

import math
import time
from collections import defaultdict
from copy import deepcopy
from operator import attrgetter

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import PoseArray, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, CameraInfo, Image, LaserScan
from visualization_msgs.msg import Marker, MarkerArray
from waiting import wait_until

from maasi_drivers.links.mavlink.link import VehicleLink
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import pose_to_ros, stamp_to_ros
from maasi_filter.ros.qos import LATCHED, RELIABLE
from maasi_msgs.msg import AgentState, LockstepDone, LockstepStep, RangeArray
from maasi_sim.simulation.emulators.mambo.fake_mambo import free_port
from maasi_sim.simulation.sim_node import SimNode

STEP = 0.05
GRID = {'grid': [2, 2], 'spacing': 1.0, 'corner': [0.5, 0.5]}
SCENARIO = {
    'version': 1,
    'environment': {
        'bounds': [[-0.3, 2.4], [-0.3, 2.4]],
        'obstacles': [{'centre': [1.0, 2.0], 'radius': 0.1}],
    },
    'step': STEP,
    'targets': {'positions': [[1.9, 1.95], [0.3, 0.4]]},
    'robots': {
        'mambo': {'type': 'mambo', 'start': [1.9, 1.9, 1.0], 'yaw': 0.5, 'candidates': GRID},
        'turtlebot': {'type': 'turtlebot3_burger', 'start': [0.0] * 3, 'candidates': GRID},
    },
    'stop': 'planner_done',
}
LINKED = {
    'version': 1,
    'environment': {'bounds': [[0.0, 20.0], [0.0, 20.0]]},
    'step': 0.1,
    'targets': {'positions': [[6.0, 10.0]]},
    'robots': {
        'drone': {
            'type': 'mavlink_drone',
            'start': [2.0, 10.0, 1.0],
            'candidates': GRID,
            'sensor': {'detection': {'probability': 1.0}},
            'link': 'mavlink',
            'mavlink': {'arm': True},
            'autopilot': {'estimator_time': 0.2, 'parameters': {'FS_GCS_TIMEOUT': 60.0}},
        }
    },
    'events': [
        {'at': 2.0, 'robot': 'drone', 'do': 'leave'},
        {'at': 5.0, 'robot': 'drone', 'do': 'back'},
    ],
}
FORWARD = (0.2, 0.0, 0.0, 0.0)
TOPICS = {'odom': Odometry, 'camera/image_raw': Image, 'camera/camera_info': CameraInfo}
TOPICS |= {'scan': LaserScan, 'battery_state': BatteryState, 'ranges': RangeArray}


class Member(Node):
    """The driver of a robot, the filter or the planner: sends commands, or says `done`."""

    def __init__(self, context, name, robot=''):
        super().__init__(
            name, context=context, namespace=f'/{robot}', start_parameter_services=False
        )
        self.robot, self.velocity = robot, FORWARD
        self.stamp_shift, self.quiet = 0, False
        self.steps, self.seen = [], defaultdict(list)
        self.ready = self.create_publisher(LockstepDone, '/lockstep/ready', LATCHED)
        self.done = self.create_publisher(LockstepDone, '/lockstep/done', RELIABLE)
        self.create_subscription(LockstepStep, '/lockstep/step', self.on_step, RELIABLE)
        self.command = self.create_publisher(TwistStamped, 'cmd_vel', RELIABLE)
        for topic, kind in TOPICS.items():
            if robot:
                self.listen(f'/{robot}/{topic}', kind, RELIABLE)

    def listen(self, topic, kind, qos):
        self.create_subscription(kind, topic, self.seen[topic].append, qos)

    def of(self, topic):
        return self.seen[f'/{self.robot}/{topic}']

    @property
    def places(self):
        return [message.pose.pose.position.x for message in self.of('odom')]

    def say_ready(self):
        self.ready.publish(LockstepDone(node=self.get_fully_qualified_name()))

    def on_step(self, message):
        self.steps.append(message)
        if self.quiet:
            return
        if self.robot in message.robots:
            self.send(self.velocity, seconds(message.stamp) + self.stamp_shift)
        if not self.robot:
            self.say_done(message.step)

    def say_done(self, step):
        self.done.publish(LockstepDone(node=self.get_fully_qualified_name(), step=step))

    def send(self, velocity, stamp):
        command = TwistStamped()
        command.header.stamp.sec, command.header.stamp.nanosec = divmod(round(stamp * 1e9), 10**9)
        twist = command.twist
        twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z = velocity
        self.command.publish(command)


class Team:
    """A simulation node, and those it waits for."""

    def __init__(self, context, folder, content, robots=('mambo', 'turtlebot'), **parameters):
        file = folder / 'scenario.yaml'
        file.write_text(yaml.safe_dump(content))
        values = {'scenario': str(file), 'seed': 3, 'lockstep': True, 'rate': 0.0} | parameters
        self.context = context
        self.sim = SimNode(
            context=context,
            parameter_overrides=[Parameter(name, value=value) for name, value in values.items()],
        )
        self.executor = SingleThreadedExecutor(context=context)
        self.drivers = {name: self.add('driver', name) for name in robots}
        self.filter, self.planner = self.add('filter_node'), self.add('planner_node')
        self.filter.listen('/clock', Clock, RELIABLE)
        self.filter.listen('/ground_truth/targets', PoseArray, LATCHED)
        self.filter.listen('/ground_truth/markers', MarkerArray, LATCHED)

    def start(self, ready):
        assert self.sim.trigger_configure().name == 'SUCCESS', self.sim.problem
        assert self.sim.trigger_activate().name == 'SUCCESS'
        self.executor.add_node(self.sim)
        if ready:
            self.say_ready()
        return self

    def add(self, name, robot=''):
        node = Member(self.context, name, robot)
        self.executor.add_node(node)
        return node

    @property
    def members(self):
        return [*self.drivers.values(), self.filter, self.planner]

    def say_ready(self):
        for member in self.members:
            member.say_ready()

    def spin_until(self, condition):
        wait_until(condition, lambda: self.executor.spin_once(timeout_sec=0.1), self.sim.status)

    def settle(self, seconds_=0.2):
        """Let all that is under way arrive."""
        end = time.monotonic() + seconds_
        self.spin_until(lambda: time.monotonic() > end)

    def run(self, steps):
        """Go on until all that belongs to a step has arrived: the one after the next is there."""
        self.spin_until(
            lambda: all(m.steps and m.steps[-1].step >= steps + 2 for m in self.members)
        )

    def close(self):
        if self.sim.configured:
            self.sim.halt()
        self.executor.shutdown()
        for node in (*self.members, self.sim):
            node.destroy_node()


@pytest.fixture
def make_team(context, tmp_path):
    teams = []

    def make(content=SCENARIO, ready=True, **options):
        # Known before it starts: nodes that are not destroyed keep the log topic of their name.
        teams.append(Team(context, tmp_path, content, **options))
        return teams[-1].start(ready)

    yield make
    for team in teams:
        team.close()


def seconds(stamp):
    return stamp.sec + stamp.nanosec * 1e-9


def steps_of(messages, stamp='header.stamp'):
    return [round(seconds(attrgetter(stamp)(message)) / STEP) for message in messages]


def test_every_topic_comes_at_its_rate_with_the_stamps_of_the_steps(make_team):
    team = make_team()
    team.run(50)
    mambo, turtlebot = team.drivers['mambo'], team.drivers['turtlebot']
    periods = {'odom': 1, 'camera/image_raw': 2, 'camera/camera_info': 2, 'battery_state': 20}
    for driver in (mambo, turtlebot):
        for topic, period in periods.items() | ({('scan', 4)} if driver is turtlebot else set()):
            expected = list(range(0, 51, period))
            assert steps_of(driver.of(topic))[: len(expected)] == expected
    assert not mambo.of('scan') and not mambo.of('ranges')
    steps = team.filter.steps[:51]
    assert [message.step for message in steps] == list(range(51))
    assert steps_of(steps, 'stamp') == list(range(51))
    assert all(message.robots == ['mambo', 'turtlebot'] for message in steps)
    assert [message.imaging for message in steps[:2]] == [['mambo', 'turtlebot'], []]
    assert steps_of(team.filter.seen['/clock'], 'clock')[:11] == list(range(0, 51, 5))

    first, last = mambo.of('odom')[0], mambo.of('odom')[40]
    assert (first.header.frame_id, first.child_frame_id) == ('mambo/odom', 'mambo/base_link')
    position = first.pose.pose.position
    assert max(abs(position.x), abs(position.y), abs(position.z)) < 0.02
    for covariance in (first.pose.covariance, first.twist.covariance):
        assert np.all(np.diag(np.reshape(covariance, (6, 6))) > 0.0)
    # It flies along its own x axis, with which its odometry begins, whatever its heading.
    assert last.pose.pose.position.x > 0.2 and abs(last.pose.pose.position.y) < 0.05
    assert last.twist.twist.linear.x == pytest.approx(0.2, abs=0.05)
    image, info = mambo.of('camera/image_raw')[0], mambo.of('camera/camera_info')[0]
    assert (image.width, image.height, image.encoding, image.step) == (160, 120, 'rgb8', 480)
    assert len(image.data) == 160 * 120 * 3 and np.asarray(image.data).std() > 1.0
    assert list(info.k) == [220.0, 0.0, 79.5, 0.0, 220.0, 59.5, 0.0, 0.0, 1.0]
    scan = turtlebot.of('scan')[0]
    assert len(scan.ranges) == 360 and scan.ranges[0] == pytest.approx(2.7, abs=0.1)
    assert mambo.of('battery_state')[1].percentage < mambo.of('battery_state')[0].percentage <= 1.0
    # In the unit of its type.
    assert 99.0 < turtlebot.of('battery_state')[0].percentage <= 100.0
    truth = team.filter.seen['/ground_truth/targets'][0]
    places = [[pose.position.x, pose.position.y, pose.position.z] for pose in truth.poses]
    assert truth.header.frame_id == 'map'
    np.testing.assert_allclose(places, [[1.9, 1.95, 0.0], [0.3, 0.4, 0.0]])
    first, *markers = team.filter.seen['/ground_truth/markers'][0].markers
    assert first.action == Marker.DELETEALL
    assert [marker.ns for marker in markers] == ['truth', 'truth', 'obstacles']


def test_the_time_starts_only_when_everybody_is_there_and_would_miss_nothing(
    make_team, monkeypatch
):
    monkeypatch.setattr('maasi_sim.simulation.sim_node._PATIENCE', 0.0)
    matched, counts = Publisher.get_subscription_count, {'/clock': 0}

    def late(publisher):
        # The subscriptions are discovered, but not connected yet.
        return counts.get(publisher.topic_name, matched(publisher))

    monkeypatch.setattr(Publisher, 'get_subscription_count', late)
    team = make_team(recorder=True)
    team.settle()
    assert team.sim.status()['waits for'] == '/recorder'
    # What runs a recorder says who is missing.
    assert team.sim._said == ''
    recorder = team.add('recorder')
    recorder.say_ready()
    team.spin_until(lambda: team.sim.status()['waits for'] == '')
    team.settle()
    assert team.sim.step < 0 and not team.drivers['mambo'].of('odom')
    assert not team.filter.steps and not team.filter.seen['/clock']
    del counts['/clock']
    team.run(5)
    assert seconds(team.filter.seen['/clock'][0].clock) == 0.0
    recorder.destroy_node()


def test_a_step_waits_for_everybody_and_for_every_command(make_team):
    team = make_team()
    team.planner.quiet = True
    turtlebot, mambo = team.drivers['turtlebot'], team.drivers['mambo']
    turtlebot.stamp_shift = -STEP
    team.spin_until(lambda: team.sim.dropped['stale command'] == 1)
    team.settle()
    assert team.sim.status()['waits for'] == '/planner_node, turtlebot/cmd_vel'
    team.planner.say_done(0)
    team.settle()
    assert team.sim.status()['waits for'] == 'turtlebot/cmd_vel'
    turtlebot.stamp_shift = 0
    team.planner.quiet = False
    turtlebot.send(FORWARD, 0.0)
    team.run(20)
    # What is not finite is refused, and the command before holds.
    mambo.velocity = (float('nan'), 0.0, 0.0, 0.0)
    team.run(40)
    assert team.sim.dropped['bad command'] >= 15
    assert mambo.places[40] > mambo.places[25] > mambo.places[20]


def test_a_robot_that_is_away_is_silent_stands_still_and_goes_on_from_there(make_team):
    leave = {'at': 1.0, 'robot': 'turtlebot', 'do': 'leave'}
    team = make_team(SCENARIO | {'events': [leave, leave | {'at': 2.0, 'do': 'back'}]})
    team.run(60)
    turtlebot = team.drivers['turtlebot']
    there = [*range(20), *range(40, 61)]
    assert steps_of(turtlebot.of('odom'))[:41] == there
    assert steps_of(turtlebot.of('camera/image_raw'))[:21] == [k for k in there if k % 2 == 0]
    for k, message in enumerate(team.filter.steps[:61]):
        assert ('turtlebot' in message.robots) == (k in there)
        assert k in there or 'turtlebot' not in message.imaging
    before, back, last = (turtlebot.places[i] for i in (19, 20, 40))
    assert abs(back - before) < 0.03 and last > back + 0.1
    assert abs(turtlebot.of('odom')[20].twist.twist.linear.x) < 0.03


def test_a_filter_that_was_started_again_gets_the_step_anew(make_team):
    team = make_team()
    team.planner.quiet = True
    team.spin_until(lambda: team.sim._waiting == {'/planner_node'})
    team.executor.remove_node(team.filter)
    team.filter.destroy_node()
    team.filter = team.add('filter_node')
    team.filter.say_ready()
    team.spin_until(lambda: len(team.filter.steps) == 1 and len(team.planner.steps) == 2)
    assert team.filter.steps[0].step == 0
    # The answers of drivers may have been missed.
    team.spin_until(lambda: steps_of(team.drivers['mambo'].of('odom')) == [0, 0])
    team.planner.quiet = False
    team.planner.say_done(0)
    team.run(5)
    # A late second answer to the step that came twice is nothing wrong; one to another step is.
    team.drivers['mambo'].send(FORWARD, 0.0)
    team.run(team.sim.step + 5)
    assert team.sim.dropped == {}
    team.drivers['mambo'].send(FORWARD, STEP)
    team.spin_until(lambda: team.sim.dropped == {'stale command': 1})


def test_free_running_goes_on_by_itself_and_the_last_command_holds(make_team):
    team = make_team(lockstep=False, rate=20.0)
    driver = team.drivers['mambo']
    for member in team.members:
        member.quiet = True
    team.spin_until(lambda: team.sim.step >= 0)
    driver.send((0.3, 0.0, 0.0, 0.0), 0.0)
    team.run(60)
    assert driver.places[60] > driver.places[40] + 0.2
    # Too old, of the future, not finite: refused. To stop is never refused.
    for speed, stamp in ((-0.3, 0.05), (-0.3, 1e6), (math.inf, 0.0)):
        driver.send((speed, 0.0, 0.0, 0.0), stamp)
    team.spin_until(lambda: sum(team.sim.dropped.values()) == 3)
    assert dict(team.sim.dropped) == {'stale command': 2, 'bad command': 1}
    driver.send((0.0, 0.0, 0.0, 0.0), 0.05)
    team.run(team.sim.step + 80)
    assert abs(driver.places[-1] - driver.places[-20]) < 0.02


def test_lockstep_keeps_to_the_rate_that_is_asked_for(make_team):
    team = make_team(rate=10.0)
    team.spin_until(lambda: team.sim.step >= 0)
    begin = time.monotonic()
    team.run(40)
    # 40 steps are 2 s; at ten times the speed they take 0.2 s, however fast the machine is.
    assert time.monotonic() - begin > 0.18


def test_wrong_parameters_are_refused_with_what_is_wrong(make_team):
    for content, parameters, text in (
        (SCENARIO, {'lockstep': False, 'rate': 0.0}, 'parameter rate: read 0'),
        (SCENARIO, {'rate': -1.0}, 'rate'),
        (SCENARIO, {'step': 0.03}, 'multiples of step'),
        (LINKED, {'lockstep': False, 'rate': 2.0}, r'drone\.link: .* real time'),
    ):
        with pytest.raises(AssertionError, match=text):
            make_team(content, **parameters)


def test_a_linked_robot_is_cut_off_while_it_is_away(make_team, tmp_path):
    url = f'udpin:127.0.0.1:{free_port()}'
    content = deepcopy(LINKED)
    content['robots']['drone']['mavlink']['url'] = url
    settings = MavlinkSettings.model_validate({'arm': True, 'url': url})
    link = VehicleLink(settings, [0.0, 0.0, 1.0], tmp_path / 'origin.json')
    link.open()

    def permitted():
        with link.lock:
            link.vehicle.active = True
            return link.vehicle.permit(time.monotonic()) == ''

    try:
        team = make_team(content, ready=False, robots=('drone',), lockstep=False, rate=1.0)
        # It lives before the time starts.
        team.spin_until(permitted)
        team.spin_until(lambda: link.vehicle.flying)
        team.say_ready()
        drone = team.drivers['drone']
        team.spin_until(lambda: drone.of('ranges'))
        assert drone.of('ranges')[0].ranges[0].range == pytest.approx(4.0, abs=2.0)
        team.spin_until(lambda: not link.vehicle.flying)
        assert link.vehicle.fault == 'link: no message from system 1'
        team.spin_until(lambda: link.vehicle.flying)
        assert not drone.of('odom') and not drone.of('battery_state')
        assert drone.command.get_subscription_count() == 0
    finally:
        link.close()


@pytest.mark.parametrize('external', [False, True])
def test_images_of_another_program_are_not_simulated(make_team, external):
    content = deepcopy(SCENARIO)
    robot = content['robots']['turtlebot'] | ({'measurements': 'external'} if external else {})
    content['robots'] = {'turtlebot': robot}
    team = make_team(content, robots=('turtlebot',), lockstep=False, rate=1.0)
    robot = team.drivers['turtlebot']
    team.spin_until(lambda: len(robot.of('odom')) > 40)
    assert bool(robot.of('camera/image_raw')) is not external
    for topic in ('camera/image_raw', 'camera/camera_info'):
        assert len(robot.get_publishers_info_by_topic(f'/turtlebot/{topic}')) == (not external)


def test_a_robot_that_another_program_moves_brings_its_own_time(make_team):
    content = deepcopy(SCENARIO)
    content['robots'] = {'turtlebot': content['robots']['turtlebot'] | {'body': 'external'}}
    options = {'lockstep': False, 'rate': 1.0, 'use_sim_time': True}
    team = make_team(content, robots=('turtlebot',), **options)
    robot = team.drivers['turtlebot']
    clock = robot.create_publisher(Clock, '/clock', 10)
    states = robot.create_publisher(AgentState, '/turtlebot/state', 10)
    state, bad = AgentState(robot='turtlebot'), AgentState(robot='turtlebot')
    state.pose.pose = pose_to_ros(Pose.from_yaw([1.0, 1.2, 0.0], 0.5))
    bad.pose.pose.position.x = math.nan
    now = 57.0

    def go_on():
        nonlocal now
        now += 0.02
        clock.publish(Clock(clock=stamp_to_ros(round(now * 1e9))))
        states.publish(state)
        states.publish(bad)

    team.spin_until(lambda: team.sim.status()['waits for'] == '/clock')
    team.spin_until(lambda: go_on() or len(robot.of('camera/image_raw')) >= 3)
    stamps = [seconds(image.header.stamp) for image in robot.of('camera/image_raw')]
    assert 57.0 <= stamps[0] < stamps[-1] <= now
    steps = [step.step for step in robot.steps]
    assert steps == list(range(steps[0], steps[0] + len(steps)))
    assert steps[0] * STEP == pytest.approx(seconds(robot.steps[0].stamp))
    place = team.sim.simulation.robots['turtlebot'].state.pose.position
    assert place[:2] == pytest.approx([1.0, 1.2])
    # It stands still with that clock, once it has caught up with it.
    team.spin_until(lambda: seconds(robot.steps[-1].stamp) > now - 1.01 * STEP)
    team.settle()
    known = len(robot.steps)
    team.settle(0.5)
    assert len(robot.steps) == known
    assert len(team.filter.get_publishers_info_by_topic('/clock')) == 1
    assert not robot.of('odom') and not robot.of('scan')
    assert robot.command.get_subscription_count() == 0
    with pytest.raises(AssertionError, match=r'turtlebot\.body: .* lockstep'):
        make_team(content, robots=('turtlebot',))
