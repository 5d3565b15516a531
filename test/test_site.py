"""The documentation site: built without a warning, complete, and without the network.

The API reference is left out here, as it takes minutes: ./scripts/docs builds it too.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from browsers import chromium, needs_chromium

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / 'docs' / 'site'


@pytest.fixture(scope='module')
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source, built = tmp_path_factory.mktemp('pages'), tmp_path_factory.mktemp('site')
    for command in (
        [str(SITE / 'pages.py'), str(source)],
        ['-m', 'sphinx', '-q', '-W', '--keep-going', '-c', str(SITE), str(source), str(built)],
    ):
        done = subprocess.run([sys.executable, *command], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    return built


def test_every_page_is_in_the_contents_and_needs_no_network(site: Path) -> None:
    loaded = r'<(?:script|link|img)\b[^>]*\b(?:src|href)="(?:https?:)?//'
    assert [page.name for page in site.rglob('*.html') if re.search(loaded, page.read_text())] == []
    contents = (site / 'index.html').read_text()
    assert 'view.png' in contents
    words = re.sub(r'<[^>]+>', '', contents)
    assert './scripts/demo --view\n' in words
    assert 'Copyright' not in words and '©' not in words
    pages = [page.relative_to(ROOT / 'docs') for page in (ROOT / 'docs').rglob('*.md')]
    assert Path('tutorials/student.md') in pages
    for page in pages:
        assert f'href="{page.with_suffix(".html")}"' in contents, page


@pytest.mark.parametrize(
    ('page', 'words'),
    [
        ('scenario', ['robots.NAME.sensor.detection.probability', 'limits.time', 'needed']),
        ('parameters', ['planner_node', 'robot.NAME.candidates.grid', 'at least 1']),
        ('messages', ['PlanDecision', 'share of the environment that is explored']),
        ('commands', ['--lockstep', 'a node died or hung', 'reproduce']),
    ],
)
def test_reference_is_made_from_the_code(site: Path, page: str, words: list[str]) -> None:
    html = (site / 'reference' / f'{page}.html').read_text()
    text = re.sub(r'<[^>]+>', '', html)
    for word in words:
        assert word in text


@needs_chromium
def test_pages_from_files_fit_a_phone_are_dark_at_night_and_found(site: Path) -> None:
    with chromium(390, 844, color_scheme='dark') as shown:
        page = shown.page
        for file in site.rglob('*.html'):
            page.goto(file.as_uri())
            assert page.evaluate('document.documentElement.scrollWidth') <= 390, file
        page.goto((site / 'planners.html').as_uri())
        table = page.locator('.table-wrapper').first
        room, needed = table.evaluate('(part) => [part.clientWidth, part.scrollWidth]')
        assert room < needed
        grounds = page.evaluate('getComputedStyle(document.body).backgroundColor')
        assert max(map(int, re.findall(r'\d+', grounds))) < 64
    with chromium() as shown:
        page = shown.page
        page.goto((site / 'index.html').as_uri())
        assert page.locator('button.copybtn').count() == 2
        page.fill('input[name=q]', 'nearest_widest')
        page.press('input[name=q]', 'Enter')
        page.click('#search-results a:has-text("Planners and robot models")')
        page.wait_for_selector('h1:has-text("Planners and robot models")')
