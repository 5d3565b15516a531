"""Lets simulated vehicles take off at the start of a run, as a person does with real ones."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import Any

from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

# Period of calls for one robot: the first may come before its driver is active [s].
_PERIOD = 2.0


class Arming:
    """Calls the service `arm` of drivers until their robots, full names, take part in the run."""

    def __init__(self, context: Context, robots: Collection[str]) -> None:
        self._clients: dict[str, Client] = {}
        self._answers: dict[str, Any] = {}
        self._called_at: dict[str, float] = {}
        if not robots:
            return
        self._node = Node(
            'arming',
            context=context,
            start_parameter_services=False,
            enable_rosout=False,
            use_global_arguments=False,
        )
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)
        self._clients = {name: self._node.create_client(Trigger, f'/{name}/arm') for name in robots}

    def call(self, ready: Collection[str]) -> None:
        """Call the services that are due; `ready` are the nodes that take part already."""
        if not self._clients:
            return
        now = time.monotonic()
        for name, client in self._clients.items():
            due = now - self._called_at.get(name, -_PERIOD) >= _PERIOD
            open_call = name in self._answers and not self._answers[name].done()
            if f'/{name}/driver' in ready or open_call or not due or not client.service_is_ready():
                continue
            self._called_at[name] = now
            self._answers[name] = client.call_async(Trigger.Request())
        self._executor.spin_once(timeout_sec=0.0)

    def close(self) -> None:
        """Leave the graph."""
        if not self._clients:
            return
        self._executor.shutdown()
        self._node.destroy_node()
