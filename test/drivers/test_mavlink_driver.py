"""The MAVLink driver against a fake vehicle, over real UDP and real topics."""

import math
import os
import signal
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from numpy.testing import assert_allclose
from rclpy.executors import SingleThreadedExecutor
from robot_team import STEP, TURTLEBOT, Team, parameters_of, rendered, stamped

from maasi_drivers.agent import watchdog
from maasi_drivers.agent.agent_driver import STOPPED as STOPPED_BY_SERVICE
from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.drivers import MavlinkCameraDriver, MavlinkDriver, TurtlebotDriver
from maasi_drivers.links.mavlink.mavlink_robot_link import _POLL_PERIOD
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.models.pose import Pose, compose
from maasi_filter.ros.conversions import pose_from_ros, pose_to_ros, stamp_from_ros, stamp_to_ros
from maasi_filter.ros.parameters import flatten
from maasi_msgs.msg import AgentState, RangeArray, RangeMeasurement
from maasi_sim.emulators.mavlink.autopilot_settings import AutopilotSettings
from maasi_sim.emulators.mavlink.fake_mavlink_vehicle import FakeVehicle

SPEED, STOPPED = 1.0, 0.1
START, DEEP = [1.0, 2.0, 0.8], [1.0, 2.0, -0.8]
# Setpoints lead by a second; then it brakes, within half a second [m].
LONGEST_WAY = 1.5 * SPEED
COPTER = {
    'step': STEP,
    'environment': {'bounds': [[-8.0, 8.0], [-8.0, 8.0], [-5.0, 5.0]]},
    'start': START,
    'radius': 0.3,
    # The machine may be busy, and most tests have no sweeps.
    'odometry_timeout': 5.0,
    'sensor_timeout': 0.0,
    'motion': {'speed': SPEED, 'acceleration': 1.0, 'tolerance': 0.25},
    'sensor': {'detection': {'kind': 'box', 'lower': [-4, -4, -6], 'upper': [4, 4, 6]}},
    'link': 'mavlink',
}
LINK = {'arm': True, 'link_timeout': 3.0}
ROV = COPTER | {'start': DEEP}
CAMERA = {
    'environment': {'bounds': [[-2.0, 4.0], [-2.0, 4.0]]},
    'sensor': {'detection': {'kind': 'box'}},
    'camera': {'focal_length': [220.0, 220.0]},
}


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


def settings_of(firmware, link, changes):
    kind = 'submarine' if firmware == 'ardusub' else 'copter'
    own = {'url': f'udpin:127.0.0.1:{free_port()}', 'vehicle': kind}
    base = ROV if firmware == 'ardusub' else COPTER
    return base | {'mavlink': LINK | own | link} | changes


class Flight:
    """A fake vehicle, its driver, and the team around them."""

    def __init__(self, vehicle, driver, team):
        self.vehicle, self.driver, self.team = vehicle, driver, team

    @property
    def state(self):
        return self.team.state

    @property
    def mode(self):
        return self.vehicle.autopilot.mode_name

    @property
    def position(self):
        return self.vehicle.state.pose.position

    @property
    def speed(self):
        return float(np.linalg.norm(self.vehicle.state.velocity[:2]))

    def until(self, condition, what=''):
        self.team.until(condition, what or self.why)

    @property
    def why(self):
        return f'{self.mode}, {self.team.states[-1:]}'

    def fly(self):
        # Refused until the vehicle is heard.
        self.until(lambda: self.team.call('arm').success)
        return self.wait_for_flight()

    def wait_for_flight(self):
        self.until(
            lambda: self.team.states and self.state.goal_status != AgentState.UNAVAILABLE,
            'it does not fly',
        )
        return self

    def under_way(self, goal=(1.0, -6.0, 0.8)):
        _, result = self.team.send_accepted(goal)
        self.until(lambda: self.speed > 0.8 * SPEED)
        return result

    def gives_up(self, result, reason):
        """Check that the goal ends, that the planner hears why, and that the vehicle stops."""
        before = self.position
        self.until(lambda: self.state.goal_status == AgentState.UNAVAILABLE)
        assert reason in self.state.reason
        self.until(result.done)
        assert result.result().status == GoalStatus.STATUS_ABORTED
        assert reason in result.result().result.reason
        self.until(lambda: self.speed < STOPPED)
        assert np.linalg.norm((self.position - before)[:2]) < LONGEST_WAY
        assert self.team.refused([1.0, 1.0, 0.8])


@pytest.fixture
def fly(context, monkeypatch, tmp_path):
    """Return a function that brings a driver and its vehicle together."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    ended = []
    executor = SingleThreadedExecutor(context=context)

    def start(firmware='arducopter', autopilot=(), link=(), **changes):
        settings = settings_of(firmware, dict(link), changes)
        kind = MavlinkCameraDriver if 'camera' in settings else MavlinkDriver
        driver = kind(
            context=context, namespace='/rover', parameter_overrides=parameters_of(settings)
        )
        executor.add_node(driver)
        team = Team(context, settings, executor, deaf=True)
        team.used = [team.batches, team.images if 'camera' in settings else team.ranges]
        ended.extend([driver.halt, driver.destroy_node, team.destroy_node])
        assert driver.trigger_configure().name == 'SUCCESS'
        assert driver.trigger_activate().name == 'SUCCESS'
        team.connect()
        url = settings['mavlink']['url'].replace('udpin', 'udpout')
        values = {'firmware': firmware, 'estimator_time': 0.2} | dict(autopilot)
        origin = Pose.from_yaw([*settings['start'][:2], 0.0], 0.0)
        vehicle = FakeVehicle(
            AutopilotSettings.model_validate(values), url, origin, np.random.default_rng(1)
        )
        ended.append(vehicle.close)
        return Flight(vehicle, driver, team)

    yield start
    for end in ended:
        end()
    executor.shutdown()


def test_what_is_waited_for_is_short_enough():
    """After a fault it has stopped, and the planner has heard why, within 1.5 s."""
    link = MavlinkSettings()
    assert link.link_timeout + 2.0 * _POLL_PERIOD <= 1.5
    assert 1.0 / link.setpoint_rate + link.lead <= 1.5
    assert link.arm is False
    assert link.require_failsafe is True


@pytest.mark.parametrize('firmware', ['arducopter', 'ardusub', 'px4'])
def test_it_is_armed_flies_to_its_waypoint_and_lands_at_the_end(fly, firmware):
    flight = fly(firmware).fly()
    assert flight.mode in ('GUIDED', 'OFFBOARD')
    height = flight.driver.settings.start[2] + 0.4
    _, result = flight.team.send_accepted([2.0, 0.5, height])
    flight.until(result.done)
    assert result.result().result.reached
    assert_allclose(flight.position, [2.0, 0.5, height], atol=0.35)
    assert_allclose(pose_from_ros(flight.state.pose.pose).position, flight.position, atol=0.35)
    assert flight.state.goal_status == AgentState.REACHED
    flight.driver.halt()
    assert flight.mode in ('LAND', 'SURFACE', 'AUTO.LAND')


def test_the_next_waypoint_replaces_one_without_a_stop(fly, monkeypatch):
    flight = fly().fly()
    height = flight.driver.settings.start[2]
    _, replaced = flight.team.send_accepted([1.0, -3.0, height], number=1)
    flight.until(lambda: flight.position[1] < -1.5)
    leads = []
    send_target = flight.driver.link._send_target

    def noting(position, yaw):
        here = flight.driver.history.latest.pose.position
        leads.append(float(np.linalg.norm(position - here)))
        send_target(position, yaw)

    monkeypatch.setattr(flight.driver.link, '_send_target', noting)
    _, result = flight.team.send_accepted([3.0, -5.0, height], number=2)
    slowest = []
    flight.until(lambda: slowest.append(flight.speed) or flight.position[0] > 2.0)
    assert replaced.done() and replaced.result().result.reason == 'replaced'
    # No set-point at its place, which would stop it; it flies on.
    assert len(leads) > 10 and min(leads) > 0.5 * SPEED
    assert min(slowest) > 0.4 * SPEED
    # Nobody sends it further: it stops at its last waypoint.
    flight.until(result.done)
    assert result.result().result.reached
    flight.until(lambda: flight.speed < STOPPED)
    assert_allclose(flight.position, [3.0, -5.0, height], atol=0.35)


def test_a_map_that_is_turned_against_north(fly):
    flight = fly(link={'map_yaw': 0.5}).fly()
    goal = [2.0, 0.5, 0.8]
    _, result = flight.team.send_accepted(goal)
    flight.until(result.done)
    # The fake has its local frame at the start, with east along x.
    cosine, sine = math.cos(0.5), math.sin(0.5)
    east = [cosine * 1.0 - sine * -1.5, sine * 1.0 + cosine * -1.5]
    assert_allclose(flight.position[:2] - START[:2], east, atol=0.35)
    assert pose_from_ros(flight.state.pose.pose).yaw == pytest.approx(-0.5, abs=0.05)


def test_a_localiser_says_where_the_frame_of_the_autopilot_is(fly):
    flight = fly(pose_source='pose')
    poses = flight.team.create_publisher(PoseStamped, '/rover/pose', 10)
    # The autopilot's north is off, and its origin elsewhere.
    seen_from = Pose.from_yaw([0.7, -0.4, 0.1], 0.4)

    def say():
        message = PoseStamped(pose=pose_to_ros(compose(seen_from, flight.vehicle.state.pose)))
        message.header.frame_id = 'map'
        message.header.stamp = stamp_to_ros(flight.team.get_clock().now().nanoseconds)
        poses.publish(message)

    def until(condition):
        flight.until(lambda: say() or condition())

    flight.until(lambda: UNTIL_ARM in flight.driver.health.text)
    assert flight.team.call('arm').message == 'no pose'
    until(lambda: flight.team.states and flight.team.call('arm').success)
    until(lambda: flight.state.goal_status != AgentState.UNAVAILABLE)
    goal = [3.0, -1.0, 1.0]
    assert flight.team.takes(goal, live=say)
    until(lambda: flight.state.goal_status == AgentState.REACHED)
    there = compose(seen_from, flight.vehicle.state.pose).position
    assert_allclose(there, goal, atol=0.35)
    # Without it the vehicle stays where it was sent last.
    flight.until(lambda: 'no pose for' in flight.state.reason)
    flight.until(lambda: flight.speed < STOPPED)


def test_sweeps_answer_batches_with_the_pose_of_their_stamp(fly):
    flight = fly().fly()
    flight.under_way()
    stamp = stamp_from_ros(flight.state.header.stamp)
    flight.team.ask(stamp)
    sweep = RangeArray(ranges=[RangeMeasurement(range=2.0, bearing=0.3, elevation=-0.2)])
    sweep.header.stamp = stamp_to_ros(stamp)
    flight.team.ranges.publish(sweep)
    answer = flight.team.answer()
    seen = answer.detections[0]
    assert (seen.range, seen.bearing, seen.elevation) == pytest.approx((2.0, 0.3, -0.2))
    told = next(item for item in flight.team.states if stamp_from_ros(item.header.stamp) == stamp)
    assert_allclose(
        pose_from_ros(answer.pose.pose).position, pose_from_ros(told.pose.pose).position
    )


def test_a_camera_is_looked_through_where_the_vehicle_is(fly):
    flight = fly(**CAMERA).fly()
    assert flight.mode == 'GUIDED'
    stamp = stamp_from_ros(flight.state.header.stamp)
    pose = pose_from_ros(flight.state.pose.pose)
    target = pose.position[:2] + np.array([0.1, -0.05])
    image = rendered(flight.team, [target.tolist()], pose)
    flight.team.ask(stamp)
    flight.team.images.publish(stamped(image, stamp))
    answer = flight.team.answer()
    assert len(answer.detections) == 1
    seen = answer.detections[0]
    there = pose.position[:2] + seen.range * np.array(
        [math.cos(seen.bearing), math.sin(seen.bearing)]
    )
    assert_allclose(there, target, atol=0.03)
    flight.driver.halt()
    assert flight.mode == 'LAND'


def test_without_arm_nothing_is_armed_and_goals_are_refused(fly, capfd):
    flight = fly(link={'arm': False})
    flight.until(lambda: flight.team.states and 'arm is false' in flight.state.reason)
    assert flight.state.goal_status == AgentState.UNAVAILABLE
    assert flight.team.refused(START)
    assert 'the robot cannot go on: vehicle: not armed: arm is false' in capfd.readouterr().err
    assert not flight.vehicle.autopilot.armed
    assert flight.mode == 'STABILIZE'


def test_it_takes_off_each_time_that_the_service_is_called(fly, capfd):
    flight = fly()
    flight.until(lambda: flight.team.states and UNTIL_ARM in flight.state.reason)
    assert flight.state.goal_status == AgentState.UNAVAILABLE
    # The origin is kept for a driver that is started again.
    kept = Path(os.environ['ROS_HOME']) / 'maasi' / 'rover_flight_origin.json'
    assert not kept.exists()
    assert flight.team.call('stop').success
    answer = flight.team.call('arm')
    assert (answer.success, answer.message) == (False, STOPPED_BY_SERVICE)
    assert flight.team.call('release').success
    flight.fly()
    assert kept.exists()
    answer = flight.team.call('arm')
    assert (answer.success, answer.message) == (False, 'it is in the air already')
    with flight.vehicle._lock:
        flight.vehicle.autopilot.disarm('Crash: Disarming')
    reason = 'is disarmed: by the autopilot or the pilot ('
    flight.until(lambda: reason in flight.state.reason)
    assert 'Crash: Disarming' in flight.state.reason
    said = capfd.readouterr().err
    assert f'arm: refused: {STOPPED_BY_SERVICE}' in said and reason in said
    # It says by itself why it has no position.
    assert 'no LOCAL_POSITION_NED yet' not in said
    with flight.vehicle._lock:
        flight.vehicle.autopilot.body.position[2] = 0.0
    flight.fly()


def test_a_vehicle_in_the_air_is_taken_over_and_the_answer_says_so(fly):
    flight = fly()
    autopilot = flight.vehicle.autopilot
    flight.until(lambda: flight.team.states and UNTIL_ARM in flight.state.reason)
    with flight.vehicle._lock:
        # A pilot has brought it there.
        autopilot.armed = True
        autopilot.body.position[2] = 1.0
        autopilot.take_mode('GUIDED')
    flight.until(lambda: flight.driver.link.status().get('in the air'))
    flight.until(lambda: 'it is armed in GUIDED' in flight.state.reason)
    assert flight.team.call('arm').message == 'it is in the air: it is taken over where it is'
    flight.wait_for_flight()


def test_what_the_autopilot_does_by_itself_is_shown(fly, capfd):
    flight = fly(autopilot={'parameters': {'FS_GCS_ENABLE': 0}})
    shown = []
    flight.team.create_subscription(
        DiagnosticArray, '/diagnostics', lambda message: shown.extend(message.status), 10
    )
    flight.until(lambda: flight.team.states and 'FS_GCS_ENABLE is 0' in flight.state.reason)
    assert not flight.vehicle.autopilot.armed
    said = capfd.readouterr().err
    assert (
        'failsafe for when the heartbeats of the driver stop: FS_GCS_ENABLE is 0, which does not '
        'help' in said
    )
    flight.until(
        lambda: any(
            (item.key, item.value) == ('parameter FS_GCS_ENABLE', '0.0')
            for status in shown
            for item in status.values
        )
    )


def test_goals_that_are_not_finite_or_outside_the_geofence_are_refused(fly, capfd):
    flight = fly(link={'geofence': [[-3.0, 3.0], [-3.0, 3.0], [0.5, 3.0]]}).fly()
    for goal in ([math.nan, 0.0, 0.8], [0.0, 0.0, math.inf], [0.0, 3.5, 0.8], [0.0, 0.0, 4.0]):
        assert flight.team.refused(goal)
    flight.until(lambda: flight.driver.dropped['goal'] == 4)
    assert 'allowed are finite numbers' in capfd.readouterr().err
    assert 'the geofence' in flight.driver.goals.problem(flight.team.goal([0.0, 3.5, 0.8]))
    assert not flight.vehicle.autopilot.crashed
    assert flight.team.takes([0.0, 2.5, 0.8])


def test_without_a_geofence_it_is_not_sent_into_the_ground(fly):
    flight = fly().fly()
    assert 'the geofence' in flight.driver.goals.problem(flight.team.goal([0.0, 1.0, -0.1]))
    assert flight.driver.goals.problem(flight.team.goal([0.0, 1.0, 0.1])) is None


def test_blown_out_of_the_geofence_it_comes_back(fly):
    flight = fly(link={'geofence': [[-3.0, 3.0], [-3.0, 3.0], [0.5, 3.0]]}).fly()
    with flight.vehicle._lock:
        flight.vehicle.autopilot.body.position = np.array([3.5, 0.0, 0.8])
    flight.until(lambda: 'm outside the geofence' in flight.state.reason)
    flight.until(lambda: flight.position[0] < 3.1)
    flight.until(lambda: flight.state.goal_status != AgentState.UNAVAILABLE)


def test_a_cancelled_goal_stops_it(fly):
    flight = fly().fly()
    handle, result = flight.team.send_accepted([1.0, -6.0, 0.8])
    flight.until(lambda: flight.speed > 0.8 * SPEED)
    before = flight.position
    handle.cancel_goal_async()
    flight.until(result.done)
    assert result.result().status == GoalStatus.STATUS_CANCELED
    flight.until(lambda: flight.speed < STOPPED)
    assert np.linalg.norm(flight.position - before) < LONGEST_WAY
    assert flight.mode == 'GUIDED'


@pytest.mark.parametrize(
    ('firmware', 'fault', 'reason', 'logged'),
    [
        ('arducopter', 'cut', 'link: nothing heard from system 1', ''),
        ('ardusub', 'cut', 'link: nothing heard from system 1', ''),
        ('arducopter', 'frozen', 'no LOCAL_POSITION_NED for', ''),
        ('arducopter', 'restart', 'the autopilot has restarted', 'is disarmed: the autopilot has'),
        (
            'px4',
            'pilot',
            'the pilot has taken over: mode POSCTL',
            'mode POSCTL; the driver lets go',
        ),
    ],
)
def test_a_fault_ends_the_way_and_is_said(fly, capfd, firmware, fault, reason, logged):
    timeout = 0.5 if fault == 'frozen' else 5.0
    parameters = {'FS_GCS_TIMEOUT': 60} if firmware == 'arducopter' else {}
    flight = fly(
        firmware, {'parameters': parameters}, {'link_timeout': 1.0}, odometry_timeout=timeout
    )
    vehicle, autopilot = flight.vehicle, flight.vehicle.autopilot
    result = flight.fly().under_way([1.0, -6.0, flight.driver.settings.start[2]])
    with vehicle._lock:
        if fault == 'cut':
            vehicle.cut()
        elif fault == 'frozen':
            autopilot.freeze()
        elif fault == 'restart':
            autopilot.restart()
            # Nothing is left to stop it.
            autopilot.body.velocity[:] = 0.0
        else:
            autopilot.take_mode('POSCTL')
    flight.gives_up(result, reason)
    assert logged in capfd.readouterr().err
    if fault == 'restart':
        assert not flight.team.call('arm').success
    elif fault == 'pilot':
        flight.driver.halt()
        assert flight.mode == 'POSCTL'
    elif firmware == 'ardusub':
        # The autopilot misses the driver, too.
        flight.until(lambda: autopilot.mode == autopilot.firmware.land)
    elif fault == 'cut':
        vehicle.cut(False)
        flight.wait_for_flight()
        assert flight.team.takes([1.0, 1.5, 0.8])


def test_a_clock_that_jumps_back_stops_it_and_begins_anew(fly, set_back):
    flight = fly(odometry_timeout=0.5).fly()
    result = flight.under_way()
    set_back(flight.driver, 1000.0)
    flight.until(result.done)
    assert result.result().result.reason == 'the time jumped back'
    flight.until(lambda: flight.speed < STOPPED)
    flight.wait_for_flight()
    _, result = flight.team.send_accepted([1.0, 1.5, 0.8])
    flight.until(result.done)
    assert result.result().result.reached


def test_a_sensor_that_falls_silent(fly):
    flight = fly(sensor_timeout=1.0)

    def sweep():
        if flight.team.states:
            flight.team.ranges.publish(RangeArray(header=flight.state.header))

    flight.until(lambda: flight.team.call('arm').success)
    flight.until(
        lambda: (
            sweep() or (flight.team.states and flight.state.goal_status != AgentState.UNAVAILABLE)
        )
    )
    _, result = flight.team.send_accepted([1.0, -6.0, 0.8])
    flight.until(lambda: sweep() or flight.speed > 0.8 * SPEED)
    flight.until(lambda: flight.state.goal_status == AgentState.UNAVAILABLE)
    flight.gives_up(result, 'no new sweep for')
    assert flight.mode == 'GUIDED'


def test_with_a_low_battery_it_lands(fly, monkeypatch, capfd):
    monkeypatch.setattr(watchdog, '_CHARGE_PATIENCE', 2.5)
    flight = fly(battery_minimum=0.2, autopilot={'endurance': 1e9}).fly()
    # One that stays the same has been heard all the same.
    begin = time.monotonic()
    flight.until(lambda: time.monotonic() - begin > 4.0)
    assert 'battery_minimum cannot act' not in capfd.readouterr().err
    result = flight.under_way()
    with flight.vehicle._lock:
        flight.vehicle.autopilot.charge = 0.15
    flight.gives_up(result, 'battery at 0.15, below 0.20')
    flight.until(lambda: flight.mode == 'LAND')
    # It lands again once a pilot who took it over gives it back.
    with flight.vehicle._lock:
        flight.vehicle.autopilot.take_mode('LOITER')
    flight.until(lambda: 'the pilot has taken over' in flight.state.reason)
    begin = time.monotonic()
    flight.until(lambda: time.monotonic() - begin > 0.5)
    assert flight.mode == 'LOITER' and 'battery at 0.15' in flight.state.reason
    with flight.vehicle._lock:
        flight.vehicle.autopilot.take_mode('GUIDED')
    flight.until(lambda: flight.mode == 'LAND')
    flight.until(lambda: not flight.vehicle.autopilot.armed)


def test_the_service_stop_ends_a_take_off(fly):
    flight = fly(start=[1.0, 2.0, 4.0])
    flight.until(lambda: flight.team.call('arm').success)
    flight.until(lambda: flight.position[2] > 0.3)
    assert flight.team.call('stop').success
    flight.until(lambda: not flight.vehicle.autopilot.armed)
    assert flight.mode == 'LAND'
    assert 'its take-off was stopped' in flight.state.reason


def test_a_port_that_is_taken_is_tried_again(context, fly):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(('127.0.0.1', 0))
        flight = fly(link={'url': f'udpin:127.0.0.1:{other.getsockname()[1]}'})
        flight.until(lambda: flight.team.states and 'mavlink.url: read' in flight.state.reason)
    flight.fly()


def test_other_drivers_do_not_have_this_link(context):
    driver = TurtlebotDriver(
        context=context, parameter_overrides=parameters_of(TURTLEBOT | {'link': 'mavlink'})
    )
    assert driver.trigger_configure().name == 'FAILURE'
    assert "link: read 'mavlink', allowed with this driver is topics" in driver.problem
    driver.destroy_node()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGKILL])
def test_a_driver_that_ends_or_is_killed(context, tmp_path, number):
    """With SIGKILL only the failsafe of the autopilot is left."""
    settings = settings_of('arducopter', {}, {})
    file = tmp_path / 'parameters.yaml'
    flat = flatten(DriverSettings.model_validate(settings))
    file.write_text(yaml.safe_dump({'/**': {'ros__parameters': flat}}))
    command = ['mavlink_driver', '--ros-args']
    command += ['--remap', '__ns:=/rover', '--params-file', str(file)]
    driver = subprocess.Popen(command, env=os.environ.copy())
    values = {'estimator_time': 0.2, 'parameters': {'FS_GCS_TIMEOUT': 3}}
    vehicle = FakeVehicle(
        AutopilotSettings.model_validate(values),
        settings['mavlink']['url'].replace('udpin', 'udpout'),
        Pose.from_yaw([*START[:2], 0.0], 0.0),
        np.random.default_rng(1),
    )
    executor = SingleThreadedExecutor(context=context)
    team = Team(context, settings, executor, deaf=True)
    team.used = [team.batches, team.ranges]
    flight = Flight(vehicle, driver, team)
    try:
        team.connect()
        result = flight.fly().under_way()
        before = flight.position
        driver.send_signal(number)
        assert driver.wait(timeout=30.0) == (0 if number == signal.SIGINT else -signal.SIGKILL)
        if number == signal.SIGINT:
            assert flight.mode == 'LAND'
            flight.until(result.done)
            assert result.result().result.reason == 'the driver stops'
        flight.until(lambda: flight.speed < STOPPED)
        assert np.linalg.norm((flight.position - before)[:2]) < LONGEST_WAY
        flight.until(lambda: flight.mode == 'LAND')
    finally:
        driver.kill()
        driver.wait()
        vehicle.close()
        executor.shutdown()
        team.destroy_node()
