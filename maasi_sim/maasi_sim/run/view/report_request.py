"""Statements of persons that a page sends, as the fields of a service of the filter."""

from collections.abc import Mapping
from typing import Any, NamedTuple

_NUMBER, _TEXT = (int, float), (str,)
# Service, and the types of its fields.
SERVICES: dict[str, dict[str, tuple[type, ...]]] = {
    'review_target': {'id': (int,), 'confirmed': (bool,), 'reliability': _NUMBER, 'source': _TEXT},
    'add_sighting': {'position': (list,), 'radius': _NUMBER, 'weight': _NUMBER, 'source': _TEXT},
    'mark_searched': {'zone': _TEXT, 'detection_probability': _NUMBER, 'source': _TEXT},
}
_WORDS = {int: 'a whole number', float: 'a number', str: 'text', bool: 'true or false'}
_WORDS |= {list: 'two numbers'}
_LARGEST_ID = 2**32 - 1


class ReportRequest(NamedTuple):
    """A service of filters, the namespace of the filter ('': all), and the fields."""

    service: str
    team: str
    fields: dict[str, Any]


def read_report(body: Mapping[str, Any]) -> ReportRequest:
    """Return a request; ValueError names what is wrong."""
    service, team = body.get('report'), body.get('team', '')
    if not isinstance(service, str) or service not in SERVICES:
        raise ValueError(f'report: allowed are {", ".join(SERVICES)}')
    if not (isinstance(team, str) and all(part.isidentifier() for part in team.split('/') if part)):
        raise ValueError('team: allowed is the namespace of a filter, or nothing')
    fields: dict[str, Any] = {}
    for name, kinds in SERVICES[service].items():
        value: Any = body.get(name, '' if name == 'source' else None)
        # In JSON true and false are no numbers.
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise ValueError(f'{name}: allowed is {_WORDS[kinds[-1]]}')
        fields[name] = _number(name, value) if kinds is _NUMBER else value
        if kinds is _TEXT and not _is_text(value):
            raise ValueError(f'{name}: allowed is text without control characters')
    if not 0 <= fields.get('id', 0) <= _LARGEST_ID:
        raise ValueError('id: allowed is the number of a found target')
    if 'position' in fields:
        at = fields['position']
        if len(at) != 2 or not all(type(value) in _NUMBER for value in at):
            raise ValueError(f'position: allowed is {_WORDS[list]}')
        fields['position'] = [_number('position', value) for value in at]
    return ReportRequest(service, team.strip('/'), fields)


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except OverflowError:
        raise ValueError(f'{name}: allowed is a number of at most 300 digits') from None


def _is_text(value: Any) -> bool:
    """Return whether a message can hold a text: neither NUL nor halves of characters."""
    return '\0' not in value and not any('\ud800' <= sign <= '\udfff' for sign in value)
