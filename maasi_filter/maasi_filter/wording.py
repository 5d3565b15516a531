"""Errors of checked models in words: what was read, and what is allowed."""

import json
import re
from collections.abc import Mapping
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


def shown(value: Any) -> str:
    """Return a value as its file has it, shortened."""
    if isinstance(value, Mapping):
        return 'a mapping of keys'
    text = repr(value) if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= 60 else f'{text[:57]}...'


def reason(item: Any) -> str:
    """Return an error, of `ValidationError.errors()`, in words; those of our validators as is."""
    if item['type'] == 'value_error':
        return str(item['ctx']['error'])
    text = item['msg'].replace('Input should be', 'allowed is').replace(' after validation', '')
    text = re.sub(r'a valid dictionary( or .*)?', 'a mapping of keys', text)
    for name, plain in _PLAIN.items():
        text = text.replace(f'a valid {name}', plain)
    return f'read {shown(item["input"])}, {text[0].lower()}{text[1:]}'


def problems(error: ValidationError) -> str:
    """Return all that is wrong in one line: keys and reasons."""
    return '; '.join(
        ': '.join(filter(None, ('.'.join(map(str, item['loc'])), reason(item))))
        for item in error.errors()
    )
