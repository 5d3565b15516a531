"""A drone with a program of its own: the feed carries its pose, waypoints go back."""

import math
import struct

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from linked_flight import LinkedFlight
from numpy.testing import assert_allclose
from onboard_program import AIR, GROUND, OnboardProgram
from robot_team import MAMBO
from waiting import wait_until

from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.drivers import MamboOnboardDriver
from maasi_drivers.links.mambo.onboard_link import OrderKind
from maasi_drivers.links.mambo.onboard_link import encode as encode_order
from maasi_drivers.vision.camera_model import Camera
from maasi_filter.models.pose import Pose, compose
from maasi_sim.simulation.emulators.mambo.fake_mambo import free_address, free_port

START, YAW, GROUND_HEIGHT = [1.0, 1.2, 0.6], 0.6, 0.1
GOAL = [1.7, 0.8, 0.7]
ORIGIN = Pose.from_yaw([*START[:2], GROUND_HEIGHT], YAW)


class Flight(LinkedFlight):
    """A drone with its own program behind its driver."""

    def __init__(self, context, mambo):
        port = free_port()
        self.drone = OnboardProgram(free_address(), ('127.0.0.1', port))
        link = {'arm': True, 'address': self.drone.address, 'order_port': self.drone.port}
        link |= {'ground': GROUND_HEIGHT, 'land_after': 1.0} | mambo
        own = {'start': START, 'yaw': YAW, 'link': 'mambo_feed', 'mambo': link}
        own |= {'image_source': 'feed', 'feed_port': port}
        super().__init__(context, MAMBO | own | {'battery_minimum': 0.0, 'odometry_timeout': 0.5})

    @property
    def where(self):
        return compose(ORIGIN, Pose(self.drone.model.position)).position

    def up(self):
        self.until(lambda: UNTIL_ARM in self.reason)
        assert self.drone.take_offs == 0
        return self.arm().until_it_flies()

    def on_its_way(self):
        # So far that it is not there before a fault is noticed.
        _, result = self.up().team.send_accepted([2.3, -0.2, 0.7])
        self.until(lambda: self.away(START) > 0.2)
        return result

    def has_landed(self, reason):
        """Check that it lands for a reason, and stays down."""
        self.until(lambda: self.drone.state == GROUND)
        self.drone.silent, self.drone.charge = False, 1.0
        self.until(lambda: self.reason == f'landed: {reason}, {UNTIL_ARM}')
        assert self.team.refused(GOAL)
        assert self.drone.take_offs == 1


@pytest.fixture
def fly(context, flights):
    def start(**mambo):
        return flights(Flight(context, mambo)).run_node(MamboOnboardDriver)

    return start


def test_it_takes_off_goes_where_it_is_sent_measures_and_lands(fly):
    flight = fly().up()
    assert_allclose(flight.where, START, atol=0.11)
    assert 'geofence' in flight.team.refused([1.7, 0.8, 1.8])
    _, result = flight.team.send_accepted(GOAL)
    flight.until(result.done)
    assert result.result().status == GoalStatus.STATUS_SUCCEEDED
    assert_allclose(flight.where, GOAL, atol=0.1)
    team, drone, target = flight.team, flight.drone, np.array([1.73, 0.84])
    camera = Camera.from_settings(team.settings.camera)
    true = Pose.from_yaw(flight.where, YAW)
    pixel = np.asarray(camera.project(np.array([[*target, 0.0]]), true), dtype=float).ravel()
    drone.blobs = struct.pack('<8fI', *pixel, 0.0, 0.0, 0.0, 70.0, 9.4, 9.4, 0)
    drone.count = 1
    team.ask(team.get_clock().now().nanoseconds + 200_000_000)
    assert_allclose(team.seen_at(), target, atol=0.06)
    flight.driver.trigger_deactivate()
    flight.until(lambda: drone.state == GROUND)
    assert drone.take_offs == 1


def test_nothing_takes_off_without_arm(fly):
    flight = fly(arm=False)
    flight.until(lambda: 'mambo.arm' in flight.reason)
    assert 'mambo.arm' in flight.call('arm').message
    assert flight.team.refused(GOAL)
    known = len(flight.drone.kinds)
    flight.until(lambda: len(flight.drone.kinds) > known + 10)
    assert set(flight.drone.kinds) == {OrderKind.LAND} and flight.drone.state == GROUND


def test_a_drone_that_is_not_heard_is_told_to_hover_then_to_land(fly):
    flight = fly()
    result = flight.on_its_way()
    # It obeys commands, however late they come.
    flight.drone.patience = math.inf
    flight.drone.silent = True
    known = len(flight.drone.kinds)
    flight.until(result.done)
    assert result.result().status == GoalStatus.STATUS_ABORTED
    flight.until(lambda: OrderKind.LAND in flight.drone.kinds[known:])
    assert OrderKind.HOLD in flight.drone.kinds[known:]
    flight.has_landed('nothing heard from the drone')


def test_the_service_stop_ends_a_take_off(fly):
    flight = fly()
    flight.until(lambda: UNTIL_ARM in flight.reason)
    # A permission needs a drone that is heard.
    flight.drone.silent = True
    flight.until(lambda: 'no ' in flight.reason)
    assert flight.call('arm').message == 'it is in the air, or not heard'
    flight.drone.silent = False
    flight.arm()
    flight.until(lambda: flight.where[2] > GROUND_HEIGHT + 0.1)
    assert flight.call('stop').success
    assert flight.call('release').success
    flight.has_landed('its take-off was stopped')


def test_a_low_battery_lands_it_and_it_stays_down(fly):
    flight = fly()
    flight.on_its_way()
    flight.drone.charge = 0.05
    flight.has_landed('battery at 0.05, below 0.10')


def test_a_driver_that_hangs_is_a_drone_that_hovers_then_lands(fly):
    """Orders come from the executor alone: one that stands still says nothing."""
    flight = fly()
    flight.on_its_way()
    wait_until(lambda: np.linalg.norm(flight.drone.model.velocity) < 0.01)
    assert flight.drone.state == AIR
    wait_until(lambda: flight.drone.state == GROUND)


def test_an_order_is_finite():
    with pytest.raises(ValueError, match='finite numbers'):
        encode_order(1, OrderKind.GO, np.array([math.nan, 0.0, 0.0]))
