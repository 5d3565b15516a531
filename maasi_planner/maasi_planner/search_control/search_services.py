"""Services that start, pause, resume, send home and stop a team or one robot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from std_srvs.srv import Trigger

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_planner.search_control.search_modes import COMMANDS

# Takes a command and robots (none: all), returns whether it was accepted, and an answer as text.
Commander = Callable[[str, 'list[str] | None'], 'tuple[bool, str]']


def offer_services(
    node: LockstepLifecycleNode[Any], names: Sequence[str], commander: Commander
) -> None:
    """Offer `search/<command>` for the team and `<robot>/search/<command>` for each robot."""
    services: dict[str, list[str] | None] = {}
    for word in COMMANDS:
        for name in names:
            services[node.team_topic(f'{name}/search/{word}')] = [name]
        # In the namespace of its only robot, the team is that robot.
        services.setdefault(node.resolve_service_name(f'search/{word}'), None)
    for service, robots in services.items():
        word = service.rpartition('/')[2]
        node.offer_service(service, partial(_serve, commander, word, robots))


def _serve(
    commander: Commander, word: str, names: list[str] | None, _: Any, response: Trigger.Response
) -> Trigger.Response:
    response.success, response.message = commander(word, names)
    return response
