"""The executor that a node spins in."""

from __future__ import annotations

from rclpy.context import Context
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node


def executor_of(node: Node, context: Context | None = None) -> Executor:
    """Return an executor that runs one node.

    It is rclpy's events executor, where this version of rclpy has it: the single-threaded one
    builds its wait set anew for each callback, which takes two to four times the CPU time. In both,
    a callback that raises ends the spin. Neither may spin after its `shutdown`.
    """
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        executor: Executor = SingleThreadedExecutor(context=context)
    else:
        executor = EventsExecutor(context=context)
    executor.add_node(node)
    return executor
