"""Statements of persons over real services: answers, topics, restarts, lockstep."""

import math

import numpy as np
import pytest
from test_filter_node import SETTINGS as FILTER_SETTINGS
from test_filter_node import running

from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_filter.records import FoundTarget
from maasi_filter.ros.qos import LATCHED_ALL
from maasi_msgs.msg import Report
from maasi_msgs.srv import AddSighting, MarkSearched, ReviewTarget

SERVICES = {
    'review_target': ReviewTarget,
    'add_sighting': AddSighting,
    'mark_searched': MarkSearched,
}
SIGHTING = {'position': (1.5, 0.5), 'radius': 0.2, 'weight': 0.5, 'source': 'Ann'}
SEARCHED = {'zone': '0.5 0.5 0.3', 'detection_probability': 0.8, 'source': 'dogs'}


def request(name, **fields):
    message = SERVICES[name].Request()
    for field, value in fields.items():
        if field == 'position':
            message.position.x, message.position.y = map(float, value)
        else:
            setattr(message, field, value)
    return message


def ask(team, name, **fields):
    """Return the answer of a service."""
    client = team.node.create_client(SERVICES[name], f'search/{name}')
    team.until(client.service_is_ready, f'no {name}')
    future = client.call_async(request(name, **fields))
    team.until(future.done, f'no answer of {name}')
    team.node.destroy_client(client)
    return future.result()


def ids(team):
    return [target.id for target in team.found[-1].targets]


def test_statements_are_used_at_once_answered_and_published():
    with running() as team:
        reports = team.collect(Report, 'reports', LATCHED_ALL)
        team.see(*range(1, 9))
        team.until(lambda: team.found and len(ids(team)) == 2)
        first = ids(team)[0]
        answer = ask(team, 'review_target', id=first, confirmed=False, source='Bo')
        assert answer.success
        assert answer.message == (
            f'target {first} rejected by Bo with reliability 0.95; it is withdrawn'
        )
        team.until(lambda: first not in ids(team))
        assert ask(team, 'add_sighting', **SIGHTING).success
        answer = ask(team, 'mark_searched', **SEARCHED)
        assert answer.success
        assert '0.283 m² searched by dogs' in answer.message
        team.until(lambda: len(reports) == 3)
        kinds = [item.kind for item in reports]
        assert kinds == [Report.REJECTED, Report.SIGHTING, Report.SEARCHED]
        assert [item.id for item in reports] == [1, 2, 3]
        assert {item.header.frame_id for item in reports} == {'map'}
        assert (reports[0].target, reports[0].batch_id, reports[0].source) == (first, 8, 'Bo')
        assert math.hypot(reports[0].position.x - 1.0, reports[0].position.y - 1.0) < 0.5
        assert team.step(9, {'a': []}).reports == 3
        answer = ask(team, 'review_target', id=first, confirmed=True)
        assert answer.message.endswith('it counts as found')
        team.until(lambda: first in ids(team))
        # A new search forgets them.
        team.tested.reset()
        team.until(lambda: reports[-1].kind == Report.CLEARED)
        assert team.tested.filter.reports == []
        assert team.tested.filter.area.sightings == ()


@pytest.mark.parametrize('method', ['pmb', 'ic_phd'])
def test_statements_survive_a_restart(tmp_path, method):
    options = {'save_file': str(tmp_path / 'state'), 'save_batches': True}
    with running(**options) as team:
        team.see(1, 2)
        assert ask(team, 'add_sighting', **SIGHTING).success
        assert ask(team, 'mark_searched', **SEARCHED).success
        e = team.tested.filter.exploration.values.copy()
        cells = team.tested.filter.area.cells.copy()
    with running(**options) as team:
        reports = team.collect(Report, 'reports', LATCHED_ALL)
        team.until(lambda: len(reports) == 2)
        assert [item.kind for item in reports] == [Report.SIGHTING, Report.SEARCHED]
        np.testing.assert_array_equal(team.tested.filter.exploration.values, e)
        np.testing.assert_array_equal(team.tested.filter.area.cells, cells)
        assert ask(team, 'mark_searched', **SEARCHED).success
        team.until(lambda: reports[-1].id == 3)


def test_a_target_of_another_filter_is_reviewed_there():
    with running() as team:
        theirs = FoundTarget(4, np.array([1.5, 1.5]), 1e-4 * np.eye(2), 'rover', 2, 0.1)
        team.tested.filter.merge({'rover': [theirs]})
        (target,) = team.tested.filter.found_targets
        answer = ask(team, 'review_target', id=target.id, confirmed=False)
        assert not answer.success
        assert answer.message.startswith(f'id: read {target.id}, which rover found: allowed are')
        assert team.tested.filter.found_targets == [target]


def test_in_lockstep_a_target_that_is_withdrawn_before_its_batch_is_dropped_by_name():
    with running(lockstep=True) as team:
        team.see(*range(1, 9))
        first = ids(team)[0]
        answer = ask(team, 'review_target', id=first, confirmed=True, step=10)
        assert answer.success
        search = team.tested.filter
        search.components = [item for item in search.components if item.target is None]
        assert team.step(10, {'a': []}).reports == 0
        assert team.tested.dropped['bad statement'] == 1


def test_in_lockstep_statements_wait_for_their_batch_and_runs_are_equal():
    def play(order):
        with running(lockstep=True) as team:
            reports = team.collect(Report, 'reports', LATCHED_ALL)
            for name, fields in order:
                answer = ask(team, name, step=3, **fields)
                assert answer.success
                assert answer.message.endswith('waits for the next batch')
            counts = [team.step(number, {'a': [(0.3, 0.5)]}).reports for number in range(1, 6)]
            assert counts == [0, 0, 2, 2, 2]
            assert [item.batch_id for item in reports] == [3, 3]
            return [update.clusters for update in team.updates], team.tested.filter

    order = [('add_sighting', SIGHTING), ('mark_searched', SEARCHED)]
    (first, one), (second, other) = play(order), play(order)
    assert first == second
    np.testing.assert_array_equal(one.exploration.values, other.exploration.values)


@pytest.mark.parametrize(
    ('name', 'fields', 'text'),
    [
        ('review_target', {'id': 7}, 'id: read 7, allowed are none, as no target is found yet'),
        ('review_target', {'id': 1, 'reliability': 2.0}, 'reliability: read 2, allowed are 0.5'),
        ('add_sighting', {**SIGHTING, 'position': (9.0, 0.5)}, 'position: read (9, 0.5), which is'),
        ('add_sighting', {**SIGHTING, 'radius': math.nan}, 'radius: read nan, allowed are'),
        ('add_sighting', {**SIGHTING, 'weight': -1.0}, 'weight: read -1, allowed are'),
        ('mark_searched', {**SEARCHED, 'zone': 'here'}, "zone: got 'here', allowed are"),
        ('mark_searched', {**SEARCHED, 'zone': '9 9 1'}, 'zone: lies 8.9 m outside of the area'),
        ('mark_searched', {**SEARCHED, 'zone': '1 1 1e300'}, 'zone: '),
        ('mark_searched', {'zone': '1 1 1'}, 'detection_probability: read 0, allowed are'),
    ],
)
def test_bad_statements_are_refused_by_name(name, fields, text):
    with running() as team:
        answer = ask(team, name, **fields)
        assert not answer.success
        assert answer.message.startswith(text)
        assert team.tested.filter.reports == []
        team.see(1)


def test_statements_in_degrees_are_those_in_metres():
    origin = OriginSettings(latitude=46.6, longitude=9.9)
    environment = FILTER_SETTINGS.environment.model_copy(update={'origin': origin})
    ((latitude, longitude, _),) = geodetic(np.array([[1.5, 0.5]]), origin)
    with running(environment=environment) as team:
        reports = team.collect(Report, 'reports', LATCHED_ALL)
        place = {**SIGHTING, 'position': (longitude, latitude), 'frame_id': 'wgs84'}
        assert ask(team, 'add_sighting', **place).success
        zone = f'{longitude} {latitude} 0.3'
        answer = ask(team, 'mark_searched', **{**SEARCHED, 'zone': zone}, frame_id='wgs84')
        assert answer.success
        team.until(lambda: len(reports) == 2)
        place_used = [reports[0].position.x, reports[0].position.y]
        zone_used = [float(word) for word in reports[1].zone.split()]
        assert [*place_used, *zone_used] == pytest.approx([1.5, 0.5, 1.5, 0.5, 0.3], abs=2e-4)
        swapped = {**place, 'position': (latitude, longitude)}
        answer = ask(team, 'add_sighting', **swapped)
        assert not answer.success and answer.message.startswith('position: read (')
    with running() as team:
        answer = ask(team, 'add_sighting', **place)
        assert answer.message == 'frame_id: read wgs84, which needs environment.origin'
        answer = ask(team, 'mark_searched', **SEARCHED, frame_id='odom')
        assert answer.message == 'frame_id: read odom, allowed are map [m] and wgs84 [degrees]'


def test_random_requests_never_stop_the_node():
    rng = np.random.default_rng(4)
    odd = [0.0, -1.0, 1e-300, 1e300, math.nan, math.inf, -math.inf]
    texts = [
        '',
        'POLYGON ((0 0, 1 1, 1 0, 0 1, 0 0))',
        'POLYGON EMPTY',
        '{}',
        '[]',
        '{"a": 1}',
        '1 1',
    ]
    texts += [
        '1 1 nan',
        '[[0, 0], [1, 0], [1, 1]]',
        'POLYGON ((0 0, 1 0, 1 1, 0 0))',
        '\x00',
        'é' * 300,
    ]
    accepted = 0

    def value():
        return float(rng.choice(odd) if rng.random() < 0.15 else rng.uniform(-0.2, 2.0))

    with running() as team:
        team.see(1, 2, 3)
        for _ in range(100):
            name = str(rng.choice(list(SERVICES)))
            fields = {'source': str(rng.choice(texts[-3:]))}
            if name == 'review_target':
                fields |= {'id': int(rng.integers(4)), 'reliability': value()}
            elif name == 'add_sighting':
                fields |= {'position': (value(), value()), 'radius': value(), 'weight': value()}
            else:
                fields |= {
                    'zone': str(rng.choice([*texts, '1 1 0.5', '0 0 2'])),
                    'detection_probability': value(),
                }
            accepted += ask(team, name, **fields).success
        search = team.tested.filter
        assert accepted == len(search.reports) > 9
        assert np.isfinite(search.exploration.values).all()
        assert search.exploration.values.min() >= 0.0
        assert np.isfinite(search.weights).all() and (search.weights >= 0.0).all()
        team.see(4, 5)
