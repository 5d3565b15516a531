"""Nothing moves before `start`; the services of a search, and the command-line tools."""

import signal
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from driven_team import SETTINGS, START, driven
from rclpy.action import ActionServer
from rclpy.node import Node
from sensor_msgs.msg import BatteryState
from waiting import PATIENCE, wait_until

from maasi_drivers.agent.agent_driver import STOPPED
from maasi_drivers.team_command import (
    ABSENT,
    DONE,
    FAILED,
    INTERRUPTED,
    build_parser,
    main,
    wanted,
)
from maasi_filter.ros.qos import SENSOR
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import AgentState
from maasi_msgs.srv import SetKeepOuts
from maasi_planner.endurance import EnduranceSettings
from maasi_planner.node_settings import PlannerNodeSettings


@pytest.fixture
def world():
    """Return a world whose planner has not been given any command."""
    with driven(search_on_start=False) as made:
        yield made


def test_nothing_moves_without_start_and_each_service_does_what_it_says(world):
    a, b = world.robots.values()
    assert PlannerNodeSettings.model_fields['search_on_start'].default is False
    places = [a.place, b.place]

    def refused(service, message):
        answer = world.call(service)
        assert not answer.success and answer.message == message

    def stay():
        """Let both robots stay where they are, with no decision."""
        places, decisions = [a.place, b.place], len(world.decisions)
        world.pass_steps(40)
        assert [a.place, b.place] == places and len(world.decisions) == decisions

    stay()
    assert [a.place, b.place] == places and world.decisions == []
    assert {state.goal_id for item in (a, b) for state in item.states} == {0}
    world.until(lambda: world.status.get('search') == 'waiting for start')
    for word in ('pause', 'resume'):
        refused(f'search/{word}', f'a, b: waiting for start; {word} changes nothing')

    answer = world.call('a/search/start')
    assert answer.success and answer.message == 'start: a'
    world.until(lambda: a.moves)
    world.pass_steps(20)
    assert b.place == places[1] and b.state.goal_id == 0
    world.until(lambda: world.status.get('search') == 'a searching, b waiting for start')
    refused('b/search/resume', 'b: waiting for start; resume changes nothing')
    assert world.call('search/start').success
    world.until(world.moving)

    assert world.call('search/pause').message == 'pause: a, b'
    world.until(world.standing)
    stay()
    world.until(lambda: world.status.get('search') == 'paused')
    before = a.place
    assert world.call('b/search/resume').success
    world.until(lambda: b.moves)
    world.pass_steps(10)
    assert a.place == before
    assert world.call('search/resume').success
    world.until(world.moving)

    assert world.call('search/home').success
    world.until(
        lambda: all(
            item.is_near(*item.start.position[:2], 0.2)
            and item.state.goal_status == AgentState.REACHED
            for item in (a, b)
        ),
        'not at home',
    )
    world.until(world.standing)
    stay()
    world.until(lambda: world.status.get('search') == 'sent home')
    assert world.call('search/resume').success
    world.until(world.moving)

    assert world.call('a/search/stop').message == 'stop: a'
    world.until(lambda: a.stands and not a.moves)
    refused('a/search/resume', 'a: stopped; resume changes nothing')
    assert world.call('search/stop').success
    world.until(world.standing)
    assert not world.call('search/resume').success
    assert world.call('search/start').success
    world.until(world.moving)

    # A planner that is not active refuses, and its robots stand.
    assert world.planner.trigger_deactivate().name == 'SUCCESS'
    world.until(world.standing)
    refused('search/start', 'the planner is not active')


def came_home(world, a):
    world.until(
        lambda: (
            a.is_near(*START['a'], 0.2) and a.stands and a.state.goal_status == AgentState.REACHED
        ),
        lambda: f'not at home: {a.place}, {a.state.goal_id}, {a.state.goal_status}',
    )


def nothing(world, a, reason):
    pass


def paused(world, a, reason):
    assert world.call('search/pause').success


def fault(world, a, reason):
    """Have its driver say that it cannot go."""
    health = world.drivers[0].health
    health.begin('fault', reason)
    world.until(lambda: a.states and a.state.reason == reason)
    return lambda: health.end('fault')


def at_a_goal(world, a, reason):
    _, result = world.send('a', (1.0, 1.0), 900)
    world.until(result.done)


def stopped(world, a, reason):
    assert world.call('a/stop').success
    world.until(lambda: a.state.reason == reason)
    return lambda: world.call('a/release')


def charging(world, a, reason):
    publisher = world.node.create_publisher(BatteryState, 'a/battery_state', SENSOR)

    def has(charge):
        publisher.publish(BatteryState(percentage=charge))
        return world.coordinator.robots['a'].endurance.charging

    world.coordinator = world.planner.coordinator
    world.until(lambda: has(0.05))
    world.until(lambda: has(0.05) and a.stands and a.is_near(1.8, 0.2, 0.1))
    # Its start is too far for what it has.
    return lambda: world.until(lambda: not has(1.0) or a.moves)


@pytest.mark.parametrize(
    ('state', 'searching', 'reason'),
    [
        (nothing, False, ''),
        (nothing, True, ''),
        (at_a_goal, True, ''),
        (paused, True, ''),
        (charging, True, ''),
        (stopped, True, STOPPED),
        (fault, False, 'vehicle: not armed: until the service arm is called'),
        (fault, True, '3 m outside of the area'),
        (fault, True, 'link: no message from system 1'),
    ],
)
def test_from_every_state_it_comes_home_at_once_or_when_it_can(state, searching, reason):
    """What it cannot do is said in the answer, and done later, without another command."""
    robots = dict(SETTINGS.robots)
    endurance = EnduranceSettings(per_metre=0.05, chargers=[[1.8, 0.2, 0.0]])
    robots['a'] = robots['a'].model_copy(update={'endurance': endurance})
    with driven(search_on_start=searching, robots=robots) as world:
        a = world.robots['a']
        if searching:
            world.until(world.moving)
        restore = state(world, a, reason)
        place = a.place
        answer = world.call('a/search/home')
        unavailable = f'a is unavailable: {reason}' in answer.message
        assert answer.success and unavailable == bool(reason)
        if restore is not None:
            world.pass_steps(40)
            assert a.stands and np.hypot(*np.subtract(a.place, place)[:2]) < 0.2
            restore()
        came_home(world, a)
        goal = a.state.goal_id
        world.pass_steps(40)
        assert a.state.goal_id == goal and a.stands


def test_a_keep_out_on_the_way_home_leads_it_around_and_one_at_home_lets_it_wait():
    """Goals that are aborted or refused are sent again."""
    with driven() as world:
        a = world.robots['a']
        client = world.node.create_client(SetKeepOuts, 'search/keep_outs')
        world.listen(client.service_is_ready)

        def close(*zones):
            client.call_async(SetKeepOuts.Request(zones=zones))

        assert world.call('search/pause').success
        world.until(world.standing)
        _, result = world.send('a', (1.8, 0.5), 900)
        world.until(result.done)
        assert world.call('a/search/home').success
        world.until(lambda: a.moves and a.place[0] < 1.7)
        close('POLYGON ((1.0 0.3, 1.2 0.3, 1.2 0.8, 1.0 0.8, 1.0 0.3))')
        world.listen(lambda: world.logged('path blocked by a keep-out zone'))
        came_home(world, a)

        _, result = world.send('a', (1.8, 0.5), 901)
        world.until(result.done)
        close('{} {} 0.2'.format(*START['a'][:2]))
        assert world.call('a/search/home').success
        world.until(lambda: world.logged('allowed is what lies inside the area'))
        world.pass_steps(40)
        assert a.stands and a.is_near(1.8, 0.5, 0.2)
        close()
        came_home(world, a)


def test_commands_reach_planner_and_drivers(world):
    a, b = world.robots.values()
    search = partial(world.command, main)
    answer = '/search/pause: a, b: waiting for start; pause changes nothing\n'
    process = world.run('-m', 'maasi_drivers.team_command', 'pause')
    assert world.ended(process) == (FAILED, answer)
    assert search('start', 'a') == (DONE, '/a/search/start: start: a\n')
    world.until(lambda: a.moves)
    assert b.state.goal_id == 0
    assert world.call('search/start').success
    world.until(world.moving)
    code, text = search('stop', 'b')
    assert code == DONE and '/b/search/stop: stop: b' in text and '/b/stop: ' in text
    assert '/a' not in text
    world.until(lambda: b.stands and b.state.reason == STOPPED)
    assert a.state.reason != STOPPED
    # Without a planner the drivers are reached all the same.
    world.end_planner()
    code, text = search('stop', 'a', 'b')
    assert code == DONE and '/a/stop: ' in text and '/b/stop: ' in text
    world.until(lambda: a.stands and a.state.reason == STOPPED)
    code, text = search('pause', '--timeout', '2')
    assert code == ABSENT and text.startswith('no service for pause within 2 s')
    # One that is not there is named; the others follow.
    code, text = search('release', 'a', 'ghost', '--timeout', '8')
    assert code == ABSENT and '/a/release: ' in text
    assert 'no service for release of ghost within 8 s' in text
    assert search('release')[0] == DONE
    for item in (a, b):
        world.until(lambda item=item: item.state.goal_status != AgentState.UNAVAILABLE)


TRIGGER = ['std_srvs/srv/Trigger']
SERVICES = {
    name: TRIGGER
    for top in ('', '/north')
    for name in (
        f'{top}/search/stop',
        *(f'{top}/{robot}/search/stop' for robot in ('a', 'b')),
        *(f'{top}/{robot}/{word}' for robot in ('a', 'b') for word in ('stop', 'release')),
    )
}
# Neither another type nor a stop without a release is a robot's.
SERVICES |= {'/c/stop': TRIGGER, '/d/search/stop': ['std_srvs/srv/Empty']}
SERVICES |= {'/a/arm': TRIGGER, '/c/arm': TRIGGER}
SERVICES |= {'/a/search/pause': TRIGGER, '/b/search/pause': TRIGGER}  # a planner for each robot


@pytest.mark.parametrize(
    ('words', 'called'),
    [
        ('stop', {'/search/stop', '/a/stop', '/b/stop'}),
        ('stop a', {'/a/search/stop', '/a/stop'}),
        ('stop a b', {f'/{name}{word}/stop' for name in 'ab' for word in ('', '/search')}),
        ('release --namespace north', {'/north/a/release', '/north/b/release'}),
        ('stop b --namespace /north/', {'/north/b/search/stop', '/north/b/stop'}),
        ('stop --namespace south', set()),
        ('pause --namespace north', set()),
        # Of those that fly.
        ('arm', {'/a/arm'}),
        ('arm b', set()),
        ('pause', {'/a/search/pause', '/b/search/pause'}),
    ],
)
def test_services_that_a_command_calls(words, called):
    assert wanted(SERVICES, build_parser().parse_args(words.split())) == called


def test_a_robot_is_shown_sent_and_stopped(world):
    a, robot = world.robots['a'], partial(world.command, main)
    code, said = robot('state', 'a')
    assert code == DONE, said
    assert said.startswith('a: no goal; at (') and 'in map, battery' in said

    x, y = a.place[0] + 0.1, a.place[1]
    code, said = robot('go', 'a', f'{x}', f'{y}')
    assert code == DONE and said.startswith('reached; position ('), said
    assert abs(a.place[0] - x) < 0.05

    code, said = robot('go', 'a', '100', '0')
    assert code == FAILED and ('refused' in said or 'not reached' in said), said

    process = world.run('-m', 'maasi_drivers.team_command', 'go', 'a', f'{x - 0.6}', f'{y}')
    world.until(lambda: a.moves, 'it does not move')
    process.send_signal(signal.SIGINT)
    code, said = world.ended(process)
    assert code == FAILED and 'not reached: cancelled' in said, said
    world.until(lambda: not a.moves, 'it still moves')

    goals = []  # one that flies keeps its height unless another is given

    def take(handle):
        goals.append(handle.request.waypoint.pose.position)
        handle.succeed()
        return GoToWaypoint.Result(reached=True)

    server = ActionServer(world.node, GoToWaypoint, '/drone/go_to', take)
    publisher = world.node.create_publisher(AgentState, '/drone/state', SENSOR)
    state = AgentState(robot='drone')
    state.pose.pose.position.z = 5.0
    timer = world.node.create_timer(0.05, lambda: publisher.publish(state))
    for words in (['1', '2'], ['1', '2', '3']):
        code, said = robot('go', 'drone', *words)
        assert code == DONE, said
    assert [(goal.x, goal.y, goal.z) for goal in goals] == [(1.0, 2.0, 5.0), (1.0, 2.0, 3.0)]
    for entity in (timer, publisher, server):
        entity.destroy()


@pytest.mark.parametrize('words', ['go nobody 1 2', 'start'])
def test_a_command_that_waits_for_a_node_ends_at_once(context, words):
    node = Node('observer', context=context)
    # As the console script runs it, which has no own handler for SIGINT.
    code = 'import sys, maasi_drivers_entry as entry; sys.exit(entry.team_command())'
    command = [sys.executable, '-c', code, *words.split(), '--timeout', '1000']
    with subprocess.Popen(command, stdout=-1, stderr=-1, text=True) as process:
        # A node of it is in the graph: it waits.
        wait_until(lambda: 'team_command' in node.get_node_names(), what='it does not start')
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=PATIENCE)
    assert (process.returncode, *said) == (INTERRUPTED, '', '')
    node.destroy_node()


@pytest.mark.parametrize(
    'words', ['', 'a', 'state', 'go a', 'go a 1 nan', 'fly a', 'start --robot a']
)
def test_wrong_arguments_end_with_2(words):
    with pytest.raises(SystemExit, match='2'):
        build_parser().parse_args(words.split())
