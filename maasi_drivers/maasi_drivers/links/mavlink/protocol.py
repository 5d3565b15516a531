"""MAVLink 2 by pymavlink, and reports for the log."""

from collections import deque

from pymavlink import mavutil

mavlink = mavutil.mavlink

ERROR, WARNING, INFO, DEBUG = 3, 4, 6, 7  # of MAV_SEVERITY
_TEXT_AGE = 6.0  # more recent texts of the autopilot explain a refusal [s]


class ReportLog:
    """Queue of reports for the driver; severities as in MAVLink, times: steady clock."""

    def __init__(self) -> None:
        self._reports: deque[tuple[int, str]] = deque(maxlen=200)
        self._texts: deque[tuple[float, str]] = deque(maxlen=8)

    def add(self, severity: int, text: str) -> None:
        """Add a report."""
        self._reports.append((severity, text))

    def add_text(self, severity: int, text: str, now: float) -> None:
        """Add a text of the autopilot."""
        self._texts.append((now, text))
        self.add(severity, f'autopilot: {text}')

    def pop_all(self) -> list[tuple[int, str]]:
        """Return the reports since the last call: severity and text."""
        reports = list(self._reports)
        self._reports.clear()
        return reports

    def recent_text(self, now: float, most: int = 8) -> str:
        """Return the last recent texts of the autopilot, without repetitions."""
        texts = list(dict.fromkeys(text for time, text in self._texts if now - time < _TEXT_AGE))
        return '; '.join(texts[-most:])
