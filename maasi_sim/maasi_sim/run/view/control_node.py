"""Calls the services that pause, resume, send home and stop robots, for a page."""

import argparse
import threading

import rclpy
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

from maasi_drivers.team_command import call_all

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
            answers = call_all(node, options)
        finally:
            node.destroy_node()
            with self._changed:
                self._running -= 1
                self._changed.notify_all()
        if not answers:
            return False, f'no service for {command} within {_PATIENCE:g} s'
        done = all(answer is not None and answer.success for answer in answers.values())
        words = {'no answer' if answer is None else answer.message for answer in answers.values()}
        return done, '; '.join(sorted(words))

    def close(self) -> None:
        """Destroy the context after the last command."""
        with self._changed:
            self._changed.wait_for(lambda: self._running == 0)
            rclpy.try_shutdown(context=self._context)
