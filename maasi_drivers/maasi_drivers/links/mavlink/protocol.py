"""MAVLink 2 by pymavlink: commands that are resent until answered, and reports for the log."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink import mavutil

mavlink = mavutil.mavlink

__all__ = ['mavlink', 'mavutil']


# Of MAV_SEVERITY.
ERROR, WARNING, INFO, DEBUG = 3, 4, 6, 7
# Texts of the autopilot that are younger explain a refusal [s].
_TEXT_AGE = 6.0


class ReportLog:
    """Reports until the driver takes them."""

    def __init__(self) -> None:
        self._reports: deque[tuple[int, str]] = deque(maxlen=200)
        self._texts: deque[tuple[float, str]] = deque(maxlen=8)

    def add(self, severity: int, text: str) -> None:
        """Add a report; severity as in MAVLink."""
        self._reports.append((severity, text))

    def add_text(self, severity: int, text: str, now: float) -> None:
        """Add a text of the autopilot, at `now` on the steady clock [s]."""
        self._texts.append((now, text))
        self.add(severity, f'autopilot: {text}')

    def take(self) -> list[tuple[int, str]]:
        """Return the reports since the last call: severity and text."""
        reports = list(self._reports)
        self._reports.clear()
        return reports

    def recent_text(self, now: float, most: int = 8) -> str:
        """Return the last recent texts of the autopilot, each once."""
        texts = list(dict.fromkeys(text for time, text in self._texts if now - time < _TEXT_AGE))
        return '; '.join(texts[-most:])


# Period and number of tries of a command that is not answered [s, 1].
_ANSWER_PATIENCE, _TRIES = 0.5, 5


@dataclass
class _Command:
    number: int
    parameters: tuple[float, ...]
    answer: Callable[[int | None], None]
    sent: float = -math.inf
    tries: int = 0


class CommandQueue:
    """COMMAND_LONG, in the order of the requests."""

    def __init__(self, system: int, sender: Any) -> None:
        self._system = system
        self._sender = sender
        self._commands: deque[_Command] = deque()

    def __bool__(self) -> bool:
        """Tell whether one has not been answered."""
        return bool(self._commands)

    def ask(
        self, number: int, parameters: tuple[float, ...], answer: Callable[[int | None], None]
    ) -> None:
        """Add a command."""
        self._commands.append(_Command(number, parameters, answer))

    def clear(self) -> None:
        """Discard what was not answered."""
        self._commands.clear()

    def take_answer(self, message: Any, now: float) -> None:
        """Take a COMMAND_ACK."""
        if not self._commands or self._commands[0].number != message.command:
            return
        if message.result == mavlink.MAV_RESULT_IN_PROGRESS:
            self._commands[0].sent = now
            return
        self._commands.popleft().answer(int(message.result))

    def send(self, now: float) -> None:
        """Send what is due."""
        if not self._commands:
            return
        command = self._commands[0]
        if now - command.sent < _ANSWER_PATIENCE:
            return
        if command.tries == _TRIES:
            self._commands.popleft().answer(None)
            return
        parameters = [*command.parameters, *[0.0] * (7 - len(command.parameters))]
        self._sender.command_long_send(
            self._system, mavlink.MAV_COMP_ID_AUTOPILOT1, command.number, command.tries, *parameters
        )
        command.sent = now
        command.tries += 1


def command_name(number: int) -> str:
    """Return the name of a MAV_CMD."""
    return str(mavlink.enums['MAV_CMD'][number].name)


def result_name(result: int | None) -> str:
    """Return the name of a MAV_RESULT."""
    if result is None:
        return 'not answered'
    item = mavlink.enums['MAV_RESULT'].get(result)
    return f'result {result}' if item is None else str(item.name).removeprefix('MAV_RESULT_')
