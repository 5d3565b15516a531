"""The node that shows any search: which topics it takes, and what the page gets of them."""

import time

import rclpy
from rclpy.executors import SingleThreadedExecutor

from maasi_filter.ros.qos import LATCHED, RELIABLE
from maasi_msgs.msg import AgentState, FoundTarget, FoundTargetArray
from maasi_sim.run.bag import load_types
from maasi_sim.view.live_view import LiveView, MessageFeed
from maasi_sim.view.scene import empty_scene
from maasi_sim.view.view_node import ViewNode, main

PATIENCE = 60.0


def test_a_node_that_comes_late_shows_what_is_there(ros):
    robot = rclpy.create_node('robot')
    states = robot.create_publisher(AgentState, '/team/rover/state', RELIABLE)
    found = robot.create_publisher(FoundTargetArray, '/team/found_targets', LATCHED)
    found.publish(FoundTargetArray(targets=[FoundTarget(id=1, robot='rover')]))
    view = LiveView(empty_scene(), 0)
    feed = MessageFeed(view, load_types(), waits=False)
    node = ViewNode(feed.put)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    kinds = set()
    deadline = time.monotonic() + PATIENCE
    try:
        while not {'robot', 'found'} <= kinds:
            assert time.monotonic() < deadline, kinds
            message = AgentState(robot='rover', goal_status=AgentState.MOVING)
            message.header.stamp = robot.get_clock().now().to_msg()
            message.pose.pose.orientation.w = 1.0
            states.publish(message)
            executor.spin_once(timeout_sec=0.05)
            kinds = {event[1] for event in view.hub._events}
    finally:
        node.destroy_node()
        robot.destroy_node()
        feed.close()
        view.end()


def test_an_address_of_another_machine_is_refused(ros, capsys):
    rclpy.shutdown()
    assert main(['--host', '192.0.2.1']) == 2
    assert '192.0.2.1: Cannot assign' in capsys.readouterr().err


def test_a_scenario_that_is_none_is_refused(capsys):
    assert main(['--scenario', 'no_such_scenario']) == 2
    assert 'no_such_scenario' in capsys.readouterr().err
