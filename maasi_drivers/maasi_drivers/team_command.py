"""Commands a team or robots: start, pause, resume, send home, stop, arm, move, show state."""

import argparse
import math
import re
import signal
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from maasi_filter.ros.qos import SENSOR
from maasi_filter.ros.report_client import call_services
from maasi_msgs.action import GoToWaypoint
from maasi_msgs.msg import AgentState
from maasi_planner.node.search_modes import COMMANDS

# rclpy before 7.1 prints an error when Ctrl-C interrupts the constructor of an executor.
SingleThreadedExecutor._sigint_gc = None  # type: ignore[assignment]

DONE, FAILED, ABSENT, INTERRUPTED = 0, 1, 2, 130
# Commands of drivers only.
_OF_DRIVERS = ('release', 'arm')
_HELP = {
    'start': 'start or restart the search',
    'pause': 'stop the robots at their positions; the search keeps its state',
    'resume': 'continue after pause or home',
    'home': 'return to the start positions and pause there',
    'stop': 'end the search and stop the robots; drivers refuse goals until release',
    'release': 'accept goals again after stop',
    'arm': 'allow vehicles to take off once',
    'state': 'print pose, battery, goal and status of a robot',
    'go': 'send a robot to a waypoint and wait until it arrives; Ctrl-C cancels the goal',
}
_STATUS = {
    AgentState.IDLE: 'no goal',
    AgentState.MOVING: 'moving to the goal',
    AgentState.REACHED: 'goal reached',
    AgentState.CANCELED: 'goal cancelled',
    AgentState.ABORTED: 'goal aborted',
    AgentState.UNAVAILABLE: 'unavailable',
}
_CANCEL_TIME = 5.0  # longest wait for the answer to a cancelled goal [s]


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='team_command',
        description='Command a team or some of its robots. stop, release and arm call the '
        'drivers directly and work without a planner; state and go are for tests.',
        epilog='Options of each command: --namespace NS of the team, --timeout S for answers. Exit '
        'codes: 0 done, 1 refused, no answer, goal aborted or cancelled, 2 wrong arguments or no '
        'such service or driver, 130 interrupted.',
    )
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument('--namespace', default='', metavar='NS', help='namespace of the team')
    text = 'wait up to S seconds for an answer (default: %(default)g)'
    common.add_argument('--timeout', type=float, default=10.0, metavar='S', help=text)
    words = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for word in (*COMMANDS, *_OF_DRIVERS):
        calls = words.add_parser(word, parents=[common], help=_HELP[word], description=_about(word))
        calls.add_argument(
            'robots', nargs='*', metavar='ROBOT', help='robots (default: the whole team)'
        )
    for word in ('state', 'go'):
        one = words.add_parser(word, parents=[common], help=_HELP[word], description=_about(word))
        one.add_argument('robot', metavar='ROBOT', help='name of the robot')
    for axis in 'XY':
        one.add_argument(axis, type=_metres, help=f'{axis.lower()} of the waypoint [m, map]')
    height = 'height of the waypoint [m, map] (default: the current height)'
    one.add_argument('Z', type=_metres, nargs='?', help=height)
    return parser


def _about(word: str) -> str:
    return f'{_HELP[word][0].upper()}{_HELP[word][1:]}.'


def _metres(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _path(*names: str) -> str:
    return ''.join(f'/{part}' for name in names for part in name.split('/') if part)


def wanted(services: Mapping[str, list[str]], options: argparse.Namespace) -> set[str]:
    """Return the available services that a command calls."""
    command, robots, top = options.command, options.robots, _path(options.namespace)
    known = {name for name, types in services.items() if 'std_srvs/srv/Trigger' in types}
    one = '|'.join(re.escape(_path(robot)) for robot in robots) or '/[^/]+'

    def below(tail: str) -> set[str]:
        return {name for name in known if re.fullmatch(f'{re.escape(top)}({one})/{tail}', name)}

    # A driver has both services.
    drivers = {name.removesuffix('/release') for name in below('release')}
    drivers &= {name.removesuffix('/stop') for name in below('stop')}
    direct = command in ('stop', *_OF_DRIVERS)
    chosen = {f'{name}/{command}' for name in drivers} & known if direct else set()
    if command in _OF_DRIVERS:
        return chosen
    team = f'{top}/search/{command}'
    return chosen | ({team} if not robots and team in known else below(f'search/{command}'))


def _without(services: Iterable[str], options: argparse.Namespace) -> list[str]:
    """Return the requested robots that have none of these services."""
    tops = {robot: _path(options.namespace, robot) + '/' for robot in options.robots}
    return [robot for robot, top in tops.items() if not any(s.startswith(top) for s in services)]


def call_all(node: Node, options: argparse.Namespace) -> dict[str, Any]:
    """Call each service when it is discovered; return the answers, None without one."""

    # Without the team's planner the discovered services may cover only some robots.
    def complete(names: Iterable[str], settled: bool) -> bool:
        return settled and not _without(names, options)

    request, found = Trigger.Request(), partial(wanted, options=options)
    return call_services(node, Trigger, request, found, complete, options.timeout)


def _call(node: Node, options: argparse.Namespace) -> int:
    answers = call_all(node, options)
    for name, answer in sorted(answers.items()):
        print(f'{name}: ' + ('no answer' if answer is None else answer.message))
    absent = _without(answers, options)
    if absent or not answers:
        what = f'{options.command} of {", ".join(absent)}' if absent else options.command
        print(f'no service for {what} within {options.timeout:g} s: is its node running?')
        return ABSENT
    return DONE if all(answer and answer.success for answer in answers.values()) else FAILED


class _Robot:
    def __init__(self, node: Node, options: argparse.Namespace) -> None:
        self._node, self._options = node, options
        self._top = _path(options.namespace, options.robot)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._interrupted = threading.Event()

    def _wait(self, condition: Callable[[], object], timeout: float = math.inf) -> bool:
        """Return whether a condition became true in time; an interrupt ends unlimited waits."""
        end = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > end or (timeout == math.inf and self._interrupted.is_set()):
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def _require(self, condition: Callable[[], object], what: str) -> None:
        if not self._wait(condition, self._options.timeout):
            print(f'{what} for {self._options.timeout:g} s: is its driver running?')
            raise SystemExit(ABSENT)

    def state(self) -> int:
        state = self._next_state()
        at, frame = state.pose.pose.position, state.header.frame_id
        goal = _STATUS.get(state.goal_status, 'unknown')
        reason = f': {state.reason}' if state.reason else ''
        battery = f'{100.0 * state.battery:.0f} %' if state.battery >= 0.0 else 'unknown'
        print(
            f'{state.robot}: {goal}{reason}; at ({at.x:.3f}, {at.y:.3f}, {at.z:.3f}) m in {frame}, '
            f'battery {battery}'
        )
        return DONE

    def _next_state(self) -> AgentState:
        received: list[AgentState] = []
        topic = f'{self._top}/state'
        self._node.create_subscription(AgentState, topic, received.append, SENSOR)
        self._require(lambda: received, f'no message on {topic}')
        return received[-1]

    def go(self) -> int:
        """Send the robot to the waypoint and wait; an interrupt cancels the goal."""
        # A flying robot keeps its height.
        z = self._options.Z
        height = self._next_state().pose.pose.position.z if z is None else z
        topic = f'{self._top}/go_to'
        client = ActionClient(self._node, GoToWaypoint, topic)
        self._require(client.server_is_ready, f'no {topic}')
        goal = GoToWaypoint.Goal(goal_id=1)
        goal.waypoint.header.frame_id = 'map'
        at = goal.waypoint.pose.position
        at.x, at.y, at.z = self._options.X, self._options.Y, height
        # From here on an interrupt cancels the goal before the context ends.
        signal.signal(signal.SIGINT, lambda *_: self._interrupted.set())
        answer = client.send_goal_async(goal)
        # Also after an interrupt: only a goal with a known answer can be cancelled.
        if not (self._wait(answer.done) or self._wait(answer.done, _CANCEL_TIME)):
            print('interrupted before the driver answered the goal')
            return FAILED
        handle = answer.result()
        if handle is None or not handle.accepted:
            print('refused; see the log of its driver')
            return FAILED
        result = handle.get_result_async()
        if not self._wait(result.done):
            handle.cancel_goal_async()
            if not self._wait(result.done, _CANCEL_TIME):
                print('cancelled; no confirmation received')
                return FAILED
        end: Any = result.result()
        at = end.result.pose.position
        reached = end.status == GoalStatus.STATUS_SUCCEEDED
        said = 'reached' if reached else f'not reached: {end.result.reason}'
        print(f'{said}; position ({at.x:.3f}, {at.y:.3f}, {at.z:.3f}) m')
        return DONE if reached else FAILED


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    options = build_parser().parse_args(arguments)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node('team_command', use_global_arguments=False)
        if options.command in ('state', 'go'):
            return getattr(_Robot(node, options), options.command)()
        return _call(node, options)
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        rclpy.try_shutdown()


if __name__ == '__main__':
    raise SystemExit(main())
