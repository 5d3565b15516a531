"""The MAVLink driver against a fake vehicle, over real UDP and real topics.

What a vehicle is told about faults is in test_mavlink_vehicle.py; here is what only topics and
processes show.
"""

import math
import os
import signal
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from linked_flight import LinkedFlight
from numpy.testing import assert_allclose
from robot_team import STEP, rendered, stamped

from maasi_drivers.agent import watchdog
from maasi_drivers.agent.agent_driver import STOPPED as STOPPED_BY_SERVICE
from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.drivers import MavlinkCameraDriver, MavlinkDriver
from maasi_drivers.links.mavlink.mavlink_robot_link import POLL_PERIOD
from maasi_drivers.settings.vehicles import MavlinkSettings
from maasi_filter.models.pose import Pose, compose
from maasi_filter.ros.conversions import pose_from_ros, pose_to_ros, stamp_from_ros, stamp_to_ros
from maasi_msgs.msg import AgentState
from maasi_sim.simulation.emulators.mavlink.autopilot_settings import AutopilotSettings
from maasi_sim.simulation.emulators.mavlink.fake_mavlink_vehicle import FakeVehicle

SPEED, STOPPED = 1.0, 0.1
START = [1.0, 2.0, 0.8]
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


class Flight(LinkedFlight):
    """A fake vehicle behind its driver."""

    def __init__(self, context, autopilot, link, changes):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(('127.0.0.1', 0))
            url = f'127.0.0.1:{probe.getsockname()[1]}'
        own = {'arm': True, 'link_timeout': 3.0, 'url': f'udpin:{url}'} | link
        self.drone = FakeVehicle(
            AutopilotSettings.model_validate({'estimator_time': 0.2} | autopilot),
            own['url'].replace('udpin', 'udpout'),
            Pose.from_yaw([*START[:2], 0.0], 0.0),
            np.random.default_rng(1),
        )
        self.autopilot, self.lock = self.drone.autopilot, self.drone._lock
        super().__init__(context, COPTER | {'mavlink': own} | changes)

    @property
    def doing(self):
        return self.autopilot.mode_name

    def fly(self):
        return self.arm().until_it_flies()

    def under_way(self, height=START[2]):
        _, result = self.team.send_accepted([1.0, -6.0, height])
        self.until(lambda: self.speed > 0.8 * SPEED)
        return result

    def until_stopped(self, since):
        self.until(lambda: self.speed < STOPPED)
        # Setpoints lead by a second; then it brakes, within half a second.
        assert np.linalg.norm((self.where - since)[:2]) < 1.5 * SPEED

    def gives_up(self, result, reason):
        """Check that the vehicle stops as well."""
        before = self.where
        super().gives_up(result, reason)
        self.until_stopped(before)


@pytest.fixture
def fly(context, flights, monkeypatch, tmp_path, process):
    """Return a function that starts a driver, in this process or its own, and its vehicle."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path))

    def start(autopilot=(), link=(), own_process=False, **changes):
        flight = flights(Flight(context, dict(autopilot), dict(link), changes))
        if own_process:
            return flight.run_process(process, 'mavlink_driver')
        return flight.run_node(MavlinkCameraDriver if 'camera' in changes else MavlinkDriver)

    return start


def test_what_is_waited_for_is_short_enough():
    """After a fault it has stopped, and the planner has heard why, within 1.5 s."""
    link = MavlinkSettings()
    assert link.link_timeout + 2.0 * POLL_PERIOD <= 1.5
    assert 1.0 / link.setpoint_rate + link.lead <= 1.5
    assert link.arm is False
    assert link.require_failsafe is True


def test_it_flies_to_its_waypoints_without_a_stop_and_lands_at_the_end(fly):
    flight = fly().fly()
    team, height = flight.team, START[2]
    # Without a geofence it is not sent into the ground.
    for goal in ([math.nan, 0.0, height], [0.0, 0.0, math.inf], [0.0, 1.0, -0.1], [0.0, 9.0, 1.0]):
        assert team.refused(goal)
    assert flight.driver.dropped['goal'] == 4 and not flight.autopilot.crashed
    last = [3.0, -5.0, height]
    assert flight.slowest_past([1.0, -3.0, height], last, 1.5) > 0.4 * SPEED
    assert_allclose(flight.where, last, atol=0.35)
    assert_allclose(pose_from_ros(team.state.pose.pose).position, flight.where, atol=0.35)
    # A cancelled goal stops it.
    handle, result = team.send_accepted([3.0, 6.0, height])
    flight.until(lambda: flight.speed > 0.8 * SPEED)
    before = flight.where
    handle.cancel_goal_async()
    flight.until(result.done)
    flight.until_stopped(before)
    assert flight.doing == 'GUIDED'
    flight.driver.halt()
    assert flight.doing == 'LAND'


def test_a_camera_in_a_map_that_is_turned_against_north(fly):
    flight = fly(
        link={'map_yaw': 0.5},
        environment={'bounds': [[-2.0, 4.0], [-2.0, 4.0]]},
        sensor={'detection': {'kind': 'box'}},
        camera={'focal_length': [220.0, 220.0]},
    )
    _, result = flight.fly().team.send_accepted([2.0, 0.5, 0.8])
    flight.until(result.done)
    # The fake has its local frame at the start, with east along x.
    cosine, sine = math.cos(0.5), math.sin(0.5)
    east = [cosine * 1.0 - sine * -1.5, sine * 1.0 + cosine * -1.5]
    assert_allclose(flight.where[:2] - START[:2], east, atol=0.35)
    state = flight.team.state
    stamp, pose = stamp_from_ros(state.header.stamp), pose_from_ros(state.pose.pose)
    assert pose.yaw == pytest.approx(-0.5, abs=0.05)
    target = pose.position[:2] + np.array([0.1, -0.05])
    flight.team.ask(stamp)
    image = rendered(flight.team, [target.tolist()], pose)
    flight.team.images.publish(stamped(image, stamp))
    assert_allclose(flight.team.seen_at(), target, atol=0.03)


def test_a_localiser_says_where_the_frame_of_the_autopilot_is(fly):
    flight = fly(pose_source='pose')
    poses = flight.team.create_publisher(PoseStamped, '/rover/pose', 10)
    # The autopilot's north is off, and its origin elsewhere.
    seen_from = Pose.from_yaw([0.7, -0.4, 0.1], 0.4)

    def say():
        message = PoseStamped(pose=pose_to_ros(compose(seen_from, flight.drone.state.pose)))
        message.header.frame_id = 'map'
        message.header.stamp = stamp_to_ros(flight.team.get_clock().now().nanoseconds)
        poses.publish(message)

    def until(condition):
        flight.until(lambda: say() or condition())

    flight.until(lambda: UNTIL_ARM in flight.driver.health.text)
    assert flight.call('arm').message == 'no pose'
    until(lambda: flight.team.states and flight.call('arm').success)
    until(lambda: flight.status != AgentState.UNAVAILABLE)
    goal = [3.0, -1.0, 1.0]
    assert flight.team.takes(goal, live=say)
    until(lambda: flight.status == AgentState.REACHED)
    there = compose(seen_from, flight.drone.state.pose).position
    assert_allclose(there, goal, atol=0.35)
    # Without it the vehicle stays where it was sent last.
    flight.until(lambda: 'no pose for' in flight.reason)
    flight.until(lambda: flight.speed < STOPPED)


# ---- safety ----------------------------------------------------------------------------------


def test_it_takes_off_each_time_that_the_service_is_called(fly):
    flight = fly(start=[1.0, 2.0, 2.0])
    flight.until(lambda: UNTIL_ARM in flight.reason)
    assert flight.status == AgentState.UNAVAILABLE
    assert flight.driver.link.status()['parameter FS_GCS_ENABLE'] == 5.0
    # The origin is kept for a driver that is started again.
    kept = Path(os.environ['ROS_HOME']) / 'maasi' / 'rover_flight_origin.json'
    assert not kept.exists()
    flight.arm()
    flight.until(lambda: flight.where[2] > 0.3)
    # The service stop ends a take-off.
    assert flight.call('stop').success
    flight.until(lambda: not flight.autopilot.armed)
    assert flight.doing == 'LAND' and 'its take-off was stopped' in flight.reason
    assert flight.call('arm').message == STOPPED_BY_SERVICE
    assert flight.call('release').success
    flight.fly()
    assert kept.exists()
    assert flight.call('arm').message == 'it is in the air already'


def test_a_vehicle_in_the_air_is_taken_over_and_the_answer_says_so(fly):
    flight = fly(link={'arm': False})
    flight.until(lambda: 'arm is false' in flight.reason)
    with flight.lock:
        # A pilot has brought it there.
        flight.autopilot.armed = True
        flight.autopilot.body.position[2] = 1.0
        flight.autopilot.take_mode('GUIDED')
    flight.until(lambda: flight.driver.link.status().get('in the air'))
    flight.until(lambda: 'it is armed in GUIDED, not by this driver' in flight.reason)
    assert flight.call('arm').message == 'it is in the air: it is taken over where it is'
    flight.until_it_flies()


def test_blown_out_of_the_geofence_it_comes_back(fly):
    flight = fly(link={'geofence': [[-3.0, 3.0], [-3.0, 3.0], [0.5, 3.0]]}).fly()
    assert 'the geofence' in flight.driver.goals.problem(flight.team.goal([0.0, 3.5, 0.8]))
    with flight.lock:
        flight.autopilot.body.position = np.array([3.5, 0.0, 0.8])
    flight.until(lambda: 'm outside the geofence' in flight.reason)
    flight.until(lambda: flight.where[0] < 3.1)
    flight.until(lambda: flight.status != AgentState.UNAVAILABLE)


def test_a_fault_ends_the_way_and_is_said(fly, capfd):
    flight = fly({'parameters': {'FS_GCS_TIMEOUT': 60}}, {'link_timeout': 1.0})
    result = flight.fly().under_way()
    flight.drone.cut()
    flight.gives_up(result, 'link: nothing heard from system 1')
    flight.drone.cut(False)
    result = flight.until_it_flies().under_way()
    with flight.lock:
        flight.autopilot.disarm('Crash: Disarming')
    flight.gives_up(result, 'is disarmed: by the autopilot or the pilot (')
    assert 'Crash: Disarming' in flight.reason
    said = capfd.readouterr().err
    assert 'is disarmed: by the autopilot or the pilot (' in said
    # It says by itself why it has no position.
    assert 'no LOCAL_POSITION_NED yet' not in said


def test_a_clock_that_jumps_back_stops_it_and_begins_anew(fly, set_back):
    flight = fly(odometry_timeout=0.5).fly()
    flight.restarts_by_its_clock(flight.under_way(), set_back, [1.0, 1.5, 0.8])


def test_with_a_low_battery_it_lands(fly, monkeypatch, capfd):
    monkeypatch.setattr(watchdog, '_CHARGE_PATIENCE', 2.5)
    # High enough that it does not land before the pilot takes it.
    flight = fly({'endurance': 1e9}, battery_minimum=0.2, start=[*START[:2], 4.0]).fly()
    autopilot = flight.autopilot
    # One that stays the same has been heard all the same.
    begin = time.monotonic()
    flight.until(lambda: time.monotonic() - begin > 4.0)
    assert 'battery_minimum cannot act' not in capfd.readouterr().err
    result = flight.under_way(4.0)
    with flight.lock:
        autopilot.charge = 0.15
    flight.gives_up(result, 'battery at 0.15, below 0.20')
    # A request that is on its way would go over a pilot.
    flight.until(lambda: flight.driver.link._link.vehicle.at_rest)
    assert flight.doing == 'LAND'
    # It lands again once a pilot who took it over gives it back.
    with flight.lock:
        autopilot.take_mode('LOITER')
    flight.until(lambda: 'the pilot has taken over' in flight.reason)
    begin = time.monotonic()
    flight.until(lambda: time.monotonic() - begin > 0.5)
    assert flight.doing == 'LOITER' and 'battery at 0.15' in flight.reason
    with flight.lock:
        autopilot.take_mode('GUIDED')
    flight.until(lambda: flight.doing == 'LAND')
    flight.until(lambda: not autopilot.armed)


def test_a_port_that_is_taken_is_tried_again(fly):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(('127.0.0.1', 0))
        flight = fly(link={'url': f'udpin:127.0.0.1:{other.getsockname()[1]}'})
        flight.until(lambda: 'mavlink.url: read' in flight.reason)
    flight.fly()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGKILL])
def test_a_driver_that_ends_or_is_killed(fly, number):
    """With SIGKILL only the failsafe of the autopilot is left."""
    flight = fly({'parameters': {'FS_GCS_TIMEOUT': 3}}, own_process=True)
    result = flight.fly().under_way()
    before = flight.where
    flight.is_sent(number, result)
    assert number != signal.SIGINT or flight.doing == 'LAND'
    flight.until_stopped(before)
    flight.until(lambda: flight.doing == 'LAND')
