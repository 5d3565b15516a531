"""The Mambo's driver through pyparrot over loopback, to a fake that flies in real time.

What the pilot does about faults is in test_mambo_pilot.py; here is what only topics and processes
show.
"""

import math
import signal
from dataclasses import replace

import cv2
import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from fake_bluepy import BluetoothMambo
from geometry_msgs.msg import PoseStamped
from linked_flight import LinkedFlight
from marker_view import one_image
from numpy.testing import assert_allclose
from robot_team import MAMBO, parameters_of
from waiting import wait_until

from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.agent.watchdog import PERIOD as WATCH_PERIOD
from maasi_drivers.drivers import MamboDriver, TurtlebotDriver
from maasi_drivers.links.mambo.mambo_robot_link import POLL_PERIOD
from maasi_drivers.settings.driver import DriverSettings
from maasi_drivers.settings.vehicles import MamboSettings
from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import pose_from_ros, pose_to_ros, stamp_to_ros
from maasi_msgs.msg import AgentState
from maasi_sim.simulation.emulators.mambo.fake_mambo import FakeMambo, free_address, free_port
from maasi_sim.simulation.emulators.mambo.firmware import (
    FirmwareSettings,
    FlyingState,
    MamboFirmware,
)
from maasi_sim.simulation.odometry import OdometrySettings

START, YAW = [1.0, 1.2, 0.4], 0.6
GOAL = [1.7, 0.8, 0.5]
FULL_SPEED = 9.81 * math.tan(MAMBO['motion']['tilt']) / FirmwareSettings().drag
# After a fault the drone hovers or lands by then [s].
LATEST = 1.5


def firmware(lost_link='land'):
    return MamboFirmware(
        Pose.from_yaw([*START[:2], 0.0], YAW),
        FirmwareSettings(take_off_height=0.3, lost_link=lost_link),
        odometry=OdometrySettings(position_noise=0.002, heading_noise=0.002),
    )


class Flight(LinkedFlight):
    """A fake Mambo behind its driver."""

    def __init__(self, context, drone, mambo, changes):
        self.drone = drone
        link = {'arm': True, 'full_speed': FULL_SPEED, 'address': drone.address}
        # The machine may be busy.
        link |= {'port': free_port(), 'link_timeout': 2.0} | mambo
        own = {'start': START, 'yaw': YAW, 'link': 'mambo_wifi', 'mambo': link}
        own |= {'odometry_timeout': 0.5, 'battery_minimum': 0.0}
        super().__init__(context, MAMBO | own | changes)

    @property
    def doing(self):
        return self.drone.firmware.flying_state

    def until_it_is(self, *states):
        self.until(lambda: self.doing in states)

    def on_its_way(self):
        """Wait until it flies to a goal; return the goal's handle and result to come."""
        handle, result = self.arm().until_it_flies().team.send_accepted(GOAL)
        self.until(lambda: self.away(START) > 0.1)
        return handle, result

    def seen_from_outside(self, source):
        """Return itself; another system says where it is, its own position events do not come."""
        team = self.team
        publisher = team.create_publisher(PoseStamped, 'pose', 10)
        self.drone.position_sent = 'none'

        def tell():
            stamp, state = team.get_clock().now().nanoseconds, self.drone.state
            if source == 'pose':
                message = PoseStamped(pose=pose_to_ros(state.pose))
                message.header.frame_id = 'map'
                message.header.stamp = stamp_to_ros(stamp)
                publisher.publish(message)
            else:
                # The robot of the team is where the fake is.
                team.body = team.motion.body(state)
                message = team.odometry_message(stamp)
                message.pose.pose.position.z += START[2] - team.start.position[2]
                team.odometry.publish(message)

        team.create_timer(0.04, tell)
        return self


@pytest.fixture
def fly(context, flights):
    """Return a function that starts a driver in this process, and all around it."""

    def start(mambo=None, drone=None, **changes):
        drone = drone or FakeMambo(firmware(), free_address())
        return flights(Flight(context, drone, mambo or {}, changes)).run_node(MamboDriver)

    return start


# ---- a flight --------------------------------------------------------------------------------


def test_it_goes_where_it_is_sent_and_lands_where_its_goal_is_cancelled(fly):
    flight = fly({'cancel_landing': 3.0})
    flight.until(lambda: flight.status == AgentState.UNAVAILABLE)
    team = flight.arm().until_it_flies().team
    assert_allclose(flight.where, START, atol=0.15)
    for point in ([1.7, 0.8, 1.6], [1.7, 0.8, -0.1], [2.6, 0.8, 0.5], [math.nan, 0.8, 0.5]):
        assert team.refused(point)
    assert flight.driver.dropped['goal'] == 4
    last = [1.0, -0.1, START[2]]
    assert flight.slowest_past([1.0, 0.4, START[2]], last, 0.4) > 0.1
    assert_allclose(flight.where, last, atol=0.1)
    assert_allclose(pose_from_ros(team.state.pose.pose).position, flight.where, atol=0.06)
    assert team.state.battery == pytest.approx(1.0, abs=0.02)
    handle, result = team.send_accepted(GOAL)
    flight.until(lambda: flight.away(last) > 0.1)
    handle.cancel_goal_async()
    flight.until(result.done)
    assert result.result().status == GoalStatus.STATUS_CANCELED
    flight.until(lambda: flight.speed < 0.05)
    assert flight.doing in (FlyingState.HOVERING, FlyingState.FLYING)
    flight.until_it_is(FlyingState.LANDED)
    # The driver hears of it a little later.
    flight.until(lambda: UNTIL_ARM in flight.reason)
    assert UNTIL_ARM in team.refused(GOAL)
    assert flight.drone.firmware.take_offs == 1 and flight.drone.refused == 0


def test_markers_in_a_video_are_placed_where_the_drone_was(play, tmp_path):
    path, target = tmp_path / 'flight.avi', np.array([1.03, 1.24])
    camera = DriverSettings.model_validate(MAMBO).camera
    image = one_image(camera, [target.tolist()], Pose.from_yaw(START, YAW))
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 10.0, (160, 120))
    for _ in range(300):
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    _, team = play('mambo', start=START, yaw=YAW, image_source='video', video=str(path))

    def say():
        now = team.get_clock().now().nanoseconds
        team.odometry.publish(team.odometry_message(now))
        return now

    team.until(lambda: say() and team.states)
    team.ask(say())
    team.until(lambda: say() and team.detections)
    assert_allclose(team.seen_at(), target, atol=0.06)


# ---- safety ----------------------------------------------------------------------------------


def test_what_is_waited_for_is_short_enough():
    """With these settings; that it hovers or lands by then is in the tests of the pilot."""
    # Sensors come twice a second.
    link_timeout = MamboSettings().link_timeout
    assert link_timeout > 0.5 and link_timeout + 2.0 * POLL_PERIOD + WATCH_PERIOD <= LATEST
    # Without new commands its firmware has it hover.
    assert FirmwareSettings().command_timeout <= LATEST


@pytest.mark.parametrize(('lost_link', 'source'), [('hover', 'odometry'), ('land', 'pose')])
def test_it_flies_without_sensor_stamps_and_notices_a_lost_link(
    fly, monkeypatch, lost_link, source
):
    drone = BluetoothMambo(monkeypatch, firmware(lost_link))
    settings = {'pose': source, 'link_timeout': 1.5, 'land_after': 1.0}
    flight = fly(settings, drone, link='mambo_ble').seen_from_outside(source)
    _, result = flight.on_its_way()
    # One piloting command after the other, and what has to be acknowledged.
    assert drone.heard[2, 0, 2] >= 5 and drone.heard[2, 8, 1]
    drone.cut()
    flight.gives_up(result, 'link lost: nothing from the Mambo')
    flight.until(lambda: flight.reason.startswith('landing: link lost'))
    if lost_link == 'hover':
        assert flight.doing == FlyingState.HOVERING
    drone.cut(False)
    flight.until_it_is(FlyingState.LANDED)
    assert drone.firmware.take_offs == 1


def test_a_clock_that_jumps_back_stops_it_and_begins_anew(fly, set_back):
    flight = fly()
    _, result = flight.on_its_way()
    flight.restarts_by_its_clock(result, set_back, GOAL)


def test_a_driver_whose_executor_hangs_has_it_hover_then_land(fly):
    flight = fly({'land_after': 1.0})
    inside = flight.drone.firmware
    # Not by its own watchdog: the last command would be flown for ever.
    inside.settings = replace(inside.settings, command_timeout=math.inf)
    flight.on_its_way()
    assert flight.speed > 0.1
    # Nothing spins the executor meanwhile.
    wait_until(lambda: flight.speed < 0.05, what=lambda: flight.doing)
    # It was told so before it lands.
    assert flight.doing in (FlyingState.HOVERING, FlyingState.FLYING)
    wait_until(lambda: flight.doing == FlyingState.LANDED, what=lambda: flight.doing)
    # Once it is looked after again, it is said why it does not go on.
    flight.until(lambda: flight.status == AgentState.UNAVAILABLE and 'Mambo is' in flight.reason)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGKILL])
def test_a_driver_that_ends_or_is_killed(context, flights, process, number):
    """With SIGKILL only the firmware is left."""
    drone = FakeMambo(firmware(), free_address())
    flight = flights(Flight(context, drone, {}, {})).run_process(process, 'mambo_driver')
    _, result = flight.on_its_way()
    flight.is_sent(number, result)
    if number == signal.SIGINT:
        # It has waited for the drone to say so.
        assert flight.doing in (FlyingState.LANDING, FlyingState.LANDED)
    else:
        flight.until_it_is(FlyingState.HOVERING)
    flight.until_it_is(FlyingState.LANDED)


# ---- what cannot be --------------------------------------------------------------------------


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
def test_a_link_that_cannot_be_is_said(context, monkeypatch, kind, changes, bluetooth, text):
    from pyparrot import Minidrone

    monkeypatch.setattr(Minidrone, 'BLEAvailable', bluetooth)
    settings = MAMBO | {'link': 'mambo_wifi', 'mambo': {'port': free_port()}} | changes
    node = kind(context=context, namespace='/rover', parameter_overrides=parameters_of(settings))
    assert node.trigger_configure().name == 'FAILURE'
    assert text in node.problem
    node.destroy_node()


def test_a_drone_that_is_not_there_is_said_and_awaited(fly):
    address = free_address()
    flight = fly({'address': address})
    flight.until(lambda: f'no Mambo at {address}' in flight.reason)
    assert flight.status == AgentState.UNAVAILABLE
    flight.drone.close()
    flight.drone = FakeMambo(flight.drone.firmware, address)
    flight.arm().until_it_flies()
    assert flight.drone.firmware.take_offs == 1
