"""Whole scenarios: separate processes over DDS, from camera image to found target."""

import contextlib
import json
import socket
from collections import Counter
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from scenario_runs import check_replay, of_topic, run_scenario, start
from small_field import SMALL_FIELD

from maasi_filter.geometry.area import Area
from maasi_sim.run.bag import Bag
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.search import search

pytestmark = pytest.mark.system


@pytest.fixture(scope='module')
def repeated(tmp_path_factory):
    """Return a search, and its first 12 s again: during another run, with other threads."""
    folder = tmp_path_factory.mktemp('repeated')
    whole = run_scenario('mambo_turtlebot', folder / 'first', '--seed', 3, '--lockstep')
    threads = {'NUMBA_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}
    options = ('--seed', 3, '--lockstep', '--time-limit', 12)
    other = ('--seed', 4, '--lockstep', '--time-limit', 5, '--no-record')
    with start('mambo_turtlebot', folder / 'other', *other) as other_run:
        again = run_scenario('mambo_turtlebot', folder / 'second', *options, environment=threads)
        other_run.finish()
    return whole, again


def test_the_demo_finds_all_targets(repeated):
    run, _ = repeated
    assert run.code == 0, run.output
    report = run.report
    assert (report['true_found'], report['missed'], report['false_found']) == (12, 0, 0)
    assert report['rmse'] <= 0.08
    assert report['end_reason'] == 'all_found'
    assert (run.folder / 'report.png').stat().st_size > 10_000
    nodes = {'sim_node', 'mambo_driver', 'turtlebot_driver', 'filter_node', 'planner_node'}
    assert {path.stem for path in run.folder.glob('*.log')} == nodes
    assert {path.stem for path in run.folder.glob('parameters/*.yaml')} == nodes
    assert run.processes() == []


def test_a_run_ends_at_the_step_of_its_time_limit(repeated):
    _, run = repeated
    assert (run.code, run.report['end_reason']) == (1, 'time_limit'), run.output
    # A step that a busy machine holds up is repeated.
    steps = dict.fromkeys(item['step'] for item in of_topic(run, '/mambo/state'))
    assert list(steps) == list(range(240))


def test_found_targets_are_sent_while_it_runs(tmp_path):
    origin = {'latitude': 46.0, 'longitude': 23.5}
    scenario = SMALL_FIELD | {'environment': SMALL_FIELD['environment'] | {'origin': origin}}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(('127.0.0.1', 0))
        address = f'udp://127.0.0.1:{receiver.getsockname()[1]}'
        run = run_scenario(scenario, tmp_path / 'run', '--seed', 2, '--lockstep', '--cot', address)
        receiver.setblocking(False)
        sent = []
        with contextlib.suppress(BlockingIOError):
            while True:
                sent.append(ElementTree.fromstring(receiver.recv(65536)).get('uid'))
    found = {f'maasi.search.{item["id"]}' for item in run.report['found']}
    assert found and set(sent) == found, run.output
    assert f'{len(sent)} Cursor-on-Target events sent to {address}' in run.output


def transforms(run):
    return {
        (repr(item['header']['stamp']), item['child_frame_id']): item
        for message in of_topic(run, '/tf')
        for item in message['transforms']
    }


def test_the_same_seed_gives_the_same_run_to_the_bit(repeated):
    whole, again = repeated
    for topic, least in (('/decisions', 3), ('/filter_update', 50)):
        messages = of_topic(again, topic)
        assert len(messages) > least
        assert messages == of_topic(whole, topic)[: len(messages)]
    found = again.report['found']
    assert found and found == whole.report['found'][: len(found)]
    moved, before = transforms(again), transforms(whole)
    assert len(moved) > 80
    assert {key: before.get(key) for key in moved} == moved
    for topic in ('/mambo/state', '/turtlebot/state'):
        first, second = (
            [(item['step'], item['battery']) for item in of_topic(run, topic)] for run in repeated
        )
        assert len({charge for _, charge in second}) > 5
        assert first[: len(second)] == second


def test_the_nodes_decide_as_the_search_in_one_process(repeated):
    _, run = repeated
    scenario = load_scenario('mambo_turtlebot', {'limit': (('limits', 'time'), 12.0)})
    result = search(scenario, 3)
    decisions = of_topic(run, '/decisions')
    assert len(result.decisions) == len(decisions)
    for ours, theirs in zip(result.decisions, decisions):
        assert ours.step == theirs['step']
        for robot in theirs['robots']:
            waypoint = ours.robots[robot['robot']].waypoint.tolist()
            assert waypoint == [robot['waypoint'][axis] for axis in 'xyz']
    found = [target.position.tolist() for target in result.found_targets]
    assert found == [list(item['position']) for item in run.report['found']]


def test_the_bag_holds_the_run(repeated):
    _, run = repeated
    with Bag(run.bag) as bag:
        facts = bag.scenario()
        topics = {topic for topic, _, _, _ in bag.raw(None)}
    assert facts['seed'] == 3
    frames = ('/tf', '/tf_static', '/mambo/robot_description')
    for topic in ('/clock', '/mambo/odom', '/turtlebot/scan', '/particles', '/markers', *frames):
        assert topic in topics
    assert any(topic.endswith('image_raw/compressed') for topic in topics)


def test_a_replay_finds_the_same(repeated, tmp_path):
    check_replay(repeated[1], tmp_path)


def test_independent_robots_share_what_they_find_and_nothing_else(tmp_path):
    """002, section 4."""
    scenario = load_scenario('ranging_pair_3d').content()
    scenario['planner'] = {'name': 'maas', 'coordination': 'independent', 'alpha': 1.0}
    # The first target is for both to see.
    for robot, place in (('drone1', [100.0, 60.0, 60.0]), ('drone2', [100.0, 130.0, 60.0])):
        scenario['robots'][robot]['start'] = place
        scenario['robots'][robot]['candidates'] = {'ring': 6, 'distance': 12.0}
    scenario['targets'] = {'positions': [[100.0, 95.0, 70.0], [60.0, 70.0, 60.0], [250.0] * 3]}
    scenario['limits']['time'] = 13.5
    run = run_scenario(scenario, tmp_path / 'run', '--seed', 1, '--lockstep')
    assert run.code == 1, run.output
    result = search(load_scenario(tmp_path / 'search.yaml'), 1)
    assert len(result.found_targets) == 2
    for name in ('drone1', 'drone2'):
        ours = [item for item in result.decisions if name in item.robots]
        theirs = of_topic(run, f'/{name}/decisions')
        assert len(ours) >= 5
        assert [item.step for item in ours] == [item['step'] for item in theirs]
        for one, other in zip(ours, theirs):
            waypoint = other['robots'][0]['waypoint']
            assert one.robots[name].waypoint.tolist() == [waypoint[axis] for axis in 'xyz']
        # Both find the second target at the same time; it is the first one's then.
        last = of_topic(run, f'/{name}/found_targets')[-1]['targets']
        assert [item['robot'] for item in last] == ['drone1', 'drone1']
    report = run.report
    assert report['end_reason'] == result.end_reason
    assert [item['position'] for item in report['found']] == [
        target.position.tolist() for target in result.found_targets
    ]
    assert report['measurements'] == result.measurements
    check_replay(run, tmp_path)


@pytest.mark.parametrize(('name', 'seed', 'homes'), [('field', 901, 0), ('field_batteries', 1, 2)])
def test_a_field_is_searched_within_its_area(name, seed, homes, tmp_path):
    """Keep-outs, a hole and a prior; or a battery that has to be charged twice."""
    run = run_scenario(name, tmp_path, '--seed', seed, '--lockstep')
    assert run.code == 0, run.output
    # On a busy machine nodes wait for those that start later.
    assert not [line for line in run.warnings if 'waiting for publishers' not in line]
    report, area = run.report, Area(load_scenario(name).environment)
    assert report['missed'] == report['false_found'] == 0
    log = (run.folder / 'planner_node.log').read_text()
    assert log.count('goes home to charge') >= homes
    for robot in load_scenario(name).robots:
        states = of_topic(run, f'/{robot}/state')
        places = np.array([list(item['pose']['pose']['position'].values()) for item in states])
        assert shapely.contains_xy(area.region, places[:, 0], places[:, 1]).all()
        assert min(item['battery'] for item in states if item['battery'] >= 0.0) > 0.05
    if area.settings.origin is not None:
        features = json.loads((run.folder / 'ways.geojson').read_text())['features']
        kinds = Counter(item['properties']['kind'] for item in features)
        assert kinds == {'area': 1, 'keep_out': 2, 'explored': 1, 'way': 3}
