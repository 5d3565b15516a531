"""Choice of the executor of a node."""

from __future__ import annotations

from typing import Any

from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node


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
