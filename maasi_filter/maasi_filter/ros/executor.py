"""Choice of the executor of a node."""

from __future__ import annotations

from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node


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
    executor.add_node(node)
    return executor
