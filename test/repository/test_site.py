"""The documentation site, without the API reference: no warning, complete, and no network."""

import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from browsers import chromium, needs_chromium

from maasi_sim.run.buildings.scenario import load_cuboid_scenario
from maasi_sim.scenario.loading import load_scenario

ROOT = Path(__file__).resolve().parents[2]
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
    assert 'field.gif' in contents
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
        ('parameters', ['planner_node', 'robot.NAME.candidates.grid', 'at least 1']),
        ('messages', ['PlanDecision', 'share of the environment that is explored']),
    ],
)
def test_reference_is_made_from_the_code(site: Path, page: str, words: list[str]) -> None:
    html = (site / 'reference' / f'{page}.html').read_text()
    text = re.sub(r'<[^>]+>', '', html)
    for word in words:
        assert word in text


def keys(value: object, path: str) -> Iterator[str]:
    """Yield the keys of a scenario as the page of keys writes them."""
    if isinstance(value, dict) and not path.endswith(('.parameters', '.settings')):
        for key, part in value.items():
            yield from keys(
                part, f'{path}.NAME' if path == 'robots' else f'{path}.{key}'.strip('.')
            )
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        yield from keys(value[0], f'{path}[]')
    else:
        yield path


def test_page_of_keys_is_that_of_the_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(SITE)
    module = runpy.run_path(str(SITE / 'scenario_keys.py'))
    page = module['PAGE'].read_text(encoding='utf-8')
    assert module['page']() == page, 'call ./scripts/docs --write'
    assert '\n| `time` | number [s] | `600.0` | above 0 | ' in page
    written, place = set(), ''
    for line in page.splitlines():
        if line.startswith('#'):
            place = re.sub(' of [a-z_,: ]+$', '', line).partition('### ')[2]
        elif found := re.match(r'\| `(\w+)` ', line):
            written.add(f'{place}.{found[1]}'.strip('.'))
    folder = ROOT / 'config' / 'scenarios'
    for scenario in (
        load_scenario('mambo_turtlebot_obstacles'),
        load_cuboid_scenario(folder / 'buildings_four.yaml'),
    ):
        # Zones of both kinds are described once.
        zones = 'environment.obstacles[]', 'environment.keep_outs[]'
        asked = {key.replace(*zones) for key in keys(scenario.content(), '')}
        assert len(asked) > 50 and asked <= written, asked - written


def test_page_of_commands_is_that_of_the_parsers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(SITE)
    module = runpy.run_path(str(SITE / 'commands.py'))
    page = module['PAGE'].read_text(encoding='utf-8')
    assert module['page']() == page, 'call ./scripts/docs --write'
    for command in (ROOT / 'scripts').iterdir():
        if command.is_file() and not command.suffix:
            assert f'`./scripts/{command.name}`' in page, command


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
        for door in page.locator('.doors a').all():
            assert (site / str(door.get_attribute('href'))).is_file()
        assert page.locator('.doors a').count() == 4
        page.fill('input[name=q]', 'nearest_widest')
        page.press('input[name=q]', 'Enter')
        found = '#search-results a:has-text("Planners and robot models")'
        page.wait_for_selector(found)
        scores = "['api/a', 'planners'].map((name) => Scorer.score([name, '', '', '', 20, '']))"
        of_api, of_page = page.evaluate(scores)
        assert of_api < 0 < of_page
        page.click(found)
        page.wait_for_selector('h1:has-text("Planners and robot models")')
