"""Runs a node as a process: command line, executor, signals, clean end."""

import gc
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import get_default_context

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.parameters import node_help


class _NoNode:
    """A second node for the events executor, which crashes with only one (rclpy 7.1, pull 1718)."""

    executor: Any = None
    subscriptions = timers = clients = services = waitables = guards = ()


def executor_of(node: Node, context: Context | None = None) -> Executor:
    """Return an executor for one node: rclpy's fast events executor if it exists."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        executor: Executor = SingleThreadedExecutor(context=context)
    else:
        executor = EventsExecutor(context=context)
        dummy: Any = _NoNode()
        executor.add_node(dummy)
    executor.add_node(node)
    return executor


_SIGNAL_PERIOD = 0.1  # period of the check for signals [s]
_FAREWELL = 0.05  # from the last message to the end of the context [s]


def run(
    make_node: Callable[[], LockstepLifecycleNode[Any]],
    arguments: list[str] | None = None,
    kind: type[LockstepLifecycleNode[Any]] | None = None,
) -> int:
    """Run a node until it is asked to end and all motion is stopped; return the exit code."""
    if {'-h', '--help'} & set(sys.argv[1:] if arguments is None else arguments):
        explained = kind or (make_node if isinstance(make_node, type) else LockstepLifecycleNode)
        try:
            name = Path(sys.argv[0]).name
            print(node_help(explained, name, LockstepLifecycleNode), flush=True)
        except BrokenPipeError:  # `--help | head`; Python writes the rest when it ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    # The handler only sets a flag: an exception raised inside a call into rclpy's C++ surfaces as
    # a different one. A second signal raises at once.
    asked = False

    def interrupt(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        if node is not None:
            node.ending = True

    node: LockstepLifecycleNode[Any] | None = None
    try:
        signal.signal(signal.SIGINT, interrupt)
        signal.signal(signal.SIGTERM, interrupt)
        try:
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:  # a parameter file or an argument that rcl cannot read
            print(f'error: {str(error).partition(", at ")[0]}', file=sys.stderr)
            return 2
        node = make_node()
        executor = executor_of(node)
        if node.get_parameter('autostart').value and not asked:
            if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
                print(f'error: {node.problem}', file=sys.stderr)
                return 2 if node.problem else 1
            if not asked and node.trigger_activate() != TransitionCallbackReturn.SUCCESS:
                return 1
        # Objects created so far are permanent: exclude them from garbage collection.
        gc.collect()
        gc.freeze()
        # Rare collections suffice, as messages are freed without them.
        gc.set_threshold(50_000, 20, 100)
        while rclpy.ok() and not asked:
            # Returns only to check for signals; `spin_once` returns after each callback.
            executor.spin_until_future_complete(Future(), _SIGNAL_PERIOD)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if node is not None:
            if rclpy.ok() and node.configured:
                node.halt()
            node.destroy_node()
            time.sleep(_FAREWELL)  # messages that are not received yet end with the context
        rclpy.try_shutdown()
        # Explicit: a forked process ends with `os._exit`, without clean-up by the interpreter.
        get_default_context(shutting_down=True).destroy()
    return 0
