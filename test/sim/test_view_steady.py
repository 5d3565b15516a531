"""What keeps still on the page, and what is the same on page and report: counts, sizes, icons."""

from contextlib import closing

import numpy as np
import pytest

from maasi_filter.records import FoundTarget
from maasi_sim.run.facts import Ended, Found, RobotAt, Truth
from maasi_sim.run.missions import load_mission
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.page_file import FOLDER
from maasi_sim.run.view.scene import scene_of
from maasi_sim.run.view.server import Hub, ViewServer

CAMERA = (
    '(({centre, scale, width, height}) => JSON.stringify([centre, scale, width, height]))'
    '(maasi.camera)'
)


def ended(scene, found, truth):
    """Return scene and events of a run that finds something at 1 s and ends at 4 s."""
    events = []
    maker = EventMaker(scene, events.append)
    for fact in (
        RobotAt(0.0, 'mambo', (0.5, 0.5, 1.0, 0.0), 0.8),
        RobotAt(0.0, 'turtlebot', (1.5, 0.5, 0.0, 0.0), 0.6),
        Truth(0.0, truth),
        Found(1.0, '', found, 0),
        RobotAt(4.0, 'mambo', (0.6, 0.5, 1.0, 0.0), 0.7),
        Ended(4.0, 'time_limit', 'the limit of 4 s'),
    ):
        maker.add(fact)
    return maker.scene, *events


@pytest.fixture
def run():
    scenario = load_mission('mambo_turtlebot').scenario
    truth = np.array([[1.0, 1.0], [2.0, 2.0]])
    found = [
        FoundTarget(number, np.array(place), 1e-4 * np.eye(2), 'mambo', 0, 1.0)
        for number, place in enumerate(([1.0, 1.0], [0.3, 1.7]))
    ]
    scene = scene_of('demo', scenario) | {'targets': 2, 'scoring_radius': 0.2}
    return ended(scene, found, truth)


def test_the_end_card_and_the_legend_do_not_move_the_map(chromium, run):
    with chromium() as shown:
        shown.show(*run)
        seen = []
        for time in (0.5, 2.0, 4.0):
            shown.seek(time)
            seen.append(shown.page.evaluate(CAMERA))
        assert shown.page.is_visible('#card')
        shown.page.evaluate('maasi.select("mambo")')
        shown.page.click('button[data-layer=left]')
        shown.settle()
        assert {*seen, shown.page.evaluate(CAMERA)} == {seen[0]}


def test_a_stop_and_its_answer_do_not_move_the_map(chromium):
    scene = {'name': 'test', 'robots': {}, 'bounds': [[0, 1], [0, 1]], 'control': True}
    answer = 'stop: rover; ' + 'a long story, ' * 20
    hub = Hub(scene)
    made = ViewServer(hub, 0, commander=lambda command, robot: (True, answer))
    with closing(made) as server, chromium() as shown:
        hub.put([0.0, 'robot', 'rover', [0.5, 0.5, 0.0, 0.0], 1.0, 1, ''])
        shown.open(server.address)
        shown.until('maasi.fitted')
        shown.settle()
        before = shown.page.evaluate(CAMERA)
        shown.page.click('button[data-command=stop]')
        shown.until("document.querySelector('#controls [role=status]').innerText.includes('story')")
        hub.put(
            [1.0, 'robot', 'rover', [0.5, 0.5, 0.0, 0.0], 1.0, 5, 'stopped by the service stop']
        )
        shown.until("document.querySelector('#robots td.text').textContent.includes('stopped')")
        shown.settle()
        assert shown.page.evaluate(CAMERA) == before


def test_true_targets_count_and_missed_is_said_of_an_ended_search_only(chromium, run):
    with chromium() as shown:
        shown.show(*run)
        shown.seek(2.0)
        assert shown.page.inner_text('#found_count') == '1 of 2 (1 false)'
        counts = shown.page.text_content('#counts')
        assert 'not found yet' in counts and 'missed' not in counts and 'GOSPA' in counts
        assert not shown.page.is_visible('#counts')
        order = shown.page.locator('#numbers dt').all_inner_texts()
        assert order == ['found', 'time', 'lowest battery']
        assert shown.page.inner_text('#numbers dd >> nth=2') == '60 % (turtlebot)'
        shown.seek(4.0)
        assert 'missed' in shown.page.text_content('#counts')
        shown.until("document.querySelector('#headline').textContent.startsWith('Ended')")
        assert '1 of 2 (1 false) found after 4 s' in shown.page.inner_text('#headline')


def test_icons_are_drawn():
    for path in FOLDER.iterdir():
        text = path.read_text(encoding='utf-8')
        signs = {sign for sign in text if ord(sign) > 0x2100}
        assert not signs, path.name
        assert '&#x2' not in text, path.name


def test_robots_have_one_size_whatever_their_radius(chromium):
    sizes = {}
    for radius in (0.05, 0.4):
        robots = {'rover': {'radius': radius, 'flies': False}}
        scene = {'name': 'plane', 'robots': robots, 'bounds': [[0, 4], [0, 4]]}
        state = [0.0, 'robot', 'rover', [2.2, 2.3, 0.0, 0.0], 1.0, 0, '']
        with chromium() as shown:
            shown.show(scene, state)
            shown.seek(0.0)
            sizes[radius] = int(shown.near((0, 114, 178), 60).sum())
    assert sizes[0.05] == sizes[0.4] > 60
