"""Nothing moves before `start`; the services of a search, and the command-line tool."""

import subprocess
import sys

import pytest
from driven_team import driven

from maasi_drivers.agent.agent_driver import STOPPED
from maasi_msgs.msg import AgentState
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.search_command import wanted


@pytest.fixture
def waiting():
    """Return a world whose planner has not been given any command."""
    with driven(search_on_start=False) as world:
        yield world


def command(world, *words):
    """Run search_command in a process of its own; return exit code and output."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'maasi_planner.search_command', *words],
        env={**world.environment, 'ROS_DOMAIN_ID': str(world.domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        world.until(lambda: process.poll() is not None, 'the command does not end')
        return process.returncode, process.stdout.read()
    finally:
        process.kill()
        process.communicate()


def test_nothing_moves_without_start_and_each_service_does_what_it_says(waiting):
    world = waiting
    a, b = world.robots.values()
    assert PlannerNodeSettings.model_fields['search_on_start'].default is False
    places = [a.place, b.place]
    world.pass_steps(40)
    assert [a.place, b.place] == places
    assert {state.goal_id for robot in (a, b) for state in robot.states} == {0}
    assert world.decisions == []
    world.until(lambda: world.status.get('search') == 'waiting for start')
    for word in ('pause', 'resume'):
        answer = world.call(f'search/{word}')
        assert not answer.success
        assert answer.message == f'a, b: waiting for start; {word} changes nothing'

    answer = world.call('a/search/start')
    assert answer.success and answer.message == 'start: a'
    world.until(lambda: a.moves)
    world.pass_steps(20)
    assert b.place == places[1] and b.state.goal_id == 0
    world.until(lambda: world.status.get('search') == 'a searching, b waiting for start')
    answer = world.call('b/search/resume')
    assert not answer.success
    assert answer.message == 'b: waiting for start; resume changes nothing'
    assert world.call('search/start').success
    world.until(world.moving)

    assert world.call('search/pause').message == 'pause: a, b'
    world.until(world.standing)
    places, decisions = [a.place, b.place], len(world.decisions)
    world.pass_steps(40)
    assert [a.place, b.place] == places and len(world.decisions) == decisions
    world.until(lambda: world.status.get('search') == 'paused')
    assert world.call('b/search/resume').success
    world.until(lambda: b.moves)
    world.pass_steps(10)
    assert a.place == places[0]
    assert world.call('search/resume').success
    world.until(world.moving)

    assert world.call('search/home').success
    world.until(
        lambda: all(
            max(
                abs(robot.place[0] - robot.start.position[0]),
                abs(robot.place[1] - robot.start.position[1]),
            )
            < 0.15
            and robot.state.goal_status == AgentState.REACHED
            for robot in (a, b)
        ),
        'not at home',
    )
    decisions = len(world.decisions)
    world.pass_steps(40)
    assert world.standing() and len(world.decisions) == decisions
    world.until(lambda: world.status.get('search') == 'sent home')
    assert world.call('search/resume').success
    world.until(world.moving)

    assert world.call('a/search/stop').message == 'stop: a'
    world.until(lambda: a.stands and not a.moves)
    answer = world.call('a/search/resume')
    assert answer.message == 'a: stopped; resume changes nothing'
    assert world.call('search/stop').success
    world.until(world.standing)
    assert not world.call('search/resume').success
    assert world.call('search/start').success
    world.until(world.moving)

    # A planner that is not active refuses, and its robots stand.
    assert world.planner.trigger_deactivate().name == 'SUCCESS'
    world.until(world.standing)
    answer = world.call('search/start')
    assert not answer.success and answer.message == 'the planner is not active'


def test_the_command_line_reaches_planner_and_drivers(waiting):
    world = waiting
    a, b = world.robots.values()
    code, text = command(world, 'pause')
    assert (code, text) == (1, '/search/pause: a, b: waiting for start; pause changes nothing\n')
    code, text = command(world, 'start', '--robot', 'a')
    assert (code, text) == (0, '/a/search/start: start: a\n')
    world.until(lambda: a.moves)
    assert b.state.goal_id == 0
    assert world.call('search/start').success
    world.until(world.moving)
    code, text = command(world, 'stop', '--robot', 'b')
    assert code == 0 and '/b/search/stop: stop: b' in text and '/b/stop: ' in text
    assert '/a' not in text
    world.until(lambda: b.stands and b.state.reason == STOPPED)
    assert a.state.reason != STOPPED
    # Without a planner the drivers are reached all the same.
    world.end_planner()
    code, text = command(world, 'stop')
    assert code == 0 and '/a/stop: ' in text and '/b/stop: ' in text
    world.until(lambda: a.stands and a.state.reason == STOPPED)
    code, text = command(world, 'pause', '--timeout', '2')
    assert code == 2 and text.startswith('no service for pause within 2 s')
    assert command(world, 'release')[0] == 0
    for robot in (a, b):
        world.until(lambda robot=robot: robot.state.goal_status != AgentState.UNAVAILABLE)


def test_the_command_line_calls_what_was_asked_for():
    trigger = ['std_srvs/srv/Trigger']
    services = {
        name: trigger
        for top in ('', '/north')
        for name in (
            f'{top}/search/stop',
            *(f'{top}/{robot}/search/stop' for robot in ('a', 'b')),
            *(f'{top}/{robot}/{word}' for robot in ('a', 'b') for word in ('stop', 'release')),
        )
    }
    # Neither another type nor a stop without a release is a robot's.
    services |= {'/c/stop': trigger, '/d/search/stop': ['std_srvs/srv/Empty']}
    assert wanted(services, 'stop', '', '') == {'/search/stop', '/a/stop', '/b/stop'}
    assert wanted(services, 'stop', 'a', '') == {'/a/search/stop', '/a/stop'}
    assert wanted(services, 'release', '', 'north') == {'/north/a/release', '/north/b/release'}
    assert wanted(services, 'stop', 'b', '/north/') == {'/north/b/search/stop', '/north/b/stop'}
    assert wanted(services, 'stop', '', 'south') == set()
    assert wanted(services, 'pause', '', '') == set()
    # Of those that fly.
    services |= {'/a/arm': trigger, '/c/arm': trigger}
    assert wanted(services, 'arm', '', '') == {'/a/arm'}
    assert wanted(services, 'arm', 'b', '') == set()
    # A planner for each robot.
    each = {f'/{robot}/search/pause': trigger for robot in ('a', 'b')}
    assert wanted(each, 'pause', '', '') == set(each)
