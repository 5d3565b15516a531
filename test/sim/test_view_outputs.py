"""What is made of a run beside the page: videos, and a layout for Foxglove."""

import base64
import json
import re

import cv2
import numpy as np
import pytest
from browsers import chromium, needs_chromium

from maasi_sim.run.bag import load_types
from maasi_sim.run.buildings.picture import NAMED
from maasi_sim.run.missions import load_mission
from maasi_sim.run.rviz_view import shown_topics
from maasi_sim.run.view import video
from maasi_sim.run.view.event_log import EventLog
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.page_file import FOLDER, write_replay
from maasi_sim.run.view.scene import scene_of
from maasi_sim.run.view.video import write_video
from maasi_sim.run.view.view_run import main
from maasi_sim.scenario.loading import config_folder
from maasi_sim.search import search


def frames(log, path, speed=1e3):
    """Return the pictures of a video, as whole numbers in the order blue, green, red."""
    write_video(log, path, speed)
    shown, pictures = cv2.VideoCapture(str(path)), []
    while True:
        read, picture = shown.read()
        if not read:
            return pictures
        pictures.append(picture.astype(int))


def bluish(picture):
    return np.abs(picture.astype(int) - (178, 114, 0)).max(axis=2) < 40


@pytest.mark.parametrize('suffix', ['.mp4', '.gif'])
def test_a_video_shows_the_run_move(tmp_path, suffix):
    unit = [0.01, 0.0, 0.0, 0.02, 0.0, 0.0]
    events = [
        [0.0, 'map', '', [0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [2, 2, 1], '0949', 0.4],
        [0.0, 'truth', '', [[1.0, 1.0, 0.0]]],
        [0.0, 'robot', 'mambo', [0.0, 0.0, 1.0, 0.0], 1.0, 1, ''],
        [0.0, 'way', 'mambo', [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]],
        [0.5, 'seen', 'mambo', [0.0, 0.0, 1.0], [[1.0, 0.5, 0.0, 0.1, 0.1, 0.0]]],
        [0.5, 'filter', '', 3.0, [[1.0, 1.0, 0.0, 0.5, *unit]], 1],
        [1.0, 'found', '', [[1, 1.0, 1.0, 0.0, unit, 'mambo', 1.0]]],
        [2.0, 'robot', 'mambo', [2.0, 2.0, 1.0, 0.5], 1.0, 1, ''],
    ]
    scene = scene_of('plane', load_mission('mambo_turtlebot_obstacles').scenario)
    path = tmp_path / f'run{suffix}'
    pictures = frames(EventLog(scene, events), path, speed=5.0)
    assert len(pictures) >= 2 and pictures[0].std() > 5.0
    assert np.abs(pictures[0] - pictures[-1]).max() > 100
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


def test_a_video_of_a_search_in_space(tmp_path):
    log = search(load_mission('ranging_drone_3d').scenario, 1).trace.log('drone')
    assert frames(log, tmp_path / 'run.mp4')[0].shape == (576, 768, 3)


def test_a_video_shows_where_a_robot_points_what_it_sees_and_where_it_goes(tmp_path):
    scene = scene_of('plane', load_mission('mambo').scenario)
    robot = scene['robots']['mambo']

    def still(yaw=0.0, detections=()):
        row = ['mambo', 0, 0, [2.0, 0.5, 1.0], [], '']
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


@pytest.fixture
def departing():
    """Return a run whose robot is on its way at 1 s, and leaves at 2 s."""
    events = []
    maker = EventMaker(scene_of('plane', load_mission('mambo').scenario), events.append)
    maker.robot(0.0, 'mambo', (0.5, 0.5, 1.0, 0.0))
    maker.way(0.0, 'mambo', [(0.5, 0.5, 1.0), (2.0, 2.0, 1.0)])
    maker.robot(1.0, 'mambo', (0.6, 0.6, 1.0, 0.0))
    maker.leave(2.0, 'mambo')
    maker.message(3.0, 'team', 'team', 'goes on')
    return EventLog(maker.scene, events)


def test_a_robot_that_left_goes_nowhere_in_a_video(departing, tmp_path):
    pictures = frames(departing, tmp_path / 'run.mp4', speed=1.0)
    assert bluish(pictures[25]).sum() < 0.5 * bluish(pictures[15]).sum()


@needs_chromium
def test_a_robot_that_left_goes_nowhere_on_the_page(departing, tmp_path):
    write_replay(departing, tmp_path / 'page.html')
    with chromium() as shown:
        shown.open((tmp_path / 'page.html').as_uri())
        pixels = []
        for seconds, text in ((1.5, 'on the way'), (2.5, 'left')):
            shown.seek(seconds)
            assert shown.page.inner_text('#robots tr[data-robot=mambo] td.text') == text
            address = shown.page.evaluate("document.getElementById('map').toDataURL()")
            data = np.frombuffer(base64.b64decode(address.partition(',')[2]), np.uint8)
            pixels.append(bluish(cv2.imdecode(data, cv2.IMREAD_COLOR)).sum())
        assert pixels[1] < 0.5 * pixels[0]


def test_robots_have_the_colours_of_the_page():
    text = (FOLDER / 'colours.js').read_text()
    robots = re.search(r'const ROBOTS = (\[.*\]);', text).group(1)
    assert tuple(re.findall(r'#\w+', robots.upper())) == video._ROBOTS
    named = re.search(r'const NAMED = (\{.*\});', text).group(1)
    colours = {name: colour.upper() for name, colour in re.findall(r"(\w+): '(#\w+)'", named)}
    assert colours == NAMED


def test_a_video_of_another_kind_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([str(tmp_path), '--video', 'run.avi'])
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
