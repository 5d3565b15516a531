"""Documents: short lines, and no link, path or name that leads nowhere."""

import re
from pathlib import Path

import pytest

from maasi_sim.experiments.outputs import claims_text, stored_section
from maasi_sim.experiments.papers import experiments

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').rglob('*.md'))]
COLUMNS = 120
# Folders at the root: what begins with one of them in backticks is a path in this repository.
PACKAGES = ('maasi_msgs', 'maasi_filter', 'maasi_planner', 'maasi_drivers', 'maasi_sim')
FOLDERS = ('config', 'docs', 'examples', *PACKAGES, 'scripts', 'test')
# Names of ROS packages and of executables or types in them, not paths.
NOT_PATHS = re.compile(r'maasi_msgs/(msg/|action/)?[A-Z]\w*$')


def long_lines(text):
    """Return the numbers of lines that are too long and can be wrapped: no tables, no code."""
    long, fenced = [], False
    for number, line in enumerate(text.splitlines(), 1):
        fenced ^= line.lstrip().startswith('```')
        table = line.lstrip().startswith(('|', '```')) or line.startswith('    ')
        if len(line) >= COLUMNS and ' ' in line.strip() and not (fenced or table):
            long.append(number)
    return long


def anchors(text):
    """Return the anchors that GitHub makes of headings."""
    headings = re.findall(r'^#+ (.*)$', text, re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', head.lower()).strip().replace(' ', '-') for head in headings}


def dead_links(text, folder):
    dead = []
    for link in re.findall(r'\]\((?!\w+:)([^)\s]+)\)', text):
        name, _, anchor = link.partition('#')
        there = (folder / name).exists()
        if not there or (
            anchor and anchor not in anchors((folder / name).read_text() if name else text)
        ):
            dead.append(link)
    return dead


def dead_paths(text):
    dead = []
    for quoted in re.findall(r'`([^`\n]+)`', text):
        path = quoted.removeprefix('./').split(' ')[0].rstrip('/')
        ours = re.fullmatch(r'[\w.*-]+(/[\w.*-]+)+', path) and path.split('/')[0] in FOLDERS
        if ours and not NOT_PATHS.match(path) and not any(ROOT.glob(path)):
            dead.append(quoted)
    return dead


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_lines_are_short_and_links_and_paths_exist(document):
    text = document.read_text()
    assert (long_lines(text), dead_links(text, document.parent), dead_paths(text)) == ([], [], [])


def table_rows(heading):
    """Return the cells of the table under a heading of the architecture, without its head."""
    section = (ROOT / 'docs' / 'architecture.md').read_text().split(f'## {heading}\n')[1]
    rows = [line for line in section.split('\n## ')[0].splitlines() if line.startswith('|')][2:]
    assert rows
    return [[cell.strip() for cell in row.strip('|').split('|')] for row in rows]


def test_each_package_is_described_and_each_described_folder_exists():
    described = {row[0].strip('`') for row in table_rows('Folders')}
    inits = [path for name in PACKAGES for path in ROOT.glob(f'{name}/*/**/__init__.py')]
    assert {path.parent.relative_to(ROOT).as_posix() for path in inits} <= described
    assert all((ROOT / folder).is_dir() for folder in described)


def test_names_of_the_glossary_stand_in_their_files():
    for _, _, names, files in table_rows('Glossary'):
        sources = '\n'.join((ROOT / path).read_text() for path in re.findall(r'`([^`]+)`', files))
        for name in re.findall(r'`([^`]+)`', names):
            assert re.search(rf'\b{name}\b', sources), f'{name} is not in {files}'


def test_tests_that_documents_name_exist():
    files = [*ROOT.glob('test/**/*.py'), *ROOT.glob('maasi_*/test/*.py')]
    known = {path.stem for path in files}
    known |= {name for path in files for name in re.findall(r'def (test_\w+)', path.read_text())}
    for document in DOCUMENTS:
        named = set(re.findall(r'\btest_[a-z0-9_]+', document.read_text()))
        assert named <= known, document


def follows(page):
    """Return whether the page of claims is what the stored experiments say."""
    folder = ROOT / 'docs' / 'reproduction'
    stored = {name: stored_section(folder / f'{name}.json') for name in experiments()}
    found = {name: section.claims for name, section in stored.items() if section is not None}
    # What was run when is not stored.
    same = [text.replace(' (earlier) |', ' |') for text in (page, claims_text(found))]
    return same[0] == same[1]


def test_claims_and_their_summary_follow_from_the_stored_experiments():
    page = (ROOT / 'docs' / 'claims.md').read_text()
    assert follows(page)
    assert not follows(page.replace('| 000 |', '| 100 |'))


def test_the_readme_fits_on_a_screen_and_has_the_words_that_people_search_for():
    text = (ROOT / 'README.md').read_text()
    assert len(text.splitlines()) <= 120
    for words in (
        *('search and rescue', 'multi-robot search', 'probability of area', 'semantic map'),
        *('multi-object tracking', 'geolocation of detections', 'ROS 2'),
    ):
        assert words in text, words
