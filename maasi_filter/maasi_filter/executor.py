"""The executor that a node spins in."""

from __future__ import annotations

from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node


def executor_of(node: Node, context: Context | None = None) -> Executor:
    """Return an executor that runs one node.

    rclpy's events executor, since 7.1.5: the single-threaded one of older versions builds its wait
    set anew for each callback, and takes two to four times the CPU time per message. In both, a
    callback that raises ends the spin.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        executor: Executor = SingleThreadedExecutor(context=context)
    else:
        executor = EventsExecutor(context=context)
    executor.add_node(node)
    return executor
