"""Tables of pages in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ['| ' + ' | '.join(head) + ' |', '|---' * len(head) + '|']
    for row in rows:
        lines.append('| ' + ' | '.join(cell.replace('|', r'\|') for cell in row) + ' |')
    return '\n'.join(lines) + '\n'


def code(value: Any) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return f'`{text}`' if text else "`''`"
