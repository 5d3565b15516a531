"""Show the state of a robot, or send it to a waypoint: for manual tests."""

import argparse
import math
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from maasi_filter.ros.qos import SENSOR
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import AgentState

DONE, FAILED, ABSENT, INTERRUPTED = 0, 1, 2, 130
_STATUS = {
    AgentState.IDLE: 'no goal',
    AgentState.MOVING: 'on the way',
    AgentState.REACHED: 'goal reached',
    AgentState.CANCELED: 'goal cancelled',
    AgentState.ABORTED: 'goal given up',
    AgentState.UNAVAILABLE: 'cannot go on',
}
_CANCEL_TIME = 5.0  # longest wait for the answer to a cancelled goal [s]


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='robot_command',
        description='Shows the state of a robot, or sends it to a waypoint in the map.',
        epilog='Ctrl-C cancels the goal. Exit codes: 0 done, 1 refused, given up or cancelled, '
        '2 wrong arguments or no such driver, 130 interrupted before.',
    )
    parser.add_argument('robot', help='its name, with the namespace of its team if it has one')
    parser.add_argument(
        '--timeout', type=float, default=10.0, metavar='S', help='longest wait for the driver [s]'
    )
    words = parser.add_subparsers(dest='word', required=True)
    words.add_parser('state', help='print pose, battery, what it does and why')
    go = words.add_parser('go', help='send it to a waypoint, and wait until it is there')
    for axis in 'xy':
        go.add_argument(axis, type=_metres, help='[m, map]')
    go.add_argument('z', type=_metres, nargs='?', help='[m, map]; default: the height it is at')
    return parser


def _metres(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


class _User:
    def __init__(self, node: Node, options: argparse.Namespace) -> None:
        self._node, self._options = node, options
        self._top = '/' + options.robot.strip('/')
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._interrupted = threading.Event()
        signal.signal(signal.SIGINT, lambda *_: self._interrupted.set())

    def _wait(
        self, condition: Callable[[], object], timeout: float = math.inf, *, patient: bool = False
    ) -> bool:
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end or (self._interrupted.is_set() and not patient):
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def _require(self, condition: Callable[[], object], what: str) -> None:
        if self._wait(condition, self._options.timeout):
            return
        if self._interrupted.is_set():
            raise SystemExit(INTERRUPTED)
        print(f'{what} for {self._options.timeout:g} s: is its driver there?')
        raise SystemExit(ABSENT)

    def show(self) -> int:
        """Print the next state."""
        state = self._next_state()
        position = state.pose.pose.position
        battery = f'{state.battery:.0%}' if state.battery >= 0.0 else 'unknown'
        reason = f': {state.reason}' if state.reason else ''
        print(
            f'{state.robot}: {_STATUS.get(state.goal_status, "unknown")}{reason}; at '
            f'({position.x:.3f}, {position.y:.3f}, {position.z:.3f}) m in '
            f'{state.header.frame_id}, battery {battery}'
        )
        return DONE

    def _next_state(self) -> AgentState:
        heard: list[AgentState] = []
        topic = f'{self._top}/state'
        self._node.create_subscription(AgentState, topic, heard.append, SENSOR)
        self._require(lambda: heard, f'nothing on {topic}')
        return heard[-1]

    def go(self) -> int:
        """Send it to the waypoint, and wait; an interrupt cancels the goal."""
        height = self._options.z
        if height is None:
            # One that flies is not sent into the ground.
            height = self._next_state().pose.pose.position.z
        topic = f'{self._top}/go_to'
        client = ActionClient(self._node, GoToWaypoint, topic)
        self._require(client.server_is_ready, f'no {topic}')
        goal = GoToWaypoint.Goal(goal_id=1)
        goal.waypoint.header.frame_id = 'map'
        position = goal.waypoint.pose.position
        position.x, position.y, position.z = self._options.x, self._options.y, height
        goal.waypoint.pose.orientation.w = 1.0
        answer = client.send_goal_async(goal)
        # After an interrupt too: only a goal whose answer is known can be cancelled.
        if not (self._wait(answer.done) or self._wait(answer.done, _CANCEL_TIME, patient=True)):
            print('interrupted; nothing was heard of the goal')
            return FAILED
        handle = answer.result()
        if handle is None or not handle.accepted:
            print('refused: the log of its driver says why')
            return FAILED
        result = handle.get_result_async()
        if not self._wait(result.done):
            handle.cancel_goal_async()
            if not self._wait(result.done, _CANCEL_TIME, patient=True):
                print('cancelled; nothing was heard of its end')
                return FAILED
        end: Any = result.result()
        place, reason = end.result.pose.position, end.result.reason
        reached = end.status == GoalStatus.STATUS_SUCCEEDED
        print(
            ('reached' if reached else f'not reached: {reason}')
            + f'; it stands at ({place.x:.3f}, {place.y:.3f}, {place.z:.3f}) m'
        )
        return DONE if reached else FAILED


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    options = build_parser().parse_args(arguments)
    try:
        # Ctrl-C cancels the goal before the context ends.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node('robot_command', use_global_arguments=False)
        user = _User(node, options)
        return user.show() if options.word == 'state' else user.go()
    except KeyboardInterrupt:  # before the user's own handler
        return INTERRUPTED
    finally:
        rclpy.try_shutdown()


if __name__ == '__main__':
    raise SystemExit(main())
