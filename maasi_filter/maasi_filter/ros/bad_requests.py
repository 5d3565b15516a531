"""Guards against requests to the built-in services of a node on which rclpy raises."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

# Exceptions of rclpy on bad requests, by package of the service type.
_ERRORS: dict[str, tuple[type[Exception], ...]] = {
    'rcl_interfaces': (TypeError, ValueError, AttributeError, KeyError, AssertionError),
    'lifecycle_msgs': (rclpy_implementation.RCLError,),
}


def survive_bad_requests(node: Node, drop: Callable[[str, str], None]) -> None:
    """Answer requests on which rclpy raises with an empty response, instead of ending the node.

    rclpy raises on the type of an undeclared parameter, on values of an unknown type, and on a
    transition that is not defined in the present state.

    Parameters
    ----------
    node : Node
        Node whose present services are wrapped.
    drop : callable
        Counts and logs a request: reason, text.
    """
    for service in node.services:
        errors = _ERRORS.get(service.srv_type.__module__.partition('.')[0])
        if errors is not None:
            service.callback = partial(_answer, service.callback, service.srv_name, errors, drop)


def _answer(
    callback: Callable[[Any, Any], Any],
    name: str,
    errors: tuple[type[Exception], ...],
    drop: Callable[[str, str], None],
    request: Any,
    response: Any,
) -> Any:
    try:
        return callback(request, response)
    except errors as error:
        drop('bad request', f'{name}: {type(error).__name__}: {error}')
        return type(response)()
