"""Guards against crashes of rclpy: executor, entities that stay, requests that raise."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import partial
from typing import Any, TypeVar

from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

T = TypeVar('T')

# Exceptions of rclpy on bad requests, by package of the service type.
_ERRORS: dict[str, tuple[type[Exception], ...]] = {
    'rcl_interfaces': (TypeError, ValueError, AttributeError, KeyError, AssertionError),
    'lifecycle_msgs': (rclpy_implementation.RCLError,),
}


class _NoNode:
    """Stands beside the node of an events executor.

    rclpy 7.1 crashes (SIGSEGV) where a task raises and its events executor has exactly one node
    (ros2/rclpy, pull request 1718); with two the exception ends the spin.
    """

    executor: Any = None
    subscriptions = timers = clients = services = waitables = guards = ()


def executor_of(node: Node, context: Context | None = None) -> Executor:
    """Return an executor that runs one node.

    rclpy's events executor if this version has it: the single-threaded one rebuilds its wait set
    for each callback, which takes two to four times the CPU time. In both, an exception in a
    callback ends the spin, and neither may spin after its `shutdown`.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        executor: Executor = SingleThreadedExecutor(context=context)
    else:
        executor = EventsExecutor(context=context)
        beside: Any = _NoNode()
        executor.add_node(beside)
    executor.add_node(node)
    return executor


class NodeEntities:
    """Publishers, subscriptions, services, clients, timers and actions made since `mark`.

    Action clients, action servers and subscriptions with event callbacks are permanent: rclpy's
    events executor crashes (SIGSEGV) if one is destroyed while an event of it is queued, as it
    then calls Python without the interpreter's lock.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._kept: list[Any] | None = None
        self._permanent: dict[Hashable, Any] = {}

    def permanent(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the entity of a key, made at the first call, which lives as long as the node."""
        if key not in self._permanent:
            self._permanent[key] = make()
        made: T = self._permanent[key]
        return made

    def mark(self) -> None:
        """Mark the present entities as kept: `clear` destroys only later ones."""
        self._kept = self._all()

    def clear(self) -> None:
        """Destroy the entities created since `mark`; nothing without a mark."""
        if self._kept is None:
            return
        kept = {id(item) for item in (*self._kept, *self._permanent.values())}
        self._kept = None
        node = self._node
        # Of plugins; owners destroy their event handlers.
        for waitable in list(node.waitables):
            if id(waitable) not in kept and not isinstance(waitable, EventHandler):
                waitable.destroy()  # type: ignore[attr-defined]
        owners: list[tuple[Any, Any]] = [
            (node.timers, node.destroy_timer),
            (node.subscriptions, node.destroy_subscription),
            (node.services, node.destroy_service),
            (node.clients, node.destroy_client),
            (node.publishers, node.destroy_publisher),
        ]
        for items, destroy in owners:
            for item in list(items):
                if id(item) not in kept:
                    destroy(item)

    def _all(self) -> list[Any]:
        node = self._node
        return [
            *node.publishers,
            *node.subscriptions,
            *node.services,
            *node.clients,
            *node.timers,
            *node.waitables,
        ]


def survive_bad_requests(node: Node, drop: Callable[[str, str], None]) -> None:
    """Answer requests on which rclpy raises with an empty response, instead of ending the node.

    rclpy raises on the type of an undeclared parameter, on values of an unknown type, and on a
    transition that is not defined in the present state. `drop` counts and logs: reason, text.
    """

    def answer(name: str, errors: Any, callback: Any, request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except errors as error:
            drop('bad request', f'{name}: {type(error).__name__}: {error}')
            return type(response)()

    for service in node.services:
        errors = _ERRORS.get(service.srv_type.__module__.partition('.')[0])
        if errors is not None:
            service.callback = partial(answer, service.srv_name, errors, service.callback)
