"""What goes wrong, and what the robot does about it."""

import math
import re
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from action_msgs.srv import CancelGoal
from geometry_msgs.msg import Twist
from numpy.testing import assert_array_equal
from robot_team import LATEST, NANOSECONDS, STEP, TURTLEBOT, image_message, numbers, stamped
from sensor_msgs.msg import BatteryState

from maasi_drivers.agent.agent_driver import STOPPED
from maasi_drivers.agent.watchdog import PERIOD as WATCH_PERIOD
from maasi_drivers.guard_node import _STOP_PERIOD
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.conversions import stamp_to_ros
from maasi_filter.ros.node_settings import LIVELINESS_LEASE
from maasi_msgs.msg import AgentState
from maasi_planner.motion import RobotState


def gives_up(team, result, reason):
    """Check that the robot is stopped, and that the goal ends with the reason."""
    assert reason in team.aborted(result)
    assert team.state.goal_status == AgentState.UNAVAILABLE
    assert reason in team.state.reason
    assert_array_equal(team.command, np.zeros(4))
    assert reason in team.refused([1.0, 1.0, 0.0])


def is_stopped(team):
    known = len(team.commands)
    team.until(lambda: len(team.commands) >= known + 3, 'no zeros')
    assert not np.any([numbers(item) for item in team.commands[known:]])


def steps_until_stopped(team, move=None):
    """Go on until the robot cannot; return for how long [s]."""
    begin = team.step
    team.until(lambda: (move or team.move)() or team.state.goal_status == AgentState.UNAVAILABLE)
    return (team.step - begin) * STEP


def test_what_is_waited_for_is_short_enough():
    settings = DriverSettings.model_validate({'environment': TURTLEBOT['environment']})
    # A stalled driver looks once more before it believes that the odometry is gone.
    assert settings.odometry_timeout + 3.0 * WATCH_PERIOD <= LATEST
    assert LIVELINESS_LEASE + _STOP_PERIOD <= LATEST
    assert settings.frozen_pose_timeout + 2.0 * STEP <= LATEST
    assert settings.sensor_patience + 2.0 * STEP <= LATEST


@pytest.mark.parametrize('fault', ['silent', 'repeats itself', 'not finite'])
def test_without_odometry_the_robot_is_stopped(play, fault):
    driver, team = play(odometry_timeout=0.5)
    team.move()
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    team.move(20)
    assert np.any(team.command != 0.0)

    def stopped():
        team.step += fault == 'not finite'
        message = team.odometry_message()
        if fault == 'not finite':
            message.pose.pose.position.y = math.nan
        if fault != 'silent':
            team.odometry.publish(message)
        return team.state.goal_status == AgentState.UNAVAILABLE

    team.until(stopped)
    first = next(item for item in team.states if item.goal_status == AgentState.UNAVAILABLE)
    assert 0.5 <= float(re.fullmatch('no odometry for (.*) s', first.reason)[1]) < 2.0
    assert (driver.dropped['odometry'] > 3) == (fault == 'not finite')
    assert 'no odometry for' in team.aborted(result)
    known = len(team.states)
    is_stopped(team)
    team.until(lambda: len(team.states) > known)
    assert team.refused([1.0, 1.0, 0.0])
    team.until(lambda: team.state.goal_status == AgentState.UNAVAILABLE)
    team.say()
    team.until(lambda: team.state.step == team.step)
    assert team.state.goal_status == AgentState.ABORTED
    assert team.accepts([1.0, 1.0, 0.0])


def hanging(team):
    """Return what publishes the present odometry with the stamp of the next step."""
    message = team.odometry_message()

    def hang():
        team.step += 1
        team.odometry.publish(stamped(message, team.step * NANOSECONDS))
        team.until(lambda: team.state.step == team.step)

    return hang


def test_a_pose_that_hangs_does_not_steer_a_robot_back_to_where_it_hovers(play):
    _, team = play('mambo')
    team.move()
    goal = team.start.position + np.array([0.1, 0.0, 0.0])
    team.ended(team.send_accepted(goal)[1], team.move)
    # A gust.
    team.body.step([0.4, 0.0, 0.0, 0.0], 1.0)
    hang = hanging(team)
    assert steps_until_stopped(team, hang) <= LATEST
    hang()
    assert_array_equal(team.command, np.zeros(4))


@pytest.mark.parametrize('kind', ['turtlebot', 'mambo'])
def test_a_pose_that_hangs_under_a_command_to_move_stops_the_robot(play, kind):
    _, team = play(kind)
    # One that stands may have the same pose for long.
    team.move(40)
    assert team.state.goal_status == AgentState.IDLE
    _, result = team.send_accepted(team.start.position + np.array([0.8, 0.5, 0.0]))
    team.move(20)
    assert steps_until_stopped(team, hanging(team)) <= LATEST
    team.until(lambda: not np.any(team.command))
    gives_up(team, result, 'the pose has not changed for')
    # It is pushed, and says so: it can be trusted.
    team.body.step([0.2, 0.0, 0.0, 0.3], 0.5)
    team.move()
    assert team.state.goal_status == AgentState.ABORTED
    assert team.accepts([1.0, 1.0, 1.0 if kind == 'mambo' else 0.0])


@pytest.mark.parametrize('fault', ['silent', 'repeats itself'])
def test_a_camera_that_hangs_stops_the_robot(play, fault):
    _, team = play(sensor_timeout=None)
    # One that was never there.
    assert steps_until_stopped(team) <= LATEST
    assert 'no new image' in team.state.reason
    generator, image = np.random.default_rng(1), None

    def move(new=True):
        nonlocal image
        team.move()
        if new:
            image = generator.integers(100, 140, (120, 160, 3)).astype(np.uint8)
        if new or fault == 'repeats itself':
            team.images.publish(image_message(image, team.step * NANOSECONDS))

    team.until(lambda: move() or team.state.goal_status != AgentState.UNAVAILABLE)
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    for _ in range(30):
        move()
    assert team.state.goal_status == AgentState.MOVING
    assert steps_until_stopped(team, lambda: move(new=False)) <= LATEST
    gives_up(team, result, 'no new image for')
    for _ in range(30):
        move(new=False)
    assert team.state.goal_status == AgentState.UNAVAILABLE
    for _ in range(3):
        move()
    team.until(lambda: move() or team.state.goal_status == AgentState.ABORTED)
    assert team.accepts([1.0, 1.0, 0.0])


def test_a_guard_that_has_gone_is_reported(play, start_guard, capfd):
    driver, team = play()
    guard = start_guard()
    team.until(lambda: team.move() or driver.link.status() == {'guard': 'available'})
    assert 'guard' not in driver._logged
    guard.destroy_node()
    team.until(lambda: team.move() or 'guard' in driver._logged)
    assert 'guard lost' in capfd.readouterr().err


@pytest.mark.parametrize('unit', ['percent', 'fraction'])
def test_a_battery_is_read_in_its_unit_and_a_low_one_ends_the_way(play, capfd, monkeypatch, unit):
    # The warning that no charge arrives would delay those about wrong values.
    if unit == 'percent':
        monkeypatch.setattr('maasi_drivers.agent.watchdog._CHARGE_PATIENCE', 0.3)
    driver, team = play(battery_minimum=0.2, battery_unit=unit)
    team.until(lambda: team.move() or 'battery' in driver._logged or unit == 'fraction')
    full = 100.0 if unit == 'percent' else 1.0

    def read(percentage, expected):
        team.battery.publish(BatteryState(percentage=percentage))
        team.until(lambda: team.move() or team.state.battery == pytest.approx(expected))

    read(1.167 * full, 1.0)
    if unit == 'fraction':
        read(55.0, -1.0)
        wrong = 'percentage: read 55, allowed is 0 to 1, or nan: battery_unit is fraction'
        assert wrong in capfd.readouterr().err
    read(0.8 * full, 0.8)
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    read(0.15 * full, 0.15)
    gives_up(team, result, 'battery at 15 %')
    # An unknown charge does not end what a low one began.
    read(math.nan, -1.0)
    assert 'battery at 15 %' in team.state.reason
    read(0.9 * full, 0.9)
    assert team.accepts([1.0, 1.0, 0.0])


@pytest.mark.parametrize('lockstep', [False, True])
def test_a_battery_that_falls_silent_is_unknown_after_a_while(play, capfd, lockstep):
    _, team = play(lockstep=lockstep, battery_timeout=1.0)
    team.move()
    message = BatteryState(percentage=0.53)
    team.battery.publish(stamped(message, team.step * NANOSECONDS))
    team.until(lambda: team.move() or team.state.battery == pytest.approx(0.53))
    begin = team.step
    team.until(lambda: team.move() or team.state.battery == -1.0)
    assert (team.step - begin) * STEP == pytest.approx(1.0, abs=0.5)
    said = capfd.readouterr().err
    assert said.count('no battery charge for 1 s') == 1
    assert '(last 53 %)' in said
    # It is no fault, and it comes back.
    assert team.state.goal_status == AgentState.IDLE
    team.battery.publish(stamped(BatteryState(percentage=0.5), team.step * NANOSECONDS))
    team.until(lambda: team.move() or team.state.battery == pytest.approx(0.5))


def test_every_battery_has_a_floor(play):
    """By default, too; below it the robot stops and says so, and goes on once it is charged."""
    _, team = play()
    team.move()
    team.battery.publish(BatteryState(percentage=0.06))
    team.until(lambda: team.move() or team.state.battery == pytest.approx(0.06))
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    team.move(5)
    team.battery.publish(BatteryState(percentage=0.04))
    team.until(lambda: team.move() or team.state.battery == pytest.approx(0.04))
    gives_up(team, result, 'battery at 4 %, below 5 %')
    team.battery.publish(BatteryState(percentage=0.3))
    team.until(lambda: team.move() or team.state.battery == pytest.approx(0.3))
    assert team.accepts([1.0, 1.0, 0.0])


@pytest.mark.parametrize('kind', ['turtlebot', 'mambo'])
def test_a_robot_outside_of_its_bounds_is_stopped(play, kind):
    """Bounds are an area; noise at their side is no fault, as goals may lie there."""
    driver, team = play(kind, environment={'bounds': [[-0.3, 2.4], [-0.3, 2.4]]})
    team.move()
    generator, height = np.random.default_rng(1), team.position[2]

    def put(x, y):
        team.body = team.motion.body(RobotState.at_rest([x, y, height]))
        team.move()

    for _ in range(20):
        # Beyond the side by its radius, with an odometry that is off by some centimetres.
        dx, dy = generator.normal(0.0, 0.05, 2).tolist()
        put(2.51 + dx, 1.0 + dy)
        assert 'area' not in driver.health
    _, result = team.send_accepted([1.0, 1.0, height])
    team.move(5)
    put(3.4, 1.0)
    assert '1 m outside of the area' in team.aborted(result)
    assert team.state.goal_status == AgentState.UNAVAILABLE
    put(2.3, 1.0)
    assert team.accepts([1.0, 1.0, height])


def test_a_flying_robot_in_the_plane_is_not_sent_to_another_height(play):
    _, team = play('mambo')
    team.move()
    for height in (-0.1, 50.0):
        assert 'waypoint.pose.position.z' in team.refused([1.2, 1.2, height])
    team.move(20)
    assert team.position[2] == pytest.approx(1.0, abs=0.01)
    # Its own height is that of the waypoints, and it may change it a little.
    assert team.accepts([1.2, 1.2, 1.3])


@pytest.mark.parametrize('options', [{'wants': Twist}, {'command_type': 'twist'}])
def test_the_type_of_the_commands_is_found_out_or_given(play, options):
    # Humble's TurtleBot3 listens to Twist, Jazzy's to TwistStamped.
    _, team = play(**options)
    team.move()
    team.send_accepted([1.0, 1.0, 0.0])
    team.move(3)
    assert np.any(team.command != 0.0)


def test_it_is_said_that_nobody_listens(make_team, process, capfd):
    # A separate process: one process cannot have two types under one name.
    driver = process(command_type='stamped')
    team = make_team(TURTLEBOT, wants=Twist, deaf=True)
    wanted = 'the robot subscribes to geometry_msgs/msg/Twist'
    team.until(lambda: team.say() or wanted in capfd.readouterr().err)
    assert driver.poll() is None


def test_a_robot_that_starts_late_is_no_warning_and_one_that_does_not_start_is(process, capfd):
    began, warning = time.monotonic(), ''
    process()
    while 'no subscription' not in warning:
        assert time.monotonic() - began < 60.0
        time.sleep(0.1)
        warning += capfd.readouterr().err
    assert time.monotonic() - began > 10.0
    assert '/cmd_vel: no subscription for 1' in warning


@pytest.mark.parametrize('kind', ['turtlebot', 'mambo'])
def test_a_stopped_robot_stands_and_refuses_goals_until_it_is_released(play, kind):
    driver, team = play(kind)
    team.move()
    goal = team.start.position + np.array([0.8, 0.5, 0.0])
    _, result = team.send_accepted(goal)
    team.move(20)
    assert np.any(team.command[:3] != 0.0)
    known = len(team.commands)
    assert team.call('stop').success
    assert team.aborted(result) == STOPPED
    # At once, not with the next odometry.
    team.until(lambda: len(team.commands) > known)
    assert_array_equal(team.command, np.zeros(4))
    before = team.position
    team.move(40)
    assert team.state.goal_status == AgentState.UNAVAILABLE and team.state.reason == STOPPED
    # A flying robot brakes, and is kept where it was told to stop.
    assert np.linalg.norm(team.position - before) < 0.15
    assert STOPPED in team.refused(goal)
    # Nobody releases it by restarting the node's life cycle.
    for transition in ('deactivate', 'cleanup', 'configure', 'activate'):
        assert getattr(driver, f'trigger_{transition}')().name == 'SUCCESS'
    team.connect()
    team.awaken()
    assert STOPPED in team.refused(goal)
    assert team.call('release').success
    team.until(lambda: team.move() or team.state.goal_status != AgentState.UNAVAILABLE)
    assert team.accepts(goal)


# ---- the driver's process, and the guard of its robot ----------------------------------------


def drive_without_the_guard(team):
    """Drive until the guard is silent: on a busy machine it may miss the driver for a while."""
    # The guard's commands have no frame.
    team.until(
        lambda: (
            team.commands.clear()
            or team.move(20)
            or all(message.header.frame_id for message in team.commands)
        )
    )


def test_the_guard_stops_the_robot_of_a_driver_that_hangs_or_is_killed(start_guard, process, team):
    guard = start_guard()
    # Nobody relies on a guard before it has received from its driver.
    end = time.monotonic() + 1.0
    team.until(lambda: time.monotonic() > end and team.count_publishers('/lockstep/ready'))
    assert not team.ready
    driver = process(program=[sys.executable, str(Path(__file__).with_name('hanging_driver.py'))])
    team.connect()
    team.awaken()
    team.until(lambda: '/rover/guard' in [message.node for message in team.ready])
    # A driver stops the robot itself where odometry is missing: to its guard it is alive, for
    # longer than the lease and without any state.
    received = [time.monotonic()]

    def stays_alive():
        # On a busy machine a sign of life may be late.
        if guard.status()['stopping']:
            received[0] = time.monotonic()
        return time.monotonic() > received[0] + 1.5 * LIVELINESS_LEASE

    team.until(stays_alive, 'its guard does not receive from the driver')
    team.send_accepted([1.5, 1.5, 0.0])
    drive_without_the_guard(team)
    assert np.any(team.command != 0.0)
    driver.send_signal(signal.SIGUSR1)
    # Commands of the driver may still be on their way until then.
    team.until(lambda: guard.status()['stopping'], 'the guard does not notice')
    is_stopped(team)
    assert team.commands[-1].header.stamp == stamp_to_ros(team.step * NANOSECONDS)
    assert driver.poll() is None
    # Nav2 is told as well, also one that is found only now.
    asked = []
    name = 'navigate_to_pose/_action/cancel_goal'
    team.create_service(CancelGoal, name, lambda request, answer: asked.append(request) or answer)
    team.until(lambda: asked, 'the goals of Nav2 are not cancelled')
    assert asked[0] == CancelGoal.Request()
    driver.kill()
    driver.wait()
    driver = process()
    team.until(lambda: not guard.status()['stopping'])
    team.connect()
    team.states.clear()
    team.awaken()
    drive_without_the_guard(team)
    # A guard that is activated after the death of its driver stops the robot, too.
    assert guard.trigger_deactivate().name == 'SUCCESS'
    driver.kill()
    driver.wait()
    team.until(lambda: guard.status()['driver lost'])
    assert not guard.active and not guard.status()['stopping']
    assert guard.trigger_activate().name == 'SUCCESS'
    assert guard.status()['stopping']
    is_stopped(team)


def test_a_guard_that_ends_with_its_driver_gives_zeros_and_no_warning(
    start_guard, process, team, capfd
):
    guard, driver = start_guard(), process()
    team.connect()
    team.awaken()
    team.until(lambda: guard._received)
    guard.ending = True  # as by the signal that both receive
    driver.send_signal(signal.SIGINT)
    team.until(lambda: guard.status()['stopping'])
    is_stopped(team)
    said = [line for line in capfd.readouterr().err.splitlines() if '[rover.guard]' in line]
    assert 'driver ended' in said[-1] and not any('WARN' in line for line in said)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_driver_that_is_told_to_end_leaves_zeros(process, team, number):
    driver = process()
    team.connect()
    team.awaken()
    _, result = team.send_accepted([1.5, 1.5, 0.0])
    team.move(20)
    assert np.any(team.command != 0.0)
    driver.send_signal(number)
    team.until(lambda: driver.poll() is not None)
    assert driver.returncode == 0
    assert team.aborted(result) == 'the driver stops'
    team.until(lambda: not np.any(team.command))
