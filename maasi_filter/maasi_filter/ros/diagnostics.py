"""Diagnostics of a node, counts of dropped data, and throttled log messages."""

import time
from collections import Counter
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode

_PERIOD = 1.0  # of the diagnostics [s]
_LOG_PERIOD = 2.0

STEADY = Clock(clock_type=ClockType.STEADY_TIME)


class ReportingNode(LifecycleNode):
    """A lifecycle node that publishes `/diagnostics` (diagnostic_msgs/DiagnosticArray)."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.dropped: Counter[str] = Counter()
        self.configured = False
        self.active = False
        self._logged: dict[str, float] = {}
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_timer(_PERIOD, self._publish_diagnostics, clock=STEADY)

    def status(self) -> dict[str, Any]:
        """Return further values for the diagnostics."""
        return {}

    def fault(self) -> str:
        """Return the present error for the diagnostics; empty if there is none."""
        return ''

    def warnings(self) -> list[str]:
        """Return the present warnings for the diagnostics."""
        return []

    def check_peers(self) -> list[str]:
        """Check once a second what the node shares with others; return warnings."""
        return []

    def stamp_of_diagnostics(self) -> Time:
        """Return the present time of the run."""
        return self.get_clock().now().to_msg()

    def drop(self, reason: str, text: str, number: int = 1) -> None:
        """Count dropped data by reason, and warn, throttled, with read and allowed values."""
        self.dropped[reason] += number
        self.warn_throttled(reason, f'dropped: {text}')

    def warn_throttled(self, key: str, text: str, period: float = _LOG_PERIOD) -> None:
        """Warn at most once in a period [s] under one key."""
        if self._is_due(key, period):
            self.get_logger().warning(text)

    def tell_throttled(self, key: str, text: str) -> None:
        """Log information at most every two seconds under one key."""
        if self._is_due(key):
            self.get_logger().info(text)

    def _is_due(self, key: str, period: float = _LOG_PERIOD) -> bool:
        now = time.monotonic()
        due = now - self._logged.get(key, -1e9) >= period
        if due:
            self._logged[key] = now
        return due

    def _publish_diagnostics(self) -> None:
        peers = self.check_peers()
        fault = self.fault() if self.active else ''
        warnings = [*(self.warnings() if self.active else []), *peers]
        counts = {reason: number for reason, number in sorted(self.dropped.items()) if number}
        if counts:
            texts = (f'{reason} {number}' for reason, number in counts.items())
            warnings = [*warnings, f'dropped: {", ".join(texts)}']
        level = DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK
        level = DiagnosticStatus.ERROR if fault else level
        values = dict(self.status()) if self.configured else {}
        values |= {f'dropped: {reason}': number for reason, number in counts.items()}
        status = DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name(),
            message='; '.join([fault or ('active' if self.active else 'not active'), *warnings]),
            hardware_id='',
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.stamp_of_diagnostics()
        self._diagnostics.publish(message)
