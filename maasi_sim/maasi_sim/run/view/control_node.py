"""Calls the services that command robots, and those that take statements of persons, for a page."""

import argparse
import threading
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from maasi_drivers.team_command import call_all
from maasi_filter.ros.report_client import call_filters
from maasi_sim.run.view.report_request import ReportRequest

_PATIENCE = 5.0  # longest wait for the answers of all services [s]


class Control:
    """Calls the services of planners and drivers of a team; commands do not wait for each other."""

    def __init__(self, domain: int | None, namespace: str = '') -> None:
        self._namespace = namespace
        self._changed = threading.Condition()
        self._running = 0
        self._context = Context()
        rclpy.init(
            context=self._context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )

    def __call__(self, command: str, robot: str | None) -> tuple[bool, str]:
        """Execute a command for a robot (None: all); return whether all succeeded, and answers."""
        options = argparse.Namespace(
            command=command,
            robots=[robot] if robot else [],
            namespace=self._namespace,
            timeout=_PATIENCE,
        )
        return self._answers(command, lambda node: call_all(node, options))

    def report(self, request: ReportRequest) -> tuple[bool, str]:
        """Pass a statement of a person to one filter, or to all; return as a command."""
        space = '/'.join(part for part in (self._namespace, request.team) if part)
        service, fields = request.service, request.fields
        only = service == 'review_target'
        return self._answers(
            service, lambda node: call_filters(node, service, fields, space, only, _PATIENCE)
        )

    def _answers(self, what: str, call: Callable[[Node], Mapping[str, Any]]) -> tuple[bool, str]:
        with self._changed:
            if not self._context.ok():
                return False, 'the run has ended'
            self._running += 1
        # Each command has its own node, as only one thread may spin a node.
        node = rclpy.create_node(
            'view_control',
            context=self._context,
            start_parameter_services=False,
            enable_rosout=False,
            use_global_arguments=False,
        )
        try:
            answers = call(node)
        finally:
            node.destroy_node()
            with self._changed:
                self._running -= 1
                self._changed.notify_all()
        if not answers:
            return False, f'no service for {what} within {_PATIENCE:g} s'
        done = all(answer is not None and answer.success for answer in answers.values())
        words = {'no answer' if answer is None else answer.message for answer in answers.values()}
        return done, '; '.join(sorted(words))

    def close(self) -> None:
        """Destroy the context after the last command."""
        with self._changed:
            self._changed.wait_for(lambda: self._running == 0)
            rclpy.try_shutdown(context=self._context)
