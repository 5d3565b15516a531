"""Outputs of a run other than the page: videos, and a layout for Foxglove."""

import json
import re
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from maasi_filter import colours
from maasi_sim.run.bag import load_types
from maasi_sim.run.facts import Ended, Left, PathPlanned, RobotAt, Said
from maasi_sim.run.missions import load_mission
from maasi_sim.run.rviz_view import shown_topics
from maasi_sim.run.view import video, view_run
from maasi_sim.run.view.event_log import EventLog
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.page_file import write_replay
from maasi_sim.run.view.recording import event_log
from maasi_sim.run.view.scene import scene_of
from maasi_sim.scenario.loading import config_folder
from maasi_sim.search import search


def frames(log, path, speed=1e3):
    """Return the pictures of a video without its end, as whole numbers: blue, green, red."""
    with patch.object(video, '_HOLD', 0.0):
        video.write_video(log, path, speed)
    shown, pictures = cv2.VideoCapture(str(path)), []
    while True:
        read, picture = shown.read()
        if not read:
            return pictures
        pictures.append(picture.astype(int))


BLUE = 0, 114, 178


def bluish(picture):
    return np.abs(picture.astype(int) - BLUE[::-1]).max(axis=2) < 40


def test_a_video_shows_the_run_move(tmp_path):
    unit = [0.01, 0.0, 0.0, 0.02, 0.0, 0.0]
    events = [
        [0.0, 'map', '', [0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [2, 2, 1], '0zgz', 0.4],
        [0.0, 'truth', '', [[1.0, 1.0, 0.0]]],
        [0.0, 'robot', 'mambo', [0.0, 0.0, 1.0, 0.0], 1.0, 1, ''],
        [0.0, 'way', 'mambo', [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]],
        [0.5, 'seen', 'mambo', [0.0, 0.0, 1.0], [[1.0, 0.5, 0.0, 0.1, 0.1, 0.0]]],
        [0.5, 'filter', '', 3.0, [[1.0, 1.0, 0.0, 0.5, *unit]], 1],
        [1.0, 'found', '', [[1, 1.0, 1.0, 0.0, unit, 'mambo', 1.0]]],
        [2.0, 'robot', 'mambo', [2.0, 2.0, 1.0, 0.5], 1.0, 1, ''],
    ]
    scene = scene_of('plane', load_mission('mambo_turtlebot_obstacles').scenario)
    path = tmp_path / 'run.gif'
    pictures = frames(EventLog(scene, events), path, speed=5.0)
    assert len(pictures) >= 2 and pictures[0].std() > 5.0
    assert np.abs(pictures[0] - pictures[-1]).max() > 100
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


def test_a_video_of_a_search_in_space(tmp_path):
    log = event_log(search(load_mission('ranging_drone_3d').scenario, 1), 'drone')
    pictures = frames(log, tmp_path / 'run.mp4', 10.0 * log.duration)
    assert pictures[0].shape == (576, 768, 3)
    # A tenth of a second.
    assert len(pictures) == 4 and np.abs(pictures[0] - pictures[-1]).max() > 100


def test_a_video_has_30_frames_a_second_a_legend_and_says_how_far_it_is(
    departing, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(view_run, 'read_events', lambda *_: departing)
    path = tmp_path / 'run.mp4'
    assert view_run.main([str(tmp_path), '--video', str(path), '--speed', '2']) == 0
    said = capsys.readouterr()
    assert said.out == f'{path}\n' and re.search(r'^run\.mp4: \d+ %$', said.err, re.MULTILINE)
    shown = cv2.VideoCapture(str(path))
    assert shown.get(cv2.CAP_PROP_FPS) == 30.0
    # 3 s twice as fast, and 2 s of the last picture.
    assert shown.get(cv2.CAP_PROP_FRAME_COUNT) == 46 + 60
    read, picture = shown.read()
    # Next to the map, whose frame is black, the robot, found and potential targets, in this order.
    frame = np.flatnonzero((picture[100:400] < 60).all(axis=2).mean(axis=0) > 0.9)[-1]
    rows = []
    for colour in (colours.robot_colours(['mambo'])['mambo'], colours.FOUND, colours.POTENTIAL):
        tint = np.array([*bytes.fromhex(colour[1:])][::-1])
        near = np.abs(picture[:, frame + 5 :].astype(int) - tint).max(axis=2) < 40
        assert read and near.sum() > 15, colour
        rows.append(np.flatnonzero(near.any(axis=1)).mean())
    assert rows == sorted(rows)


def test_a_video_shows_where_a_robot_points_what_it_sees_and_where_it_goes(tmp_path):
    scene = scene_of('plane', load_mission('mambo').scenario)
    robot = scene['robots']['mambo']

    def still(yaw=0.0, detections=(), tour=()):
        row = ['mambo', 0, 0, [2.0, 0.5, 1.0], [], '', list(tour)]
        events = [
            [0.0, 'robot', 'mambo', [0.5, 0.5, 1.0, yaw], 1.0, 1, ''],
            [0.0, 'seen', 'mambo', [0.5, 0.5, 1.0], detections],
            [0.0, 'plan', '', 'maasi', 0.0, 0.0, '', [row]],
        ]
        return frames(EventLog(scene, events), tmp_path / 'still.mp4')[0]

    whole = still()
    assert robot.pop('view')['kind'] == 'box'
    unseeing, turned = still(), still(2.0 * np.pi / 3.0)
    seeing = still(0.0, [[1.0, 0.5, 0.0, 0.1, 0.1, 0.0]])
    robot['fence'] = [[0.4, 2.0], [0.4, 2.0], [0.0, 2.0]]
    for other, least in ((whole, 20), (turned, 50), (seeing, 50), (still(), 50)):
        assert np.abs(unseeing - other).max() > least
    # A robot and its waypoint in the robot's colour, which is blue.
    assert np.diff(np.flatnonzero(bluish(unseeing).any(axis=0))).max() > 100
    # A thin line from the waypoint to where it goes next.
    del robot['fence']
    toured = still(tour=[[1.0, 1.5, 1.0]])
    assert np.abs(toured - still()).max(axis=2).any(axis=1).sum() > 100


@pytest.fixture
def departing():
    """Return a run whose robot is on its way at 1 s, and leaves at 2 s."""
    events = []
    maker = EventMaker(scene_of('plane', load_mission('mambo').scenario), events.append)
    for fact in (
        RobotAt(0.0, 'mambo', (0.5, 0.5, 1.0, 0.0)),
        PathPlanned(0.0, 'mambo', [(0.5, 0.5, 1.0), (2.0, 2.0, 1.0)]),
        RobotAt(1.0, 'mambo', (0.6, 0.6, 1.0, 0.0)),
        Left(2.0, 'mambo'),
        Said(3.0, 'team', 'team', 'continues'),
        Ended(3.0, 'node_died', '/filter_node was killed by SIGKILL'),
    ):
        maker.add(fact)
    return EventLog(maker.scene, events)


def test_a_robot_that_left_goes_nowhere_in_a_video(departing, tmp_path):
    pictures = frames(departing, tmp_path / 'run.mp4', speed=15.0)
    # The legend has a mark of its colour.
    legend = bluish(pictures[0])[:, 600:].sum()
    assert bluish(pictures[5]).sum() - legend < 0.1 * (bluish(pictures[3]).sum() - legend)


def test_a_robot_that_left_goes_nowhere_on_the_page(chromium, departing):
    with chromium() as shown:
        shown.show(departing.scene, *departing.events)
        pixels = []
        for seconds, text in ((1.5, 'moving'), (2.5, 'left')):
            shown.seek(seconds)
            assert shown.page.is_hidden('#card')
            assert shown.page.inner_text('#robots tr[data-robot=mambo] td.text') == text
            pixels.append(shown.near(BLUE).sum())
        assert pixels[1] < 0.1 * pixels[0]
        shown.page.click('#robots tr[data-robot=mambo]')
        shown.settle()
        assert shown.page.inner_text('#why_body') == 'mambo has left.'
        shown.seek(9.0)
        shown.until("document.querySelector('#headline').textContent.startsWith('Ended')")
        words = 'Ended: filter_node was killed by SIGKILL; 0 of 12 found after 3 s'
        assert shown.page.inner_text('#headline') == words
        assert words in shown.page.inner_text('#card')
        shown.page.click('#card button')
        shown.settle()
        assert shown.page.is_hidden('#card')


@pytest.fixture(scope='module')
def searched(tmp_path_factory):
    """Return the replay of a search with a robot that leaves, and its log."""
    scenario = load_mission('mambo_turtlebot').scenario
    content = {**scenario.content(), 'events': [{'at': 8.0, 'robot': 'mambo', 'do': 'leave'}]}
    log = event_log(search(type(scenario).model_validate(content), 901, 120))
    path = tmp_path_factory.mktemp('searched') / 'page.html'
    write_replay(log, path)
    return path, log


def test_a_replay_plays_by_itself_and_says_what_happens_to_its_end(chromium, searched):
    with chromium(reduced_motion='no-preference') as shown:
        shown.open(searched[0].as_uri())
        shown.until('maasi.playing && maasi.time > 0.5')
        # No headline is read aloud before the previous one has ended.
        shown.page.evaluate(
            'window.changes = []; const heading = document.querySelector("#headline");'
            'new MutationObserver(() => changes.push(Number(heading.dataset.since)))'
            '.observe(heading, {childList: true})'
        )
        shown.until('!maasi.playing')
        shown.until("document.querySelector('#headline').textContent.startsWith('Ended')")
        changes = shown.page.evaluate('changes')
        assert len(changes) > 1 and np.diff(changes).min() >= 1000
        states = shown.page.locator('#robots td.text').all_inner_texts()
        assert states == ['left', 'run ended']


def test_the_page_says_why_in_a_sentence_and_what_is_at_a_point_of_the_map(chromium, searched):
    path, log = searched
    decision = next(event for event in log.events if event[1] == 'plan')[7][0]
    name, _, chosen, waypoint, candidates, *_ = decision
    with chromium() as shown:
        page = shown.page
        shown.open(path.as_uri())
        assert page.evaluate('maasi.time') == 0.0 and not page.evaluate('maasi.playing')
        shown.seek(0.5)
        heading = "document.querySelector('#headline').textContent"
        shown.until(f'/^Searching: 0 of 12 found, .* goes to the /.test({heading})')
        page.click(f'#robots tr[data-robot={name}]')
        shown.settle()
        assert f'expects {candidates[chosen][5]:.3g} new targets' in page.inner_text('.expects')
        assert not page.is_visible('#why table')
        page.click('#why summary')
        sides = 'Array.from(document.querySelectorAll("#why {}")).map(c => Math.round('
        sides += 'c.getBoundingClientRect().right - parseFloat(getComputedStyle(c).paddingRight)))'
        heads, cells = (page.evaluate(sides.format(part)) for part in ('th', 'tr.chosen td'))
        assert heads == cells

        assert shown.tip(*waypoint).startswith(f'candidate {chosen} at (')
        robot = page.evaluate('maasi.log.at("robot", "mambo", 0.5)[3]')
        assert shown.tip(*robot).startswith('mambo: moving')
        page.keyboard.press('Escape')
        assert shown.tip(-0.25, 2.35) == (
            'explored 0 %, 1.65 expected targets per m² left, at (-0.25, 2.35) m'
        )
        found = next(event for event in log.events if event[1] == 'found' and event[3])
        shown.seek(found[0])
        number, x, y, *_ = found[3][0]
        assert shown.tip(x, y).startswith(f'target {number}: found by ')


def test_on_a_phone_in_the_dark_the_legend_is_whole_and_it_plays_by_the_space_bar(
    chromium, searched
):
    with chromium(390, 844, color_scheme='dark', has_touch=True) as shown:
        page = shown.page
        shown.open(searched[0].as_uri())
        assert page.get_attribute('html', 'data-theme') == 'dark'
        page.evaluate('maasi.select("turtlebot")')
        shown.settle()
        text = page.inner_text('#legend')
        for entry in ('explored', 'planned path', 'path so far', 'waypoint', 'found', 'candidate'):
            assert entry in text
        map_, legend = (page.locator(part).bounding_box() for part in ('#map', '#legend'))
        assert legend['y'] >= map_['y'] + map_['height'] and legend['height'] > 20
        order = []
        page.click('#why summary')
        page.locator('#theme').focus()
        while 'candidate' not in order and len(order) < 40:
            page.keyboard.press('Tab')
            order.append(
                page.evaluate(
                    'document.activeElement.closest("#why table") ? "candidate" :'
                    ' document.activeElement.id'
                )
            )
        assert order.index('play') < order.index('candidate')
        page.select_option('#speed', '20')
        page.locator('#map').focus()
        page.keyboard.press(' ')
        shown.until('maasi.time > 1.0')
        page.keyboard.press(' ')
        shown.settle()
        flat = page.locator('#map').screenshot()
        page.tap('#space')
        shown.settle()
        assert page.locator('#map').screenshot() != flat
        # Nothing is wider than the phone.
        assert page.evaluate('document.documentElement.scrollWidth') <= 390


def contrast(*colours):
    """Return the contrast of two colours of three numbers up to 255, as WCAG 2 has it."""
    shares = np.array(colours, dtype=float) / 255.0
    linear = np.where(shares <= 0.03928, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    dark, bright = np.sort(linear @ (0.2126, 0.7152, 0.0722))
    return (bright + 0.05) / (dark + 0.05)


@pytest.mark.parametrize('theme', ['light', 'dark'])
def test_texts_and_robots_stand_out(chromium, searched, theme):
    style = 'getComputedStyle(document.documentElement).getPropertyValue("--{}").trim()'
    swatches = '[...document.querySelectorAll("#robots .swatch")].map((s) => s.style.background)'
    with chromium(color_scheme=theme) as shown:
        shown.open(searched[0].as_uri())

        def of(name):
            text = shown.page.evaluate(style.format(name))
            digits = re.findall(r'\d+', text) if ',' in text else bytes.fromhex(text[1:])
            return np.array([int(value) for value in digits])

        for text in ('text', 'quiet', 'fault', 'warning'):
            for ground in ('back', 'panel'):
                assert contrast(of(text), of(ground)) >= 4.5, (text, ground)
        # As opaque as a cell that is wholly unexplored.
        grey = of('floor') + 135 / 255 * (of('unseen') - of('floor'))
        tints = shown.page.evaluate(swatches)
        assert len(tints) == 2
        for tint in tints:
            assert contrast([int(value) for value in re.findall(r'\d+', tint)], grey) >= 3.0


def test_a_video_of_another_kind_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        view_run.main([str(tmp_path), '--video', 'run.avi'])
    assert 'allowed are FILE.mp4 and FILE.gif' in capsys.readouterr().err


def test_foxglove_shows_each_panel_once_fields_of_our_messages_and_the_topics_of_rviz():
    layout = json.loads((config_folder() / 'foxglove' / 'search.json').read_text())
    panels = layout['configById']
    assert sorted(re.findall(r'"(\w+!\w+)"', json.dumps(layout['layout']))) == sorted(panels)
    types = {'/filter_update': 'FilterUpdate', '/decisions': 'PlanDecision'}
    paths = [item['value'] for item in panels['Plot!found']['paths']]
    paths.append(panels['RawMessages!decisions']['topicPath'].removesuffix('[:]'))
    for path in paths:
        topic, _, field = path.partition('.')
        fields = load_types().fielddefs[f'maasi_msgs/msg/{types[topic]}'][1]
        assert field in [name for name, _ in fields], path
    files = (config_folder() / 'rviz').glob('*.rviz')
    known = {topic for path in files for topic in shown_topics(path)}
    assert set(panels['3D!search']['topics']) - {'/search_area'} <= known
