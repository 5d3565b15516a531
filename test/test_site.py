"""The documentation site: built without a warning, complete, and without the network.

The API reference is left out here, as it takes minutes: ./scripts/docs builds it too.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

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
