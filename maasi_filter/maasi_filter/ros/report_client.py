"""Calls services as they are discovered, and those of filters that take statements of persons."""

import time
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from maasi_msgs.msg import Report
from maasi_msgs.srv import AddSighting, MarkSearched, ReviewTarget

KINDS = {
    'review_target': ReviewTarget,
    'add_sighting': AddSighting,
    'mark_searched': MarkSearched,
}
_SETTLED = 1.0  # discovery ends this long after the last new service [s]


def request_of(report: Report) -> tuple[str, Any]:
    """Return service and request of a published statement."""
    if report.kind == Report.SIGHTING:
        request = AddSighting.Request(
            position=report.position, radius=report.radius, weight=report.weight
        )
        service = 'add_sighting'
    elif report.kind == Report.SEARCHED:
        request = MarkSearched.Request(zone=report.zone, detection_probability=report.weight)
        service = 'mark_searched'
    else:
        confirmed = report.kind == Report.CONFIRMED
        request = ReviewTarget.Request(
            id=report.target, confirmed=confirmed, reliability=report.weight
        )
        service = 'review_target'
    request.source = report.source
    return service, request


def call_services(
    node: Node,
    kind: Any,
    request: Any,
    wanted: Callable[[Mapping[str, list[str]]], Iterable[str]],
    complete: Callable[[Collection[str], bool], bool],
    timeout: float,
) -> dict[str, Any]:
    """Call services of a kind when they are discovered; return the answers, None without one.

    `wanted` chooses among the types of services by name. Once all have answered, `complete` says
    by their names, and by whether discovery has settled, if others may follow.
    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    clients: dict[str, Any] = {}
    calls: dict[str, Any] = {}
    answers: dict[str, Any] = {}
    begin = changed = time.monotonic()
    while time.monotonic() - begin < timeout:
        for name in sorted(set(wanted(dict(node.get_service_names_and_types()))) - set(clients)):
            clients[name] = node.create_client(kind, name)
            changed = time.monotonic()
        for name, client in clients.items():
            if name not in calls and client.service_is_ready():
                calls[name] = client.call_async(request)
        executor.spin_once(timeout_sec=0.05)
        answers = {name: call.result() for name, call in calls.items() if call.done()}
        settled = time.monotonic() - changed > _SETTLED
        if clients and len(answers) == len(clients) and complete(clients, settled):
            break
    executor.shutdown()
    return dict.fromkeys(clients) | answers


def call_filters(
    node: Node, service: str, fields: Mapping[str, Any], space: str, only: bool, timeout: float
) -> dict[str, Any]:
    """Call a service of the filter in a namespace, or (`only` false) of all below it.

    Returns the answers by service, None without one.
    """
    kind, top = KINDS[service], f'/{space}' if space else ''
    request: Any = kind.Request()
    for name, value in fields.items():
        if name == 'position':
            request.position.x, request.position.y = value
        else:
            setattr(request, name, value)
    own, types = f'{top}/search/{service}', f'maasi_msgs/srv/{kind.__name__}'

    def wanted(services: Mapping[str, list[str]]) -> list[str]:
        names = [name for name, known in services.items() if types in known]
        below = [name for name in names if name.startswith(f'{top}/')]
        return [
            name
            for name in below
            if name == own or (not only and name.endswith(f'/search/{service}'))
        ]

    def complete(names: Collection[str], settled: bool) -> bool:
        return only or own in names or settled

    return call_services(node, kind, request, wanted, complete, timeout)
