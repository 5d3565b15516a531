"""Start, pause, resume, send home or stop a search, the team's or one robot's; arm vehicles."""

import argparse
import re
import time
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from maasi_planner.node.search_modes import COMMANDS

DONE, REFUSED, ABSENT, INTERRUPTED = 0, 1, 2, 130
# Commands that only drivers have.
_OF_DRIVERS = ('release', 'arm')
_TRIGGER = 'std_srvs/srv/Trigger'
_SETTLED = 1.0  # discovery ends this long after the last new service [s]


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='search_command',
        description='Calls the planner; stop, release and arm reach the drivers themselves, so '
        'that they work without a planner.',
        epilog='Exit codes: 0 all followed, 1 one refused or did not answer, 2 wrong arguments '
        'or no such service, 130 interrupted.',
    )
    add = parser.add_argument
    add('command', choices=[*COMMANDS, *_OF_DRIVERS])
    add('--robot', metavar='NAME', help='one robot instead of the team')
    add('--namespace', default='', metavar='NS', help='of the team')
    add('--timeout', type=float, default=10.0, metavar='S', help='longest wait for answers [s]')
    return parser


def wanted(services: dict[str, list[str]], command: str, robot: str, namespace: str) -> set[str]:
    """Return the services that a command calls, among the available ones."""
    top = '/'.join(['', *[part for part in namespace.split('/') if part]])
    known = {name for name, types in services.items() if _TRIGGER in types}

    def below(tail: str) -> set[str]:
        one = re.escape(robot) if robot else '[^/]+'
        return {name for name in known if re.fullmatch(f'{re.escape(top)}/{one}/{tail}', name)}

    # A driver has both services.
    drivers = {name.removesuffix('/release') for name in below('release')}
    drivers &= {name.removesuffix('/stop') for name in below('stop')}
    direct = command in ('stop', *_OF_DRIVERS)
    chosen = {f'{name}/{command}' for name in drivers} & known if direct else set()
    if command in _OF_DRIVERS:
        return chosen
    team = f'{top}/search/{command}'
    return chosen | ({team} if not robot and team in known else below(f'search/{command}'))


def call_all(node: Node, options: argparse.Namespace) -> dict[str, Any]:
    """Call each service as soon as it is found; return the answers, None without an answer."""
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    calls: dict[str, Any] = {}
    clients: dict[str, Any] = {}
    deadline = time.monotonic() + options.timeout
    changed = time.monotonic()
    while time.monotonic() < deadline:
        found = wanted(
            dict(node.get_service_names_and_types()),
            options.command,
            options.robot or '',
            options.namespace,
        )
        # Without the planner of the team, the services found may cover only a part of the robots.
        for name in sorted(found - set(clients)):
            clients[name] = node.create_client(Trigger, name)
            changed = time.monotonic()
        for name, client in clients.items():
            if name not in calls and client.service_is_ready():
                calls[name] = client.call_async(Trigger.Request())
        done = clients and all(name in calls and calls[name].done() for name in clients)
        if done and time.monotonic() - changed > _SETTLED:
            break
        executor.spin_once(timeout_sec=0.05)
    executor.shutdown()
    return {
        name: calls[name].result() if name in calls and calls[name].done() else None
        for name in clients
    }


def main(arguments: list[str] | None = None) -> int:
    """Run the command line."""
    options = build_parser().parse_args(arguments)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('search_command', use_global_arguments=False)
    try:
        answers = call_all(node, options)
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    if not answers:
        print(f'no service for {options.command} within {options.timeout:g} s: is its node there?')
        return ABSENT
    for name, answer in sorted(answers.items()):
        print(f'{name}: ' + ('no answer' if answer is None else answer.message))
    return DONE if all(answer and answer.success for answer in answers.values()) else REFUSED


if __name__ == '__main__':
    raise SystemExit(main())
