"""Drones that crazyswarm2 and Aerostack2 fly: see `play_platform.py` for what plays them."""

import signal
import sys

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from interfaces import played, with_interfaces
from play_platform import NAME
from rclpy.qos import qos_profile_sensor_data
from robot_team import RANGING, parameters_of

from maasi_drivers.agent.flight_rules import UNTIL_ARM
from maasi_drivers.drivers import CameraDriver, RangingDriver
from maasi_filter.ros.conversions import point_from_ros
from maasi_msgs.msg import AgentState

PACKAGES = {'crazyswarm2': 'crazyflie_interfaces', 'aerostack2': 'as2_msgs'}
LANDED = {'crazyswarm2': 'landed', 'aerostack2': 'Land done'}
POSES = {'crazyswarm2': 'pose', 'aerostack2': 'self_localization/pose'}
SPEED, LEAD = 1.0, 0.6
ZONE = np.array([1.0, -1.0, 0.7])  # x, y, radius
FLYING = RANGING | {
    'environment': {
        'bounds': [[-8.0, 8.0], [-8.0, 8.0], [-5.0, 5.0]],
        'keep_outs': ['1 -1 0.7'],
    },
    'start': [1.0, 1.2, 0.8],
    'radius': 0.1,
    # The machine may be busy.
    'odometry_timeout': 5.0,
    'motion': {'speed': SPEED, 'acceleration': 3.0, 'tolerance': 0.1},
    'platform': {'namespace': NAME, 'arm': True, 'lead': LEAD},
}


class Flight:
    """A drone that another system flies, with its driver and its team."""

    def __init__(self, system, played_system, process, environment, team):
        self.events, self.team, self.said = played_system[0], team, []
        self.process, self.environment = process, environment
        self.settings = FLYING | {'link': system}
        self.path = []
        team.create_subscription(
            PoseStamped,
            f'/{NAME}/{POSES[system]}',
            lambda message: self.path.append(point_from_ros(message.pose.position)),
            qos_profile_sensor_data,
        )
        self.begin()

    def begin(self):
        self.driver = self.process(self.environment, ('ranging_driver',), self.settings)
        self.team.states.clear()
        self.team.connect()
        self.until_said(UNTIL_ARM)

    def until_said(self, reason):
        self.team.until(
            lambda: self.team.states and reason in self.team.state.reason,
            lambda: self.team.states and self.team.state.reason,
        )

    def await_landing(self):
        event = LANDED[self.settings['link']]
        self.team.until(lambda: self.read(event), lambda: f'no {event}: {self.said}')
        landed = next(item for item in self.said if item['event'] == event)
        assert landed['position'][2] < 0.05
        return landed

    def read(self, event):
        while not self.events.empty():
            self.said.append(self.events.get())
        return any(item['event'] == event for item in self.said)

    def up(self):
        self.team.until(lambda: self.team.call('arm').success)
        self.team.until(lambda: self.team.state.goal_status == AgentState.IDLE)
        return self

    def settle(self):
        """Wait until it does not move; return its position."""

        def still():
            return len(self.path) > 20 and np.ptp(self.path[-10:], axis=0).max() < 0.002

        self.team.until(still, 'it moves on')
        return self.path[-1]


@pytest.fixture
def refused_landings():
    return 0


@pytest.fixture(params=PACKAGES)
def flight(request, context, process, make_team, refused_landings):
    environment = with_interfaces(PACKAGES[request.param], request.config.cache)
    words = 'play_platform.py', request.param, str(refused_landings)
    with played(environment, *words) as made:
        settings = FLYING | {'link': request.param}
        team = make_team(settings, deaf=True)
        team.used = [team.batches, team.ranges]
        yield Flight(request.param, made, process, environment, team)


def test_it_takes_off_when_told_flies_around_zones_and_lands_at_the_end(flight):
    team, crazyflie = flight.team, flight.settings['link'] == 'crazyswarm2'
    assert 'flight' not in team.refused([1.0, 0.0, 1.0])  # the reason is the service
    assert team.state.goal_status == AgentState.UNAVAILABLE
    assert not flight.read('flying') and not flight.read('armed')
    flight.up()
    assert abs(flight.settle()[2] - 0.8) < 0.1
    flight.path.clear()
    _, result = team.send_accepted([1.0, -3.0, 1.0])
    team.until(result.done)
    assert result.result().result.reached, result.result().result.reason
    assert np.linalg.norm(flight.settle() - [1.0, -3.0, 1.0]) < 0.12
    # The straight path leads through the zone.
    path = np.array(flight.path)
    assert np.linalg.norm(path[:, :2] - ZONE[:2], axis=1).min() > ZONE[2]
    # Cancelled, it stops within the positions that it was sent to.
    before = len(flight.path)
    handle, result = team.send_accepted([5.0, -3.0, 1.0])
    team.until(lambda: flight.path[-1][0] > 2.0)
    team.until(handle.cancel_goal_async().done)
    there = flight.path[-1]
    assert np.linalg.norm(flight.settle() - there) < SPEED * (LEAD + 0.5)
    assert flight.path[-1][0] < 5.0 - 0.5 and len(flight.path) > before
    assert team.state.battery == pytest.approx(0.6 if crazyflie else 0.8, abs=0.01)
    flight.driver.send_signal(signal.SIGINT)
    landed = flight.await_landing()
    assert flight.driver.wait(10.0) == 0
    if crazyflie:
        # Polynomials from any state that a flight has, also of take-off and landing.
        assert landed['fastest'] <= 1.05 * SPEED
    assert not flight.read('flight from the ground')


def test_a_killed_driver_leaves_it_hovering_and_the_next_one_takes_control(flight):
    team = flight.up().team
    team.send_accepted([7.0, 1.2, 0.8])
    team.until(lambda: flight.path[-1][0] > 2.0)
    flight.driver.kill()
    flight.driver.wait()
    there, stopped = flight.path[-1], flight.settle()
    # A position that was sent before it is killed is at most `lead` ahead.
    assert np.linalg.norm(stopped - there) < SPEED * LEAD + 0.35
    flight.begin()
    team.until(lambda: len(team.states) > 5)
    assert np.linalg.norm(flight.settle() - stopped) < 0.05
    flight.up()
    assert np.linalg.norm(flight.settle() - stopped) < 0.05
    _, result = team.send_accepted([3.0, 1.2, 1.2])
    team.until(result.done)
    assert result.result().result.reached
    flight.driver.send_signal(signal.SIGINT)
    flight.await_landing()


def test_a_stop_ends_a_take_off(flight):
    team = flight.team
    team.until(lambda: team.call('arm').success)
    team.until(lambda: flight.path[-1][2] > 0.2)
    assert team.call('stop').success
    crazyflie = flight.settings['link'] == 'crazyswarm2'
    flight.await_landing()
    # Aerostack2 makes an emergency of a take-off that is cancelled.
    assert not flight.read('Takeoff cancelled')
    assert max(position[2] for position in flight.path) < (0.75 if crazyflie else 0.85)
    flight.until_said('take-off stopped')
    assert team.call('release').success
    flight.up()


@pytest.mark.parametrize('refused_landings', [1])
def test_a_landing_that_is_lost_or_refused_is_ordered_again(flight):
    team = flight.team
    team.until(lambda: team.call('arm').success)
    team.until(lambda: flight.path[-1][2] > 0.2)
    assert team.call('stop').success
    flight.await_landing()
    assert flight.read('landing refused')


@pytest.mark.parametrize('system', PACKAGES)
@pytest.mark.parametrize('driver', [RangingDriver, CameraDriver])
def test_what_is_missing_is_said(start_node, monkeypatch, system, driver):
    monkeypatch.setitem(sys.modules, PACKAGES[system], None)
    settings = FLYING | {'link': system}
    made = start_node(driver, parameter_overrides=parameters_of(settings))
    assert made.trigger_configure().name == 'FAILURE'
    assert f'the package {PACKAGES[system]} is not installed: it is a part of' in made.problem


@pytest.mark.parametrize('platform', [{'namespace': 'rover'}, None])
def test_a_namespace_of_its_own_is_needed(start_node, platform):
    settings = FLYING | {'link': 'crazyswarm2', 'platform': platform}
    made = start_node(RangingDriver, parameter_overrides=parameters_of(settings))
    assert made.trigger_configure().name == 'FAILURE'
    words = "read 'rover', the robot's own" if platform else 'is missing, link crazyswarm2'
    assert f'parameter platform.namespace: {words}' in made.problem
