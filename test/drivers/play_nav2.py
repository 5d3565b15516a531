"""Plays Nav2's `navigate_to_pose`, and prints a line for each goal and what becomes of it."""

import contextlib
import json
import time

import rclpy
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node


def say(event, pose):
    place = pose.pose.position
    turn = pose.pose.orientation
    line = {'event': event, 'frame': pose.header.frame_id, 'position': [place.x, place.y, place.z]}
    # Written at once: several threads say something.
    print(json.dumps(line | {'turn': [turn.z, turn.w]}) + '\n', end='', flush=True)


# A goal with this x is answered late.
LATE = 0.95
present = []


# With x below 0.5 it is reached, below 1 it goes on until it is cancelled or, as by Nav2, aborted
# for a new one, below 1.5 it is given up with an error; `accept_goal` refuses one beyond.
def execute(handle):
    pose = handle.request.pose
    present[:] = [handle]
    say('goal', pose)
    x, result = pose.pose.position.x, NavigateToPose.Result()
    while 0.5 <= x < 1.0 and not handle.is_cancel_requested and present[0] is handle:
        handle.publish_feedback(NavigateToPose.Feedback())
        time.sleep(0.02)
    if handle.is_cancel_requested:
        handle.canceled()
        say('cancelled', pose)
    elif present[0] is not handle:
        handle.abort()
        say('preempted', pose)
    elif x < 0.5:
        handle.succeed()
    else:
        handle.abort()
        result.error_code = 208
    return result


def accept_goal(goal):
    if goal.pose.pose.position.x == LATE:
        time.sleep(1.0)
    return GoalResponse.ACCEPT if goal.pose.pose.position.x < 1.5 else GoalResponse.REJECT


def main():
    rclpy.init()
    node = Node('bt_navigator', namespace='/rover')
    ActionServer(
        node,
        NavigateToPose,
        'navigate_to_pose',
        execute,
        goal_callback=accept_goal,
        cancel_callback=lambda handle: CancelResponse.ACCEPT,
    )
    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    print(json.dumps({'event': 'ready'}), flush=True)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()


if __name__ == '__main__':
    main()
