"""The page of a run in a browser: what it shows is what the bag and the report hold."""

import base64
import re

import cv2
import numpy as np
import pytest
import rclpy
from browsers import CHROMIUM, chromium, needs_chromium
from rclpy.executors import SingleThreadedExecutor
from scenario_runs import PATIENCE, of_topic, start
from waiting import wait_until

from maasi_filter.ros.qos import RELIABLE
from maasi_sim.run.bag import Bag, BagWriter, load_types
from maasi_sim.run.message_facts import is_read
from maasi_sim.run.run_options import ViewOptions
from maasi_sim.run.topics import message_class
from maasi_sim.run.view.live_view import RunPage
from maasi_sim.run.view.page_file import REPLAY, empty_page, write_replay
from maasi_sim.run.view.recording import read_events
from maasi_sim.run.view.scene import empty_scene
from maasi_sim.run.view.view_node import ViewNode
from maasi_sim.run.view.view_run import main

pytestmark = pytest.mark.system


def watch(run, address):
    """Note what a browser sees of a run that is under way."""
    with chromium() as shown:
        shown.open(address)
        strips = "[...document.querySelectorAll('#strips canvas')].map((strip) => strip.ariaLabel)"
        # Strips are drawn now and then: until both robots have moved on them.
        shown.until(f"{strips}.filter((text) => text.includes('moving')).length === 2")
        run.strips = shown.page.evaluate(strips)
        shown.page.click('#robots tr[data-robot=turtlebot]')
        shown.page.click('button[data-command=pause]')
        shown.until("/[^.]$/.test(document.querySelector('#controls [role=status]').innerText)")
        run.answer = shown.page.inner_text('#controls [role=status]')
        shown.until("document.querySelectorAll('#cameras img').length === 2")
        images = shown.page.locator('#cameras img').all()
        run.pictures = [image.get_attribute('alt') for image in images]
        shown.until('document.body.dataset.connection === "ended"', PATIENCE)
        shown.page.keyboard.press('End')
        shown.settle()
        run.found = shown.number()
        run.decisions = shown.page.evaluate('maasi.log.decisions.times.length')
        run.controls = shown.page.is_visible('#controls') or shown.page.is_visible('#live')
        shown.until("document.querySelector('#headline').textContent.startsWith('Ended')")
        run.headline = shown.page.inner_text('#headline')
        run.card = shown.page.inner_text('#card')
        events = (
            '(kind) => maasi.log.owners(kind).flatMap((name) => maasi.log.slot(kind, name).events)'
        )
        run.starts = shown.page.evaluate(events, 'start')
        run.modes = [event[3] for event in shown.page.evaluate(events, 'mode')]
        run.states = shown.page.locator('#robots td.text').all_inner_texts()


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    options = ('--seed', 1, '--lockstep', '--time-limit', 30, '--view', '--control', '--port', 0)
    folder = tmp_path_factory.mktemp('viewed') / 'run'
    with start('mambo_turtlebot', folder, *options) as run:
        address = run.wait_for('^view: ').split()[1]
        if CHROMIUM is not None:
            watch(run, address)
        return run.finish()


def count(events, kind):
    return sum(event[1] == kind for event in events)


def seconds(stamp):
    return stamp['sec'] + 1e-9 * stamp['nanosec']


@needs_chromium
def test_a_browser_saw_the_run_while_it_went_on(run):
    assert run.found == len(run.report['found'])
    assert run.decisions == sum(len(item['robots']) for item in of_topic(run, '/decisions'))
    assert run.answer == 'pause: turtlebot'
    # What robots have done so far is below the time line of a live run, too.
    assert [strip.partition(':')[0] for strip in run.strips] == ['mambo', 'turtlebot']
    assert all('moving' in strip and ' measurement' in strip for strip in run.strips)
    # Nobody follows after the end.
    assert not run.controls
    assert 'limits.time' in run.headline
    assert run.headline.endswith(f'; {run.found} of 12 found after 30 s')
    assert './scripts/run_scenario mambo_turtlebot --seed 1 --lockstep' in run.card
    # Where it is, as the terminal says it.
    assert f'Replay: {run.folder / REPLAY}' in run.card and (run.folder / REPLAY).is_file()
    # Numbers of nodes that were ready, up to all.
    ready = [start[3] for start in run.starts]
    assert ready == sorted(set(ready)) and ready[-1] == run.starts[-1][4]
    assert 'mambo searching, turtlebot paused' in run.modes
    assert run.states == ['run ended', 'run ended']


@needs_chromium
def test_the_page_shows_the_bag_and_why_a_robot_goes_there(run):
    log, decisions = read_events(run.folder), of_topic(run, '/decisions')
    before = [event for event in log.events if event[0] <= 10.0]
    explored = [event for event in before if event[1] in ('map', 'plan')][-1]
    share = explored[7] if explored[1] == 'map' else explored[4]
    potential = [event for event in before if event[1] == 'filter'][-1][3]
    expected = potential + log.scene['expected_targets'] * (1.0 - share)
    with chromium() as replay:
        page = replay.page
        replay.open((run.folder / REPLAY).as_uri())
        page.keyboard.press('End')
        replay.settle()
        assert replay.number() == len(run.report['found'])
        replay.until("document.querySelector('#headline').textContent.startsWith('Ended: time')")
        last = page.screenshot()
        replay.seek(10.0)
        assert page.screenshot() != last
        for robot in ('mambo', 'turtlebot'):
            when, *_, pose = page.evaluate(f'maasi.log.at("robot", "{robot}", 10.0).slice(0, 4)')
            # One state in a tenth of a second is shown.
            assert 9.9 - 1e-6 < when <= 10.0
            states = of_topic(run, f'/{robot}/state')
            until = [item for item in states if seconds(item['header']['stamp']) <= when + 1e-6]
            place = until[-1]['pose']['pose']['position']
            assert pose[:2] == pytest.approx([place['x'], place['y']], abs=1e-3)
        assert replay.number() == sum(item['time'] <= 10.0 for item in run.report['found'])
        left = page.text_content('#counts dt:text-is("expected left") + dd')
        assert float(left) == pytest.approx(expected, rel=0.01)
        x, y = replay.place(*page.evaluate('maasi.log.at("robot", "mambo", 10.0)[3]')[:3])
        box = page.locator('#map').bounding_box()
        page.mouse.click(box['x'] + x, box['y'] + y)
        replay.settle()
        assert 'mambo, decision' in page.inner_text('#why')
        first = decisions[0]['robots'][0]
        page.click(f'#log li.decision:has-text("{first["robot"]}: decision 0")')
        replay.settle()
        page.click('#why summary')
        rows = page.locator('#why tbody tr')
        assert rows.count() == len(first['candidates'])
        assert int(page.inner_text('#why tr.chosen td')) == first['chosen']
        assert 'largest J' in page.inner_text('#why .reason')
        assert page.inner_text('#why .formula') == 'J = (-1.00e-6 C + 0.5 T + 1 E) / K'
        # Sorted by the objective, and by another column where that is clicked.
        for heading, term in (('', 'objective'), ('E', 'exploration')):
            if heading:
                page.click(f'#why th:text-is("{heading}")')
                replay.settle()
            values = [item[term] for item in first['candidates']]
            assert int(rows.first.locator('td').first.inner_text()) == np.argmax(values)
        # The arrow goes to the next decision.
        page.keyboard.press('ArrowUp')
        replay.settle()
        times = [seconds(item['header']['stamp']) for item in decisions]
        later = next(time for time in times if time > 0.0)
        assert page.evaluate('maasi.time') == pytest.approx(later, abs=1e-3)


@needs_chromium
def test_pictures_of_the_cameras_have_circles_around_the_markers(run, tmp_path):
    log = read_events(run.folder)
    pictures = [event for event in log.events if event[1] == 'picture']
    assert {event[2] for event in pictures} == {'mambo', 'turtlebot'}
    assert all(re.match(r'Camera of \w+ at .* s, \d+ detections?$', text) for text in run.pictures)
    whole = [event for event in pictures if event[5]]
    for *_, data, size, marks, _ in whole:
        image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
        assert image.shape[1::-1] == tuple(size)
        blueness = image.astype(int) @ (2, -1, -1)
        for column, row, radius in marks:
            assert 1.0 < radius < 20.0
            assert blueness[round(row), round(column)] > np.median(blueness) + 50
    assert len(whole) > 2
    file = tmp_path / 'page.html'
    write_replay(log, file, 150_000)
    assert file.stat().st_size < 150_000 + len(empty_page())
    with chromium() as shown:
        page = shown.page
        shown.open(file.as_uri())
        kept = page.evaluate('maasi.log.slot("picture", "mambo").events')
        assert 2 < len(kept) < 0.7 * sum(event[2] == 'mambo' for event in pictures)
        # Every so many of them.
        all_times = [event[0] for event in pictures if event[2] == 'mambo']
        assert len(set(np.diff([all_times.index(event[0]) for event in kept]))) == 1
        gaps = np.diff([event[0] for event in kept])
        shown.seek(kept[2][0] - 0.01)
        figure = page.locator('#cameras figure[data-robot=mambo]')
        count = len(kept[1][5])
        words = f'mambo {int(gaps[1] - 0.01)} s ago, {count} detection' + 's' * (count != 1)
        assert figure.inner_text().strip() == words
        image = figure.locator('img')
        assert image.get_attribute('src').endswith(kept[1][3])
        width = image.evaluate('(image) => image.decode().then(() => image.naturalWidth)')
        # The part of 160 px by 120 px that its sensor counts.
        assert width == kept[1][4][0] < 160
        seen = next(event for event in kept if event[5])
        shown.seek(seen[0])
        assert figure.inner_text().strip().startswith('mambo now, ')
        frame, mark = (figure.locator(part).bounding_box() for part in ('img', 'i >> nth=0'))
        for number, (at, size) in enumerate((('x', 'width'), ('y', 'height'))):
            middle = (mark[at] + 0.5 * mark[size] - frame[at]) / frame[size]
            assert middle == pytest.approx(seen[5][0][number] / seen[4][number], abs=0.01)


@needs_chromium
def test_a_search_in_space_from_above_is_shaded_by_its_columns():
    scene = {'name': 'space', 'robots': {}, 'bounds': [[0, 1], [0, 1], [0, 2]]}
    # Explored at the ground, and above it of one column only.
    grid = [0.0, 'map', '', [0, 0, 0], [1, 1, 1], [2, 2, 3], '0zz0zz0zz000', 0.5]
    with chromium() as shown:
        shown.show(scene, grid)
        shown.page.click('#space')
        shown.settle()
        shades = shown.page.evaluate(
            'Array.from(maasi.map.unexplored.floor.canvas'
            '.getContext("2d").getImageData(0, 0, 2, 2).data)'
        )[3::4]
        # From the upper left corner, by rows: y falls, x rises.
        assert shades == [90, 0, 90, 90]
        # No robot has a camera.
        assert shown.page.is_hidden('#cameras')


def test_a_run_leaves_its_page_which_is_made_again_of_its_bag_or_of_the_newest_run(
    run, tmp_path, monkeypatch, capsys
):
    assert run.code in (0, 1) and 'replay:' in run.output, run.output
    page = (run.folder / REPLAY).read_text()
    assert 10_000 < len(page) < 5_000_000
    assert main([str(tmp_path / 'nothing'), '--no-browser']) == 2
    assert 'no such recording' in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match='2'):
        main(['--no-browser'])
    assert 'runs contains no run' in capsys.readouterr().err
    (tmp_path / 'runs').mkdir()
    (tmp_path / 'runs' / 'mine').symlink_to(run.folder)
    for recording in ([str(run.bag)], []):
        assert main([*recording, '--no-browser', '--out', 'page.html']) == 0
        assert (tmp_path / 'page.html').read_text() == page


def shown_messages(run, without=None):
    """Return the topics of a bag that are shown, with their types, and their messages."""
    with Bag(run.bag) as bag:
        kept = {name: kind for name, kind in bag.types.items() if is_read(name, kind)}
        kept.pop(without, None)
        return kept, list(bag.raw(kept))


def test_a_recording_without_a_scenario_is_read(run, tmp_path):
    kept, messages = shown_messages(run)
    writer = BagWriter(tmp_path / 'bag', load_types())
    for topic, kind in kept.items():
        writer.add_topic(topic, kind)
    for topic, _, time, data in messages:
        writer.write(topic, time, data)
    writer.close()
    shares = []
    log, whole = read_events(tmp_path), read_events(run.folder, shares.append)
    assert shares[0] == 0.0 and shares == sorted(shares) and shares[-1] < 1.0
    # The exploration function is in single precision.
    assert np.allclose(log.scene['bounds'], whole.scene['bounds'], atol=1e-3)
    for kind in ('robot', 'plan', 'found', 'filter', 'truth'):
        assert count(log.events, kind) == count(whole.events, kind)


def test_the_view_node_shows_a_bag_that_is_played_and_begins_again_with_it(run, ros):
    view = RunPage(empty_scene(), ViewOptions(0), 0, '', waits=False)
    player = rclpy.create_node('player', enable_rosout=False)
    node = ViewNode(view.put_message)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin_until(condition):
        wait_until(condition, lambda: executor.spin_once(0.05), limit=PATIENCE)

    try:
        kept, played = shown_messages(run, without='/rosout')
        publishers = {
            topic: player.create_publisher(message_class(kind), topic, RELIABLE)
            for topic, kind in kept.items()
        }
        spin_until(lambda: all(item.get_subscription_count() for item in publishers.values()))
        whole = read_events(run.folder)
        for topic, _, _, data in played:
            publishers[topic].publish(data)
            executor.spin_once(0.0)
        kinds = ('plan', 'found', 'filter', 'seen')
        expected = [count(whole.events, kind) for kind in kinds]
        spin_until(lambda: [count(view.hub._events, kind) for kind in kinds] == expected)
        assert view.maker.latest == pytest.approx(whole.duration, abs=0.2)
        # It is played again: the page begins again.
        for topic, _, _, data in played[: len(played) // 4]:
            publishers[topic].publish(data)
        spin_until(lambda: 0.0 < view.maker.latest < 0.5 * whole.duration)
    finally:
        executor.shutdown()
        node.destroy_node()
        player.destroy_node()
        view.end()
        view.close()
