"""Modes of the robots in a search, and their commands, without ROS."""

from collections.abc import Collection, Iterable
from enum import Enum


class Mode(Enum):
    """Mode of a robot."""

    WAITING = 'waiting for start'
    SEARCHING = 'searching'
    PAUSED = 'paused'
    HOME = 'sent home'
    STOPPED = 'stopped'


COMMANDS = ('start', 'pause', 'resume', 'home', 'stop')

# Transitions: allowed modes (None: all) and resulting mode of each command.
_ALLOWED: dict[str, tuple[frozenset[Mode] | None, Mode]] = {
    'start': (None, Mode.SEARCHING),
    'pause': (frozenset({Mode.SEARCHING, Mode.PAUSED, Mode.HOME}), Mode.PAUSED),
    'resume': (frozenset({Mode.SEARCHING, Mode.PAUSED, Mode.HOME}), Mode.SEARCHING),
    'home': (None, Mode.HOME),
    'stop': (None, Mode.STOPPED),
}


class SearchModes:
    """Modes of robots, which commands change."""

    def __init__(self, names: Iterable[str]) -> None:
        self.of = dict.fromkeys(sorted(names), Mode.WAITING)

    @property
    def under_way(self) -> bool:
        """Whether a search has begun and has not been stopped."""
        return any(mode in (Mode.SEARCHING, Mode.PAUSED, Mode.HOME) for mode in self.of.values())

    def command(self, word: str, names: Collection[str] | None = None) -> list[str]:
        """Apply a command; return the robots that follow it."""
        allowed, mode = _ALLOWED[word]
        follow = [
            name
            for name, before in self.of.items()
            if (names is None or name in names) and (allowed is None or before in allowed)
        ]
        for name in follow:
            self.of[name] = mode
        return follow

    def describe(self, names: Collection[str] | None = None) -> str:
        """Return the modes of robots (None: all) as text."""
        of = {name: mode for name, mode in self.of.items() if names is None or name in names}
        if len(set(of.values())) == 1:
            return next(iter(of.values())).value
        return ', '.join(f'{name} {mode.value}' for name, mode in of.items())
