"""Calls the services of filters that take statements of persons."""

import time
from collections.abc import Mapping
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


def call_filters(
    node: Node, service: str, fields: Mapping[str, Any], space: str, only: bool, timeout: float
) -> dict[str, Any]:
    """Call a service of the filter in a namespace, or (`only` false) of all below it.

    Returns the answers by service, None without one.
    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    kind, top = KINDS[service], f'/{space}' if space else ''
    request: Any = kind.Request()
    for name, value in fields.items():
        if name == 'position':
            request.position.x, request.position.y = value
        else:
            setattr(request, name, value)
    own, clients, calls = f'{top}/search/{service}', {}, {}  # type: ignore[var-annotated]
    begin = changed = time.monotonic()
    while time.monotonic() - begin < timeout:
        types = f'maasi_msgs/srv/{kind.__name__}'
        for name, known in node.get_service_names_and_types():
            fits = name == own or (not only and name.endswith(f'/search/{service}'))
            below = name.startswith(f'{top}/') and types in known
            if fits and below and name not in clients:
                clients[name] = node.create_client(kind, name)
                changed = time.monotonic()
        for name, client in clients.items():
            if name not in calls and client.service_is_ready():
                calls[name] = client.call_async(request)
        executor.spin_once(timeout_sec=0.05)
        answered = clients and len(calls) == len(clients)
        settled = only or own in clients or time.monotonic() - changed > _SETTLED
        if answered and settled and all(call.done() for call in calls.values()):
            break
    executor.shutdown()
    return dict.fromkeys(clients) | {n: call.result() for n, call in calls.items() if call.done()}
