"""The command-line tool that shows a robot and sends it to a waypoint."""

import signal
import subprocess
import sys

import pytest
from driven_team import driven
from rclpy.action import ActionServer

from maasi_drivers.robot_command import DONE, FAILED, INTERRUPTED, build_parser
from maasi_filter.ros.qos import SENSOR
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import AgentState


@pytest.fixture
def world():
    with driven(search_on_start=False) as made:
        yield made


def started(world, *words):
    return subprocess.Popen(
        [sys.executable, '-m', 'maasi_drivers.robot_command', *words],
        env={**world.environment, 'ROS_DOMAIN_ID': str(world.domain)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def ended(world, process):
    """Return exit code and output of a process, while the robots go on."""
    try:
        world.until(lambda: process.poll() is not None, 'the command does not end')
        return process.returncode, process.stdout.read()
    finally:
        process.kill()
        process.communicate()


def test_a_robot_is_shown_sent_and_stopped_again(world):
    a = world.robots['a']
    code, said = ended(world, started(world, 'a', 'state'))
    assert code == DONE, said
    assert said.startswith('a: no goal; at (') and 'in map, battery' in said

    x, y = a.place[0] + 0.1, a.place[1]
    code, said = ended(world, started(world, 'a', 'go', f'{x}', f'{y}'))
    assert code == DONE and said.startswith('reached; it stands at'), said
    assert abs(a.place[0] - x) < 0.05

    code, said = ended(world, started(world, 'a', 'go', '100', '0'))
    assert code == FAILED and ('refused' in said or 'not reached' in said), said

    process = started(world, 'a', 'go', f'{x - 0.6}', f'{y}')
    world.until(lambda: a.moves, 'it does not move')
    process.send_signal(signal.SIGINT)
    code, said = ended(world, process)
    assert code == FAILED and 'not reached: cancelled' in said, said
    world.until(lambda: not a.moves, 'it goes on')


@pytest.mark.parametrize(('words', 'height'), [(['1', '2'], 5.0), (['1', '2', '3'], 3.0)])
def test_a_robot_that_flies_keeps_its_height_unless_it_is_told_another(world, words, height):
    goals = []

    def take(handle):
        goals.append(handle.request.waypoint.pose.position)
        handle.succeed()
        return GoToWaypoint.Result(reached=True)

    server = ActionServer(world.node, GoToWaypoint, '/drone/go_to', take)
    publisher = world.node.create_publisher(AgentState, '/drone/state', SENSOR)
    state = AgentState(robot='drone')
    state.pose.pose.position.z = 5.0
    timer = world.node.create_timer(0.05, lambda: publisher.publish(state))
    code, said = ended(world, started(world, 'drone', 'go', *words))
    assert code == DONE, said
    assert [(goal.x, goal.y, goal.z) for goal in goals] == [(1.0, 2.0, height)]
    for entity in (timer, publisher, server):
        entity.destroy()


@pytest.mark.parametrize('words', [['state'], ['go', '1', '2']])
def test_interrupted_before_there_is_a_driver_it_ends_at_once(world, words):
    process = started(world, '--timeout', '1000', 'nobody', *words)
    # A node of it is in the graph: it waits.
    world.until(lambda: 'robot_command' in world.node.get_node_names(), 'it does not start')
    process.send_signal(signal.SIGINT)
    assert ended(world, process) == (INTERRUPTED, '')


@pytest.mark.parametrize('words', [[], ['a'], ['a', 'go'], ['a', 'go', '1', 'nan'], ['a', 'fly']])
def test_wrong_arguments_end_with_2(words):
    with pytest.raises(SystemExit, match='2'):
        build_parser().parse_args(words)
