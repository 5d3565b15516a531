"""Writes the fields of `report.json`, as its JSON Schema has them, into docs/report.md."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / 'docs' / 'report.md'
SCHEMA = ROOT / 'maasi_sim' / 'maasi_sim' / 'run' / 'report.schema.json'
BEGIN, END = '<!-- fields: begin -->', '<!-- fields: end -->'


def with_fields(page: str) -> str:
    """Return a page in Markdown with tables of all fields between its marks."""
    before, rest = page.split(BEGIN)
    parts = []
    tables = {
        kind['description']: [
            f'| `{name}` | {_type(part)} | {part.get("description", "")} |'
            for name, part in _fields(kind, '')
        ]
        for kind in json.loads(SCHEMA.read_text(encoding='utf-8'))['oneOf']
    }
    first, *others = tables.values()
    both = [row for row in first if all(row in rows for rows in others)]
    for title, rows in [('Of both kinds', both), *tables.items()]:
        parts.append(f'### {title}\n\n| field | type | meaning |\n|---|---|---|')
        parts += [row for row in rows if rows is both or row not in both] + ['']
    fields = '\n'.join(parts)
    return f'{before}{BEGIN}\n{fields}{END}{rest.split(END)[1]}'


def _fields(part: dict[str, Any], prefix: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the fields of an object with those inside of it, by their paths."""
    for name, inner in part.get('properties', {}).items():
        path = prefix + name
        yield path, inner
        choices = inner.get('oneOf', [inner])
        for choice in choices:
            yield from _fields(choice, f'{path}.')
            yield from _fields(choice.get('items', {}), f'{path}[].')


def _type(part: dict[str, Any]) -> str:
    if 'const' in part:
        return json.dumps(part['const'])
    if 'enum' in part:
        return ', '.join(part['enum'])
    if 'oneOf' in part:
        return ' or '.join(_type(choice) for choice in part['oneOf'])
    kind = part['type']
    if isinstance(kind, list):
        return ' or '.join(kind)
    if kind == 'array':
        return f'array of {_type(part["items"])}'
    if kind == 'object' and isinstance(part.get('additionalProperties'), dict):
        return f'object: name to {_type(part["additionalProperties"])}'
    return str(kind)


if __name__ == '__main__':
    PAGE.write_text(with_fields(PAGE.read_text(encoding='utf-8')), encoding='utf-8')
