"""Tables of an earlier page, kept for experiments and cases that have no runs in the folder."""

from __future__ import annotations

import re
from dataclasses import dataclass

EARLIER = 'from an earlier campaign'
EARLIER_ROW = '(earlier)'
_SECTION = re.compile(r'^### (\S+)$', re.MULTILINE)
_RESTS = re.compile(r'Rests on (.+?)\.( A run takes about .+?\.)?$')


@dataclass(frozen=True)
class Earlier:
    """Results of an experiment on an earlier page.

    Attributes
    ----------
    rests : str
        Number of runs in words, marked as of an earlier campaign.
    duration : str
        Time of a run in words, or ''.
    tables : str
        The tables in Markdown.
    """

    rests: str
    duration: str
    tables: str


def earlier_sections(text: str) -> dict[str, Earlier]:
    """Return the experiments on a page by name, without those that have no table."""
    parts = _SECTION.split(text)
    found = {}
    for name, body in zip(parts[1::2], parts[2::2]):
        rests = _RESTS.search(' '.join(body.strip().partition('\n\n')[0].split()))
        lines = body[: body.find('\n## ')] if '\n## ' in body else body
        tables = _tables(lines)
        if rests is None or not tables:
            continue
        words = rests.group(1)
        if EARLIER not in words:
            words += f', {EARLIER}'
        found[name] = Earlier(words, rests.group(2) or '', tables)
    return found


def _tables(body: str) -> str:
    """Return the first tables of a section: blocks of rows with one empty line between them."""
    rows: list[str] = []
    begun = False
    for line in body.splitlines():
        if line.startswith('|'):
            begun = True
        elif begun and line:
            break
        if begun:
            rows.append(line)
    return '\n'.join(rows).rstrip('\n') + '\n' if rows else ''


def completed(tables: str, earlier: str) -> str:
    """Return new tables, completed with rows of an earlier page that are marked as such.

    Parameters
    ----------
    tables : str
        Of the runs in the folder, in Markdown.
    earlier : str
        Of the earlier page.
    """
    blocks = [block.splitlines() for block in tables.strip().split('\n\n')]
    for block in (item.splitlines() for item in earlier.strip().split('\n\n')):
        head = _cells(block[0])[0]
        new = next((item for item in blocks if _cells(item[0])[0] == head), None)
        if new is None:
            # Paired differences have a table of their own.
            new = block[:2]
            blocks.append(new)
        known = {_key(row, head) for row in new[2:]}
        new += [_marked(row) for row in block[2:] if _key(row, head) not in known]
    return '\n\n'.join('\n'.join(block) for block in blocks if len(block) > 2) + '\n'


def _cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip().strip('|').split('|')]


def _key(row: str, head: str) -> tuple[str, ...]:
    """Return the key of a row: the case; of paired differences the quantity as well."""
    cells = _cells(row)
    return (cells[0],) if head == 'case' else (cells[0], cells[1])


def _marked(row: str) -> str:
    cells = _cells(row)
    if not cells[2].endswith(EARLIER_ROW):
        cells[2] += f' {EARLIER_ROW}'
    return f'| {" | ".join(cells)} |'
