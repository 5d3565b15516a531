"""Documents: short lines, and no link, path or name that leads nowhere."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').rglob('*.md'))]
COLUMNS = 120
# Folders at the root: what begins with one of them in backticks is a path in this repository.
FOLDERS = (
    'config',
    'docs',
    'examples',
    'maasi_msgs',
    'maasi_filter',
    'maasi_planner',
    'maasi_drivers',
    'maasi_sim',
    'scripts',
    'test',
)
# Names of ROS packages and of executables or types in them, not paths.
NOT_PATHS = re.compile(r'maasi_msgs/(msg/|action/)?[A-Z]\w*$')

documents = pytest.mark.parametrize(
    'document', DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix()
)


def text_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line outside of code blocks."""
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.lstrip().startswith('```'):
            fenced = not fenced
        elif not fenced and not line.startswith('    '):
            yield number, line


def long_lines(text: str) -> list[int]:
    """Return the numbers of lines that are too long and can be wrapped: no tables, no code."""
    return [
        number
        for number, line in text_lines(text)
        if len(line) >= COLUMNS and not line.lstrip().startswith('|') and ' ' in line.strip()
    ]


def anchors(text: str) -> set[str]:
    """Return the anchors that GitHub makes of headings."""
    headings = re.findall(r'^#+ (.*)$', text, re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', head.lower()).strip().replace(' ', '-') for head in headings}


def dead_links(text: str, folder: Path) -> list[str]:
    """Return the relative links whose file or heading does not exist."""
    dead = []
    for link in re.findall(r'\]\(([^)\s]+)\)', text):
        if re.match(r'\w+:', link):
            continue
        name, _, anchor = link.partition('#')
        path = folder / name
        if not path.exists():
            dead.append(link)
        elif anchor:
            known = anchors(path.read_text() if name else text)
            dead += [] if anchor in known else [link]
    return dead


def dead_paths(text: str) -> list[str]:
    """Return the paths in backticks that do not exist."""
    dead = []
    for quoted in re.findall(r'`([^`\n]+)`', text):
        path = quoted.removeprefix('./').split(' ')[0].rstrip('/')
        if not re.fullmatch(r'[\w./*-]+', path) or '/' not in path:
            continue
        if path.split('/')[0] in FOLDERS and not NOT_PATHS.match(path) and not any(ROOT.glob(path)):
            dead.append(quoted)
    return dead


@documents
def test_lines_are_short(document: Path) -> None:
    assert long_lines(document.read_text()) == []


@documents
def test_links_and_paths_exist(document: Path) -> None:
    text = document.read_text()
    assert dead_links(text, document.parent) == []
    assert dead_paths(text) == []


def test_what_is_wrong_is_found(tmp_path: Path) -> None:
    (tmp_path / 'there.md').write_text('# A heading: here\n')
    text = '# Here\n[a](there.md#a-heading-here) [b](#here) [c](https://x.org/y)\n'
    assert dead_links(text, tmp_path) == []
    text = '[a](gone.md) [b](there.md#gone) [c](#gone)\n'
    assert dead_links(text, tmp_path) == ['gone.md', 'there.md#gone', '#gone']
    text = '`test/test_documents.py` `./scripts/test -k x` `docs/` `maasi_msgs/Detection` `a/b`\n'
    assert dead_paths(text + '`test/gone.py` `./scripts/gone`\n') == [
        'test/gone.py',
        './scripts/gone',
    ]
    long = 'word ' * 30
    assert long_lines(f'{long}\n| {long} |\n    {long}\n```\n{long}\n```\n- {long}\n') == [1, 7]


def table_rows(text: str, heading: str) -> list[list[str]]:
    """Return the cells of the table under a heading, without its head."""
    section = text.split(f'## {heading}\n')[1].split('\n## ')[0]
    rows = [line for line in section.splitlines() if line.startswith('|')][2:]
    return [[cell.strip() for cell in row.strip('|').split('|')] for row in rows]


def test_each_room_is_described_and_each_described_room_exists() -> None:
    text = (ROOT / 'docs' / 'architecture.md').read_text()
    described = {row[0].strip('`') for row in table_rows(text, 'Rooms')}
    rooms = {
        path.parent.relative_to(ROOT).as_posix()
        for folder in FOLDERS
        for path in ROOT.glob(f'{folder}/*/**/__init__.py')
        if folder.startswith('maasi_')
    }
    assert rooms <= described
    assert all((ROOT / room).is_dir() for room in described)


def test_names_of_the_glossary_stand_in_their_files() -> None:
    text = (ROOT / 'docs' / 'architecture.md').read_text()
    rows = table_rows(text, 'Glossary')
    assert rows
    for _, _, names, files in rows:
        paths = re.findall(r'`([^`]+)`', files)
        sources = '\n'.join((ROOT / path).read_text() for path in paths)
        for name in re.findall(r'`([^`]+)`', names):
            assert re.search(rf'\b{name}\b', sources), f'{name} is not in {files}'


def test_numbers_of_the_claims_are_those_of_the_experiments() -> None:
    whole = (ROOT / 'docs' / 'reproduction.md').read_text()
    rows = [
        line
        for line in (ROOT / 'docs' / 'claims.md').read_text().splitlines()
        if line.startswith('|') and 'reproduction.md#' in line
    ]
    assert len(rows) > 10
    for row in rows:
        measured, place = row.strip('|').split('|')[2:]
        section = whole.split(f'\n### {place.partition("#")[2].rstrip(") ")}\n')[1]
        section = section.partition('\n### ')[0]
        numbers = re.findall(r'[-+]?[\d.]+ ± [\d.]+', measured)
        assert numbers
        for number in numbers:
            assert re.search(rf'(\| |<br>|difference ){re.escape(number)}(\D|$)', section), number
