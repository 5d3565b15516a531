"""Flying robots behind links, over real sockets and topics: what all drivers promise, and each."""

import math
import os
import signal
import socket
import struct
import time
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from fake_bluepy import BluetoothMambo
from linked_flight import KINDS, YAW, LinkedFlight, mambo_firmware
from marker_view import one_image
from numpy.testing import assert_allclose
from robot_team import LATEST, MAMBO, parameters_of, rendered, stamped
from waiting import wait_until

from maasi_drivers.agent import watchdog
from maasi_drivers.agent.agent_driver import STOPPED
from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.drivers import MamboDriver, TurtlebotDriver
from maasi_drivers.links.mambo.mambo_robot_link import POLL_PERIOD as MAMBO_PERIOD
from maasi_drivers.links.mambo.onboard_link import OrderKind
from maasi_drivers.links.mambo.onboard_link import encode as encode_order
from maasi_drivers.links.mavlink.mavlink_robot_link import POLL_PERIOD as MAVLINK_PERIOD
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.settings.vehicles import MamboSettings, MavlinkSettings
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.models.pose import Pose, compose
from maasi_filter.ros.conversions import pose_from_ros, stamp_from_ros
from maasi_filter.ros.qos import LATCHED
from maasi_msgs.msg import AgentState, KeepOuts
from maasi_sim.simulation.emulators.mambo.fake_mambo import FakeMambo, free_address, free_port
from maasi_sim.simulation.emulators.mambo.firmware import FirmwareSettings


@pytest.fixture
def fly(context, monkeypatch, tmp_path):
    """Return a function that starts a robot of a kind, with its driver and its team."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    with ExitStack() as stack:

        def start(kind, own=(), process=None, **changes):
            flight = stack.enter_context(closing(KINDS[kind](context, own=own, **changes)))
            return flight.begin(process)

        yield start


def of_kinds(*kinds):
    return pytest.mark.parametrize('kind', kinds)


# ---- what all promise ------------------------------------------------------------------------


def test_what_is_waited_for_is_short_enough():
    """With these settings; that it stops by then is in the tests of pilot and vehicle."""
    # Sensors of a Mambo come twice a second.
    mambo, mavlink = MamboSettings(), MavlinkSettings()
    assert mambo.link_timeout > 0.5
    assert mambo.link_timeout + 2.0 * MAMBO_PERIOD + watchdog.PERIOD <= LATEST
    # Without new commands its firmware has it hover.
    assert FirmwareSettings().command_timeout <= LATEST
    assert mavlink.link_timeout + 2.0 * MAVLINK_PERIOD <= LATEST
    assert 1.0 / mavlink.setpoint_rate + mavlink.lead <= LATEST
    assert mavlink.require_failsafe is True
    assert mavlink.arm is mambo.arm is False


@of_kinds(*KINDS)
def test_it_goes_where_it_is_sent_and_lands_at_the_end(fly, monkeypatch, kind):
    own = {'cancel_landing': 3.0} if kind == 'mambo' else {}
    start = [*KINDS[kind].start[:2], 1.5 if kind == 'vehicle' else 1.0]
    flight = fly(kind, own, start=start, odometry_timeout=1.0)
    flight.until_said(UNTIL_ARM)
    assert flight.status == AgentState.UNAVAILABLE and flight.grounded
    # A stop ends a take-off.
    flight.arm().until(lambda: flight.where[2] > 0.2)
    assert flight.call('stop').success
    flight.until(lambda: flight.grounded)
    assert flight.call('arm').message == STOPPED
    assert flight.call('release').success
    flight.until_said(f'take-off stopped, {UNTIL_ARM}')
    team = flight.up().team
    assert flight.call('arm').message.startswith('it is in the air')
    flight.until(lambda: flight.away(start) < 0.25)
    for point in flight.outside:
        assert team.refused(point)
    assert flight.driver.dropped['goal'] == len(flight.outside)
    if kind == 'onboard':
        its_blobs_are_placed_where_it_is(flight)
    # It does not stop at a waypoint.
    first, last = flight.route
    _, replaced = team.send_accepted(first, number=1)
    flight.until(lambda: flight.away(first) < flight.near)
    _, result = team.send_accepted(last, number=2)
    speeds = []
    flight.until(lambda: speeds.append(flight.speed) or flight.away(last) < flight.near)
    assert min(speeds) > flight.least_speed
    assert team.aborted(replaced) == 'replaced'
    flight.until(result.done)
    assert result.result().result.reached
    flight.until(lambda: flight.speed < 0.05)
    assert_allclose(flight.where, last, atol=0.35 if kind == 'vehicle' else 0.1)
    assert_allclose(pose_from_ros(team.state.pose.pose).position, flight.where, atol=0.06)
    # A clock that jumps back stops it until the next goal.
    _, result = flight.moving_to_goal()
    stamp = flight.driver.arrivals.stamp
    monkeypatch.setattr(
        flight.driver.arrivals, 'stamp', lambda instant: stamp(instant) - 1_000_000_000_000
    )
    assert team.aborted(result) == 'time jumped back'
    flight.until(lambda: flight.speed < 0.1)
    flight.ready().reaches(last)
    # A cancelled goal stops it.
    handle, result = flight.moving_to_goal()
    before = flight.where
    handle.cancel_goal_async()
    flight.until(result.done)
    assert result.result().status == GoalStatus.STATUS_CANCELED
    flight.stops(before)
    assert flight.doing == 'air'
    if kind == 'mambo':
        flight.until_said(f'landed: its goal was cancelled, {UNTIL_ARM}')
        assert UNTIL_ARM in team.refused(flight.far)
        flight.driver.halt()
    else:
        _, result = flight.moving_to_goal()
        flight.driver.halt()
        assert team.aborted(result) == 'the driver stops'
    assert flight.doing != 'air'
    wait_until(lambda: flight.grounded)
    assert kind == 'vehicle' or flight.inside.take_offs == 2


def its_blobs_are_placed_where_it_is(flight):
    target = np.array([1.03, 1.24])
    team, drone = flight.team, flight.drone
    camera = Camera.from_settings(team.settings.camera)
    true = Pose.from_yaw(flight.where, YAW)
    pixel = np.asarray(camera.project(np.array([[*target, 0.0]]), true), dtype=float).ravel()
    drone.blobs = struct.pack('<8fI', *pixel, 0.0, 0.0, 0.0, 70.0, 9.4, 9.4, 0)
    drone.count = 1
    team.ask(team.get_clock().now().nanoseconds + 200_000_000)
    assert_allclose(team.seen_at(), target, atol=0.06)


@of_kinds('mambo', 'onboard')
def test_a_driver_whose_executor_hangs_has_it_hover_then_land(fly, kind):
    address = free_address()
    own = {'land_after': 1.0} | ({'address': address} if kind == 'mambo' else {})
    flight = fly(kind, own)
    # First, a drone that is not there is said and awaited.
    if kind == 'mambo':
        flight.until_said(f'no Mambo at {address}')
        assert flight.status == AgentState.UNAVAILABLE
        flight.drone.close()
        flight.drone = FakeMambo(flight.inside, address)
        # Not by its own watchdog: the last command would be flown for ever.
        inside = flight.inside
        inside.settings = replace(inside.settings, command_timeout=math.inf)
    else:
        flight.until_said(UNTIL_ARM)
        flight.drone.cut()
        flight.until_said('no ')
        assert flight.call('arm').message == 'it is in the air or not connected'
        flight.drone.cut(False)
    flight.up().moving_to_goal()
    assert flight.speed > 0.1
    # Nothing spins the executor meanwhile.
    wait_until(lambda: flight.speed < 0.05)
    assert flight.doing == 'air'
    wait_until(lambda: flight.grounded)
    # Once it is looked after again, it is said why it stays down.
    flight.until_said('by itself')
    assert flight.status == AgentState.UNAVAILABLE


@pytest.mark.parametrize(
    ('kind', 'number'),
    [('mambo', signal.SIGINT), ('mambo', signal.SIGKILL), ('vehicle', signal.SIGKILL)],
)
def test_a_driver_that_ends_or_is_killed(fly, process, kind, number):
    """With SIGKILL only the firmware, or the failsafe of the autopilot, is left."""
    failsafe = {'autopilot': {'parameters': {'FS_GCS_TIMEOUT': 3}}} if kind == 'vehicle' else {}
    flight = fly(kind, process=process, **failsafe).up()
    _, result = flight.moving_to_goal()
    before = flight.where
    flight.driver.send_signal(number)
    flight.until(lambda: flight.driver.poll() is not None)
    if number == signal.SIGINT:
        # It has waited for the robot to say so.
        assert flight.driver.returncode == 0 and flight.doing != 'air'
        assert flight.team.aborted(result) == 'the driver stops'
    flight.stops(before)
    flight.until(lambda: flight.doing != 'air')


# ---- a Mambo ---------------------------------------------------------------------------------


@pytest.mark.parametrize(('lost_link', 'source'), [('hover', 'odometry'), ('land', 'pose')])
def test_it_flies_without_sensor_stamps_and_notices_a_lost_link(
    fly, monkeypatch, lost_link, source
):
    drone = BluetoothMambo(monkeypatch, mambo_firmware(lost_link))
    drone.position_sent = 'none'
    own = {'pose': source, 'link_timeout': 1.5, 'land_after': 1.0}
    flight = fly('mambo', own, drone=drone, link='mambo_ble')
    flight.seen_from_outside(source)
    _, result = flight.up().moving_to_goal()
    # One piloting command after the other, and what has to be acknowledged.
    assert drone.received[2, 0, 2] >= 5 and drone.received[2, 8, 1]
    drone.cut()
    flight.gives_up(result, 'link lost: no data from the Mambo')
    flight.until_said('landing: link lost')
    assert lost_link == 'land' or flight.doing == 'air'
    drone.cut(False)
    flight.until(lambda: flight.grounded)
    assert flight.inside.take_offs == 1


@pytest.mark.parametrize(
    ('kind', 'changes', 'bluetooth', 'text'),
    [
        (TurtlebotDriver, {}, False, "read 'mambo_wifi', allowed with this driver is topics"),
        (MamboDriver, {'link': 'mambo_ble'}, False, 'bluepy is not installed'),
        (MamboDriver, {'link': 'mambo_ble'}, True, 'address of a Mambo by Bluetooth: read'),
        (MamboDriver, {'image_source': 'video', 'video': '/no/such/file.avi'}, False, 'video'),
        (MamboDriver, {'motion': {'model': 'unicycle'}}, False, "motion.model: read 'unicycle'"),
    ],
)
def test_a_link_that_cannot_be_is_said(start_node, monkeypatch, kind, changes, bluetooth, text):
    from pyparrot import Minidrone

    monkeypatch.setattr(Minidrone, 'BLEAvailable', bluetooth)
    settings = MAMBO | {'link': 'mambo_wifi', 'mambo': {'port': free_port()}} | changes
    node = start_node(kind, parameter_overrides=parameters_of(settings))
    assert node.trigger_configure().name == 'FAILURE'
    assert text in node.problem


def test_markers_in_a_video_are_placed_where_the_drone_was(play, tmp_path):
    path, target = tmp_path / 'flight.avi', np.array([1.03, 1.24])
    camera = DriverSettings.model_validate(MAMBO).camera
    image = one_image(camera, [target.tolist()], Pose.from_yaw(LinkedFlight.start, YAW))
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 10.0, (160, 120))
    for _ in range(300):
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    video = {'image_source': 'video', 'video': str(path)}
    _, team = play('mambo', start=LinkedFlight.start, yaw=YAW, **video)

    def say():
        now = team.get_clock().now().nanoseconds
        team.odometry.publish(team.odometry_message(now))
        return now

    team.until(lambda: say() and team.states)
    team.ask(say())
    team.until(lambda: say() and team.detections)
    assert_allclose(team.seen_at(), target, atol=0.06)


# ---- a drone with its own program -----------------------------------------------------------


def test_it_is_ordered_to_stay_on_the_ground_where_it_may_not_take_off(fly):
    flight = fly('onboard', {'arm': False})
    flight.until_said('mambo.arm')
    assert 'mambo.arm' in flight.call('arm').message
    assert 'mambo.arm' in flight.team.refused(flight.far)
    known = len(flight.drone.kinds)
    flight.until(lambda: len(flight.drone.kinds) > known + 10)
    assert set(flight.drone.kinds) == {OrderKind.LAND} and flight.grounded
    with pytest.raises(ValueError, match='finite numbers'):
        encode_order(1, OrderKind.GO, np.array([math.nan, 0.0, 0.0]))


def lose(flight):
    # It obeys commands, however late they come.
    flight.drone.patience, known = math.inf, len(flight.drone.kinds)
    flight.drone.cut()
    flight.until(lambda: flight.grounded)
    assert OrderKind.HOLD in flight.drone.kinds[known:]
    flight.drone.cut(False)


def empty(flight):
    flight.drone.charge = 0.05
    flight.until(lambda: flight.grounded)
    flight.drone.charge = 1.0


def blow(flight):
    flight.drone.model.position[0] -= 3.0
    flight.until(lambda: flight.grounded)
    flight.drone.model.position[0] += 3.0


def test_what_lands_it_and_keeps_it_down(fly):
    flight = fly('onboard')
    faults = [
        (lose, 'no data from the drone'),
        (empty, 'battery at 5 %, below 10 %'),
        (blow, 'outside the geofence, -0.41 to 2.51 m'),
        # Its program lands it.
        (lambda flight: setattr(flight.drone, 'patience', 0.0), 'by itself'),
    ]
    for number, (fault, reason) in enumerate(faults, start=1):
        _, result = flight.up().moving_to_goal()
        fault(flight)
        assert flight.team.aborted(result)
        flight.until_said(f'{reason}, {UNTIL_ARM}')
        assert flight.reason.startswith('landed: ') and flight.grounded
        assert flight.team.refused(flight.start)
        assert flight.inside.take_offs == number
        flight.drone.patience = 3.0


# ---- a vehicle under MAVLink -----------------------------------------------------------------


def test_a_camera_in_a_map_that_is_turned_against_north(fly):
    flight = fly(
        'vehicle',
        {'map_yaw': 0.5},
        environment={'bounds': [[-2.0, 4.0], [-2.0, 4.0]]},
        sensor={'detection': {'kind': 'box'}},
        camera={'focal_length': [220.0, 220.0]},
    ).up()
    flight.reaches([2.0, 0.5, 0.8])
    # The fake has its local frame at the start, with east along x.
    cosine, sine = math.cos(0.5), math.sin(0.5)
    east = [cosine * 1.0 - sine * -1.5, sine * 1.0 + cosine * -1.5]
    assert_allclose(flight.where[:2] - flight.start[:2], east, atol=0.35)
    state = flight.team.state
    stamp, pose = stamp_from_ros(state.header.stamp), pose_from_ros(state.pose.pose)
    assert pose.yaw == pytest.approx(-0.5, abs=0.05)
    target = pose.position[:2] + np.array([0.1, -0.05])
    flight.team.ask(stamp)
    image = rendered(flight.team, [target.tolist()], pose)
    flight.team.images.publish(stamped(image, stamp))
    assert_allclose(flight.team.seen_at(), target, atol=0.03)


def test_a_localiser_says_where_the_frame_of_the_autopilot_is(fly):
    flight = fly('vehicle', pose_source='pose')
    flight.until(lambda: UNTIL_ARM in flight.driver.health.text)
    assert flight.call('arm').message == 'no pose'
    # The autopilot's north is off, and its origin elsewhere.
    origin = Pose.from_yaw([0.7, -0.4, 0.1], 0.4)
    timer = flight.seen_from_outside(origin=origin)
    goal = [2.0, 1.0, 1.0]
    flight.up().reaches(goal)
    assert_allclose(compose(origin, flight.drone.state.pose).position, goal, atol=0.35)
    # Without it the vehicle stays where it was sent last.
    timer.cancel()
    flight.until_said('no pose for')
    flight.until(lambda: flight.speed < 0.1)


def test_a_vehicle_in_the_air_is_taken_over_and_the_answer_says_so(fly):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(('127.0.0.1', 0))
        url = f'udpin:127.0.0.1:{other.getsockname()[1]}'
        flight = fly('vehicle', {'arm': False, 'url': url})
        flight.until_said('mavlink.url: read')
    # A port that is taken is tried again.
    flight.until_said('arm is false')
    with flight.lock:
        # A pilot has brought it there.
        flight.inside.armed = True
        flight.inside.body.position[2] = 1.0
        flight.inside.set_mode('GUIDED')
    flight.until(lambda: flight.driver.link.status().get('in the air'))
    flight.until_said('armed in GUIDED by another program')
    assert flight.call('arm').message == 'in the air: taking control at its position'
    flight.ready()


def test_a_fault_ends_the_way_and_is_said(fly, capfd):
    failsafe = {'parameters': {'FS_GCS_TIMEOUT': 60}}
    own = {'link_timeout': 1.0, 'geofence': [[-3.0, 3.0], [-8.0, 8.0], [0.5, 3.0]]}
    flight = fly('vehicle', own, autopilot=failsafe).up()
    assert flight.driver.link.status()['parameter FS_GCS_ENABLE'] == 5.0
    # Its origin is kept for a driver that is started again.
    assert (Path(os.environ['ROS_HOME']) / 'maasi' / 'rover_flight_origin.json').exists()
    # Blown out of the geofence it comes back.
    assert 'the geofence' in flight.driver.goals.problem(flight.team.goal([3.5, 0.0, 0.8]))
    with flight.lock:
        flight.inside.body.position = np.array([3.5, 0.0, 0.8])
    flight.until_said('m outside the geofence')
    flight.until(lambda: flight.where[0] < 3.1)
    flight.ready()
    _, result = flight.moving_to_goal()
    flight.drone.cut()
    flight.gives_up(result, 'link: no message from system 1')
    flight.drone.cut(False)
    _, result = flight.ready().moving_to_goal()
    with flight.lock:
        flight.inside.disarm('Crash: Disarming')
    flight.gives_up(result, 'disarmed: by the autopilot or the pilot (')
    assert 'Crash: Disarming' in flight.reason
    said = capfd.readouterr().err
    assert 'disarmed: by the autopilot or the pilot (' in said
    assert 'fence: not uploaded, which needs' in said and 'environment.origin' in said
    # It says by itself why it has no position.
    assert 'no LOCAL_POSITION_NED received' not in said


def test_its_fence_is_the_area_and_follows_keep_outs(fly):
    area = 'POLYGON ((-8 -8, 8 -8, 8 8, -8 8, -8 -8))'
    environment = {'area': area, 'altitude': [-5.0, 5.0], 'keep_outs': ['5 5 1']}
    origin = {'latitude': 46.6, 'longitude': 9.9}
    flight = fly('vehicle', environment=environment | {'origin': origin}).up()
    fence = flight.inside.fence
    assert [item[1] for item in fence.items] == [4, 4, 4, 4, 1]
    publisher = flight.team.create_publisher(KeepOuts, '/keep_outs', LATCHED)
    flight.until(publisher.get_subscription_count)
    publisher.publish(KeepOuts(version=1, zones=['POLYGON ((4 4, 6 4, 5 6, 4 4))']))
    flight.until(lambda: [item[1] for item in fence.items] == [4, 4, 4, 4, 3, 3, 3])
    flight.reaches([1.0, 0.0, 0.8])
    # Another fence than that: it goes nowhere.
    fence.most = 6
    publisher.publish(KeepOuts(version=2, zones=['POLYGON ((4 4, 7 4, 5 6, 4 4))']))
    flight.until_said('fence not verified (MAV_MISSION_NO_SPACE)')
    assert 'fence ' in flight.team.refused(flight.start)


def test_with_a_low_battery_it_lands(fly, monkeypatch, capfd):
    monkeypatch.setattr(watchdog, '_CHARGE_PATIENCE', 2.5)
    # High enough that it does not land before the pilot takes it.
    endless, start = {'endurance': 1e9}, [1.0, 2.0, 3.0]
    begin = time.monotonic()
    flight = fly('vehicle', autopilot=endless, battery_minimum=0.2, start=start).up()
    # An unchanged charge is received nevertheless.
    flight.until(lambda: time.monotonic() - begin > 5.0)
    assert 'battery_minimum' not in capfd.readouterr().err
    flight.far = [1.0, -6.0, 3.0]
    _, result = flight.moving_to_goal()
    with flight.lock:
        flight.inside.charge = 0.15
    flight.gives_up(result, 'battery at 15 %, below 20 %')
    # A request that is on its way would go over a pilot.
    flight.until(lambda: flight.driver.link._link.vehicle.at_rest)
    assert flight.doing == 'landing'
    # It lands again once a pilot who took it over gives it back.
    with flight.lock:
        flight.inside.set_mode('LOITER')
    flight.until_said('the pilot has taken over')
    begin = time.monotonic()
    flight.until(lambda: time.monotonic() - begin > 0.5)
    assert flight.inside.mode_name == 'LOITER' and 'battery at 15 %' in flight.reason
    with flight.lock:
        flight.inside.set_mode('GUIDED')
    flight.until(lambda: flight.doing == 'landing')
    flight.until(lambda: flight.grounded)
