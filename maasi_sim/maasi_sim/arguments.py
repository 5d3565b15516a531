"""Command lines: what was read and what is allowed, when an option or a number is wrong."""

from argparse import ArgumentParser, ArgumentTypeError
from difflib import get_close_matches
from typing import Any

LARGEST = 2**63 - 1  # largest parameter of a ROS node


class Parser(ArgumentParser):
    """Names the closest option for one that is unknown."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Return the options; a wrong one ends the process with 2."""
        options, rest = self.parse_known_args(args, namespace)
        if rest:
            close = get_close_matches(rest[0].partition('=')[0], self._option_string_actions, 1)
            hint = f' (did you mean {close[0]}?)' if close else ''
            self.error(f'unknown: {" ".join(rest)}{hint}')
        return options


def whole(text: str, least: int = 0, most: int = LARGEST) -> int:
    """Return a whole number of a command line."""
    # No sign, underscore or digits of another alphabet.
    number = int(text) if text.isascii() and text.isdecimal() and len(text) < 40 else -1
    if not least <= number <= most:
        raise ArgumentTypeError(
            f"read '{text[:60]}', allowed are whole numbers from {least} to {most}"
        )
    return number


def count(text: str) -> int:
    """Return a number of runs or processes; errors as of `whole`."""
    return whole(text, 1, 9999)


def positive(text: str) -> float:
    """Return a finite number above 0; errors as of `whole`."""
    try:
        value = float(text)
    except ValueError:
        value = float('nan')
    if not 0.0 < value < float('inf'):
        raise ArgumentTypeError(f"read '{text[:60]}', allowed are finite numbers above 0")
    return value
