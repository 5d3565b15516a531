"""Services that start, pause, resume, send home and stop a team or one robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger

from maasi_planner.search_control.search_modes import COMMANDS

# Takes a command and robots (none: all), returns whether it was accepted, and an answer as text.
Commander = Callable[[str, 'list[str] | None'], 'tuple[bool, str]']


def offer_services(
    node: Node, names: Sequence[str], team_topic: Callable[[str], str], commander: Commander
) -> None:
    """Create `search/<command>` for the team and `<robot>/search/<command>` for each robot."""
    services: dict[str, list[str] | None] = {}
    for word in COMMANDS:
        for name in names:
            services[team_topic(f'{name}/search/{word}')] = [name]
        # In the namespace of its only robot, the team is that robot.
        services.setdefault(node.resolve_service_name(f'search/{word}'), None)
    for service, robots in services.items():
        word = service.rpartition('/')[2]
        node.create_service(Trigger, service, partial(_serve, commander, word, robots))


def _serve(
    commander: Commander, word: str, names: list[str] | None, _: Any, response: Trigger.Response
) -> Trigger.Response:
    response.success, response.message = commander(word, names)
    return response
