"""The Mambo's driver through pyparrot over loopback, to a fake that flies in real time."""

import math
import os
import signal
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from mambo_flights import GOAL, START, YAW, Flight, noise_image, send_feed
from numpy.testing import assert_allclose
from rclpy.executors import SingleThreadedExecutor
from robot_team import MAMBO, parameters_of, rendered
from waiting import wait_until

from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.agent.watchdog import PERIOD as WATCH_PERIOD
from maasi_drivers.drivers import MamboDriver, TurtlebotDriver
from maasi_drivers.links.mambo.mambo_robot_link import POLL_PERIOD
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.settings.vehicles import MamboSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_drivers.vision.detector import Blobs
from maasi_drivers.vision.measurement_feed import FeedPacket
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import pose_to_ros, stamp_from_ros, stamp_to_ros
from maasi_filter.ros.parameters import flatten
from maasi_msgs.msg import AgentState
from maasi_sim.emulators.mambo.fake_mambo import FakeMambo, free_address, free_port
from maasi_sim.emulators.mambo.firmware import FirmwareSettings, FlyingState

# After a fault the drone hovers or lands by then [s].
LATEST = 1.5


@pytest.fixture
def fly(context):
    """Return a function that starts a driver in this process, and all around it."""
    started = []
    executor = SingleThreadedExecutor(context=context)

    def start(**changes):
        flight = Flight(**changes)
        driver = MamboDriver(
            context=context,
            namespace='/rover',
            parameter_overrides=parameters_of(flight.settings),
        )
        started.extend([driver, flight])
        executor.add_node(driver)
        flight.meet(context, executor)
        assert driver.trigger_configure().name == 'SUCCESS'
        assert driver.trigger_activate().name == 'SUCCESS'
        flight.team.connect()
        flight.driver = driver
        return flight

    yield start
    for item in started:
        if isinstance(item, Flight):
            item.close()
        else:
            item.halt()
            item.destroy_node()
    executor.shutdown()


@pytest.fixture
def process(context, tmp_path):
    """Return a function that starts a driver in a process of its own, and all around it."""
    started = []
    executor = SingleThreadedExecutor(context=context)

    def start(**changes):
        flight = Flight(**changes)
        flight.meet(context, executor)
        file = tmp_path / 'parameters.yaml'
        flat = flatten(DriverSettings.model_validate(flight.settings))
        file.write_text(yaml.safe_dump({'/**': {'ros__parameters': flat}}))
        command = ['mambo_driver', '--ros-args']
        command += ['--remap', '__ns:=/rover', '--params-file', str(file)]
        driver = subprocess.Popen(command, env=os.environ)
        started.extend([driver, flight])
        flight.team.connect()
        return driver, flight

    yield start
    for item in started:
        if isinstance(item, Flight):
            item.close()
        else:
            item.kill()
            item.wait()
    executor.shutdown()


def hears_why(flight, result, reason):
    """Check that the planner hears why the way has ended, and that it is not sent on."""
    flight.until(lambda: flight.status == AgentState.UNAVAILABLE and reason in flight.reason)
    flight.until(result.done)
    assert result.result().status == GoalStatus.STATUS_ABORTED
    assert flight.team.refused(GOAL)


# ---- a flight --------------------------------------------------------------------------------


def test_it_takes_off_goes_where_it_is_sent_and_lands(fly):
    flight = fly()
    flight.until(lambda: flight.status == AgentState.UNAVAILABLE)
    flight.up()
    assert_allclose(flight.where, START, atol=0.15)
    assert flight.fake.firmware.take_offs == 1
    for point in (GOAL, [1.2, 1.5, 0.5]):
        _, result = flight.team.send_accepted(point)
        flight.until(result.done)
        assert result.result().status == GoalStatus.STATUS_SUCCEEDED
        assert np.linalg.norm(flight.where - point) < 0.1
    state = flight.team.state
    place = state.pose.pose.position
    assert_allclose([place.x, place.y, place.z], flight.where, atol=0.06)
    assert state.battery == pytest.approx(1.0, abs=0.02)
    flight.driver.trigger_deactivate()
    assert flight.flying_state in (FlyingState.LANDING, FlyingState.LANDED)
    flight.until(lambda: flight.flying_state == FlyingState.LANDED)
    assert flight.fake.firmware.take_offs == 1
    assert flight.fake.refused == 0


def test_the_next_waypoint_replaces_one_without_a_stop(fly, monkeypatch):
    flight = fly().up()
    shares = []
    link = flight.driver.link._link
    steer = link.steer
    monkeypatch.setattr(link, 'steer', lambda *item: (shares.append(item), steer(*item)))
    _, replaced = flight.team.send_accepted([1.0, 0.4, START[2]], number=1)
    flight.until(lambda: flight.where[1] < 0.75)
    shares.clear()
    _, result = flight.team.send_accepted([1.0, -0.1, START[2]], number=2)
    slowest = []
    flight.until(lambda: slowest.append(flight.speed) or flight.where[1] < 0.3)
    assert replaced.done() and replaced.result().result.reason == 'replaced'
    # It is never made to hover in between.
    assert len(shares) > 5 and (0.0, 0.0, 0.0, 0.0) not in [tuple(item) for item in shares]
    assert min(slowest) > 0.1
    # Nobody sends it further: it stops at its last waypoint.
    flight.until(result.done)
    assert result.result().result.reached
    flight.until(lambda: flight.speed < 0.05)
    assert_allclose(flight.where, [1.0, -0.1, START[2]], atol=0.15)


def test_nothing_takes_off_without_arm(fly):
    flight = fly(mambo={'arm': False})
    flight.until(lambda: 'mambo.arm' in flight.reason)
    assert flight.status == AgentState.UNAVAILABLE
    assert flight.team.refused(GOAL)
    known = len(flight.team.states)
    flight.until(lambda: len(flight.team.states) > known + 20)
    assert flight.fake.firmware.take_offs == 0
    assert (2, 0, 1) not in flight.fake.heard and flight.where[2] == 0.0


@pytest.mark.parametrize('source', ['pose', 'odometry'])
def test_it_flies_by_another_system(fly, source):
    """Its own position events do not come at all."""
    flight = fly(mambo={'pose': source})
    flight.fake.position_sent = 'none'
    team = flight.team
    publisher = team.create_publisher(PoseStamped, 'pose', 10)
    silent = False

    def tell():
        if not silent:
            stamp = team.get_clock().now().nanoseconds
            state = flight.fake.state
            if source == 'pose':
                message = PoseStamped(pose=pose_to_ros(state.pose))
                message.header.frame_id = 'map'
                message.header.stamp = stamp_to_ros(stamp)
                publisher.publish(message)
            else:
                # The robot of the team is where the fake is.
                team.body = team.motion.body(state)
                message = team.odometry_message(stamp)
                offset = START[2] - team.start.position[2]
                message.pose.pose.position.z += offset
                team.odometry.publish(message)

    team.create_timer(0.04, tell)
    flight.up()
    _, result = team.send_accepted(GOAL)
    flight.until(result.done)
    assert result.result().status == GoalStatus.STATUS_SUCCEEDED
    assert np.linalg.norm(flight.where - GOAL) < 0.1
    _, result = team.send_accepted(START)
    silent = True
    hears_why(flight, result, 'no position for')
    flight.until(lambda: flight.flying_state == FlyingState.LANDED)


# ---- what it sees ----------------------------------------------------------------------------


def test_images_of_a_topic_are_placed_where_the_drone_was(fly):
    flight = fly()
    flight.up()
    team, target = flight.team, np.array([1.03, 1.24])
    stamp = team.get_clock().now().nanoseconds
    message = rendered(team, [target.tolist()], flight.fake.state.pose)
    message.header.stamp = stamp_to_ros(stamp)
    team.images.publish(message)
    team.ask(stamp)
    found_at(team, target)


def found_at(team, target):
    answer = team.answer()
    assert len(answer.detections) == 1
    pose = answer.pose.pose.position
    seen = answer.detections[0]
    place = [pose.x + seen.range * math.cos(seen.bearing)]
    place += [pose.y + seen.range * math.sin(seen.bearing)]
    assert_allclose(place, target, atol=0.06)
    covariance = np.array(seen.covariance)
    assert np.isfinite(covariance).all() and covariance[0] > 0.0
    return answer


def test_blobs_found_on_board_come_by_the_measurement_feed(fly):
    port = free_port()
    flight = fly(image_source='feed', feed_port=port)
    flight.up()
    team, target = flight.team, np.array([1.03, 1.24])
    camera = Camera.from_settings(team.settings.camera)
    pixels = camera.project(np.array([[*target, 0.0]]), flight.fake.state.pose)
    blobs = Blobs(
        centroids=np.asarray(pixels, dtype=float).reshape(1, 2),
        areas=np.array([200.0]),
        extents=np.array([[16.0, 16.0]]),
        border_cut=np.array([False]),
        covariances=np.zeros((1, 2, 2)),
    )
    sent = team.get_clock().now().nanoseconds
    send_feed(port, FeedPacket(1, 0.02, 160, 120, blobs))
    send_feed(port, FeedPacket(2, 0.02, 320, 240, blobs))
    team.ask(sent - 100_000_000)
    answer = found_at(team, target)
    assert abs(stamp_from_ros(answer.header.stamp) - (sent - 20_000_000)) < 1_000_000_000
    # That of another size.
    flight.until(lambda: flight.driver.dropped['image'] == 1)


def test_images_of_a_video(fly, tmp_path):
    target = np.array([1.03, 1.24])
    path = tmp_path / 'flight.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 10.0, (160, 120))
    robot = SimpleNamespace(settings=DriverSettings.model_validate(MAMBO))
    message = rendered(robot, [target.tolist()], Pose.from_yaw(START, YAW))
    image = np.asarray(message.data, dtype=np.uint8).reshape(120, 160, 3)
    for _ in range(300):
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    flight = fly(image_source='video', video=str(path))
    flight.up()
    team = flight.team
    team.ask(team.get_clock().now().nanoseconds)
    found_at(team, target)


# ---- safety ----------------------------------------------------------------------------------


def test_what_is_waited_for_is_short_enough():
    """With these settings; that it hovers or lands by then is in the tests of the pilot."""
    settings, firmware = MamboSettings(), FirmwareSettings()
    sensors = 0.5
    assert settings.link_timeout > sensors
    assert settings.link_timeout + 2.0 * POLL_PERIOD + WATCH_PERIOD <= LATEST
    # Without new commands its firmware has it hover.
    assert firmware.command_timeout <= LATEST


@pytest.mark.parametrize(
    ('fault', 'reason'),
    [
        ({'cut_up': True, 'cut_down': True}, 'link lost: nothing from the Mambo for'),
        ({'position_sent': 'stuck'}, 'the position has not changed for'),
        ({'position_sent': 'nan'}, 'no position for'),
    ],
)
def test_what_is_lost_has_it_hover_then_land(fly, fault, reason):
    flight = fly()
    _, result = flight.on_its_way()
    for name, value in fault.items():
        setattr(flight.fake, name, value)
    hears_why(flight, result, reason)
    flight.until(lambda: flight.flying_state != FlyingState.FLYING)
    flight.until(lambda: flight.flying_state == FlyingState.LANDED)
    # The drone may have landed by itself before its driver gives up.
    ends = f'landing: {reason}', f'landed: {reason}'
    flight.until(lambda: flight.reason.startswith(ends))
    flight.fake.cut_up = flight.fake.cut_down = False
    flight.fake.position_sent = 'true'
    flight.until(lambda: flight.reason.startswith(f'landed: {reason}'))
    assert flight.fake.firmware.take_offs == 1


def test_a_clock_that_jumps_back_stops_it_and_begins_anew(fly, set_back):
    flight = fly()
    _, result = flight.on_its_way()
    set_back(flight.driver, 1000.0)
    flight.until(result.done)
    assert result.result().result.reason == 'the time jumped back'
    flight.until(lambda: flight.speed < 0.05)
    _, result = flight.team.send_accepted(GOAL)
    flight.until(result.done)
    assert result.result().result.reached


def test_a_driver_whose_executor_hangs_has_it_hover_then_land(fly):
    flight = fly(mambo={'land_after': 1.0})
    firmware = flight.fake.firmware
    # Not by its own watchdog: the last command would be flown for ever.
    firmware.settings = replace(firmware.settings, command_timeout=math.inf)
    flight.on_its_way()
    assert flight.speed > 0.1
    # Nothing spins the executor meanwhile.
    wait_until(lambda: flight.speed < 0.05, what=lambda: flight.flying_state)
    # It was told so before it lands.
    assert flight.flying_state in (FlyingState.HOVERING, FlyingState.FLYING)
    wait_until(lambda: flight.flying_state == FlyingState.LANDED, what=lambda: flight.flying_state)
    # Once it is looked after again, it is said why it does not go on.
    flight.until(lambda: flight.status == AgentState.UNAVAILABLE and 'Mambo is' in flight.reason)


def test_a_cancelled_goal_has_it_hover_then_land(fly):
    flight = fly(mambo={'cancel_landing': 3.0})
    handle, result = flight.on_its_way()
    handle.cancel_goal_async()
    flight.until(result.done)
    assert result.result().status == GoalStatus.STATUS_CANCELED
    flight.until(lambda: flight.speed < 0.05)
    assert flight.flying_state in (FlyingState.HOVERING, FlyingState.FLYING)
    flight.until(lambda: flight.flying_state == FlyingState.LANDED)
    # The driver hears of it a little later.
    flight.until(lambda: UNTIL_ARM in flight.reason)
    assert UNTIL_ARM in flight.team.refused(GOAL)


def test_a_goal_outside_the_geofence_is_refused_and_leaves_it_where_it_is(fly):
    flight = fly()
    flight.up()
    points = [[1.7, 0.8, 1.6], [1.7, 0.8, -0.1], [2.6, 0.8, 0.5], [math.nan, 0.8, 0.5]]
    for number, point in enumerate(points, start=1):
        assert flight.team.refused(point)
        assert flight.driver.dropped['goal'] == number
    flight.until(lambda: flight.flying_state == FlyingState.HOVERING)
    assert flight.status in (AgentState.IDLE, AgentState.ABORTED)


@pytest.mark.parametrize('fault', ['silent', 'repeats itself'])
def test_a_camera_that_hangs_has_it_hover(fly, fault):
    flight = fly(sensor_timeout=None)
    team = flight.team
    last = noise_image(1)
    hangs = False

    def photograph():
        nonlocal last
        stamp = team.get_clock().now().nanoseconds
        if not hangs:
            last = noise_image(stamp)
        elif fault == 'silent':
            return
        last.header.stamp = stamp_to_ros(stamp)
        team.images.publish(last)

    team.create_timer(0.1, photograph)
    _, result = flight.on_its_way()
    hangs = True
    hears_why(flight, result, 'no new image for')
    flight.until(lambda: flight.flying_state == FlyingState.HOVERING)
    hangs = False
    flight.up()
    assert flight.team.takes(GOAL)


def test_when_its_driver_is_killed_the_firmware_has_it_hover_then_land(process):
    driver, flight = process()
    flight.on_its_way()
    assert flight.flying_state == FlyingState.FLYING
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    flight.until(lambda: flight.flying_state == FlyingState.HOVERING)
    flight.until(lambda: flight.flying_state == FlyingState.LANDED)


def test_a_driver_that_is_told_to_end_lands_it(process):
    driver, flight = process()
    _, result = flight.on_its_way()
    driver.send_signal(signal.SIGINT)
    flight.until(lambda: driver.poll() is not None)
    assert driver.returncode == 0
    # It has waited for the drone to say so.
    assert flight.flying_state in (FlyingState.LANDING, FlyingState.LANDED)
    flight.until(result.done)
    assert result.result().result.reason == 'the driver stops'


# ---- what cannot be --------------------------------------------------------------------------


def refused(context, made, settings):
    node = made(context=context, namespace='/rover', parameter_overrides=parameters_of(settings))
    assert node.trigger_configure().name == 'FAILURE'
    problem = node.problem
    node.destroy_node()
    return problem


def test_a_link_that_cannot_be_is_said(context, monkeypatch):
    from pyparrot import Minidrone

    flight = Flight()
    flight.close()
    settings = flight.settings
    assert "read 'mambo_wifi', allowed with this driver is topics" in refused(
        context, TurtlebotDriver, settings
    )
    monkeypatch.setattr(Minidrone, 'BLEAvailable', False)
    assert 'bluepy is not installed' in refused(
        context, MamboDriver, settings | {'link': 'mambo_ble'}
    )
    monkeypatch.setattr(Minidrone, 'BLEAvailable', True)
    assert 'address of a Mambo by Bluetooth: read' in refused(
        context, MamboDriver, settings | {'link': 'mambo_ble'}
    )
    assert 'video' in refused(
        context, MamboDriver, settings | {'image_source': 'video', 'video': '/no/such/file.avi'}
    )


def test_a_drone_that_is_not_there_is_said_and_awaited(fly):
    address = free_address()
    flight = fly(mambo={'address': address})
    flight.until(lambda: f'no Mambo at {address}' in flight.reason)
    assert flight.status == AgentState.UNAVAILABLE
    firmware = flight.fake.firmware
    flight.fake.close()
    flight.fake = FakeMambo(firmware, address)
    flight.up()
    assert firmware.take_offs == 1
