"""Requests to the services that rclpy makes for each node, of which some make it raise."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

# Errors of bad requests, by the package of the service's type.
_ERRORS: dict[str, tuple[type[Exception], ...]] = {
    'rcl_interfaces': (TypeError, ValueError, AttributeError, KeyError, AssertionError),
    'lifecycle_msgs': (rclpy_implementation.RCLError,),
}


def survive_bad_requests(node: Node, drop: Callable[[str, str], None]) -> None:
    """Answer requests that rclpy cannot work off with an empty response, instead of ending.

    rclpy raises on the type of an undeclared parameter, on values of an unknown type, and on a
    transition that the present state does not have.

    Parameters
    ----------
    node : Node
        Whose services there are now.
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
