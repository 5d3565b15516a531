"""Numbers for people, and error texts of checked models: what was read, what is allowed."""

import json
import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import ValidationError

# Names of types in pydantic's messages.
_PLAIN = {
    'boolean': 'true or false',
    'string': 'text',
    'integer': 'a whole number',
    'number': 'a number',
    'list': 'a list',
}


def number(value: float) -> str:
    """Return a number for people: three significant digits, '-' if it is not finite."""
    if not math.isfinite(value):
        return '-'
    if abs(value) >= 100.0:
        return f'{value:.0f}'
    return f'{value:.3g}' if value else '0'


def point(values: Iterable[float]) -> str:
    """Return coordinates for people; 0 for those that are small next to the largest one."""
    given = list(values)
    least = 1e-3 * max((abs(value) for value in given if math.isfinite(value)), default=0.0)
    rounded = [0.0 if abs(value) < least else value for value in given]
    return f'({", ".join(map(number, rounded))})'


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, which has an s unless it is 1."""
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'


def shown(value: Any) -> str:
    """Return a value as written in its file, shortened."""
    if isinstance(value, Mapping):
        return 'a mapping of keys'
    text = repr(value) if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= 60 else f'{text[:57]}...'


def reason(item: Any) -> str:
    """Return an item of `ValidationError.errors()` as text; our own texts are unchanged."""
    if item['type'] == 'value_error':
        return str(item['ctx']['error'])
    text = item['msg'].replace('Input should be', 'allowed is').replace(' after validation', '')
    text = re.sub(r'a valid dictionary( or .*)?', 'a mapping of keys', text)
    for name, plain in _PLAIN.items():
        text = text.replace(f'a valid {name}', plain)
    return f'read {shown(item["input"])}, {text[0].lower()}{text[1:]}'


def problems(error: ValidationError) -> str:
    """Return all errors in one line: keys and reasons."""
    return '; '.join(
        ': '.join(filter(None, ('.'.join(map(str, item['loc'])), reason(item))))
        for item in error.errors()
    )
