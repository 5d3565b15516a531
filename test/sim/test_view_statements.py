"""Statements of persons on the page: buttons, clicks on the map, what the filter receives."""

import base64
import json
import threading
import urllib.error
import urllib.request
from contextlib import closing, contextmanager

import cv2
import numpy as np
import pytest
import rclpy
import shapely
from rclpy.executors import SingleThreadedExecutor
from test_view_drawing import click
from waiting import wait_until

from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_msgs.srv import AddSighting, MarkSearched, ReviewTarget
from maasi_sim.run.view.control_node import Control
from maasi_sim.run.view.report_request import ReportRequest, read_report
from maasi_sim.run.view.server import Hub, ViewServer

SCENE = {'name': 'test', 'robots': {}, 'bounds': [[0, 100], [0, 80]], 'expected_targets': 6.0}
FOUND = [[1, 20.0, 30.0, 0.0, [1, 0, 0, 1, 0, 0], 'rover', 2.0]]
FOUND += [[2, 60.0, 50.0, 0.0, [1, 0, 0, 1, 0, 0], 'rover', 3.0]]
ORIGIN = OriginSettings(latitude=46.6, longitude=9.9, altitude=1800.0)
EVENTS = [
    [0.0, 'robot', 'rover', [5.0, 5.0, 0.0, 0.0], 1.0, 1, ''],
    [3.0, 'found', '', FOUND],
]
PIXEL = base64.b64encode(cv2.imencode('.jpg', np.zeros((2, 3, 3), np.uint8))[1]).decode()
ZONE = [{'kind': 'searched', 'rings': [[[10, 10], [40, 10], [40, 40], [10, 10]]]}]
REPORTS = [
    [4.0, 'report', '', 'sighting', 0, [70.0, 20.0, 0.0], 8.0, 0.5, []],
    [5.0, 'report', '', 'searched', 0, [30.0, 20.0, 0.0], 0.0, 0.7, ZONE],
    [6.0, 'report', '', 'rejected', 1, [20.0, 30.0, 0.0], 0.0, 0.95, []],
    [6.0, 'found', '', FOUND[1:]],
    [7.0, 'report', '', 'confirmed', 2, [60.0, 50.0, 0.0], 0.0, 0.95, []],
]


class Commander:
    """Notes what a page sends."""

    def __init__(self):
        self.requests = []

    def __call__(self, command, robot):
        return True, command

    def report(self, request):
        self.requests.append(request)
        if request.fields.get('weight') == 7.0:
            return False, 'weight: read 7'
        return True, 'it is counted'


@contextmanager
def serving(**facts):
    commander = Commander()
    hub = Hub({**SCENE, 'control': True, **facts})
    for event in EVENTS:
        hub.put(event)
    with closing(ViewServer(hub, 0, commander=commander)) as server:
        yield server, commander


@pytest.fixture
def served():
    with serving() as served:
        yield served


def rows(shown):
    found = "[...document.querySelectorAll('#finds tr')].map((row) => row.innerText.split('\\t'))"
    return shown.page.evaluate(found)


def answer(shown, text):
    shown.until(f"document.querySelector('#controls [role=status]').innerText == '{text}'")


def test_found_targets_have_buttons_and_the_map_takes_sightings_and_searched_ground(
    chromium, served
):
    server, commander = served
    with chromium() as shown:
        shown.open(server.address)
        shown.until("document.querySelectorAll('#finds tr').length == 2")
        assert [row[1:4] for row in rows(shown)] == [
            ['1', '(20, 30) m\nrover, 2 s', 'Confirm Reject'],
            ['2', '(60, 50) m\nrover, 3 s', 'Confirm Reject'],
        ]
        shown.page.fill('#finds input', ' Ann ')
        shown.page.click('#finds tr[data-target="2"] button[data-confirmed=false]')
        answer(shown, 'it is counted')
        shown.page.click('button[data-report=sighting]')
        assert shown.page.is_disabled('#report button[data-report=send]')
        first, place = click(shown, [30, 30]), click(shown, [70, 20])
        shown.page.fill('#report input[name=weight]', '7')
        shown.page.click('#report button[data-report=send]')
        answer(shown, 'Refused: weight: read 7')
        # A refused statement stays, to be corrected.
        shown.page.fill('#report input[name=weight]', '0.25')
        # Letters and spaces in a field are no keys of the page.
        shown.page.fill('#finds input', 'Ann B')
        shown.page.click('#report button[data-report=send]')
        answer(shown, 'it is counted')
        shown.until("document.querySelector('#report').hidden")
        shown.page.click('button[data-report=searched]')
        ring = [click(shown, corner) for corner in ([10, 10], [40, 10], [40, 40])]
        shown.page.click('#report button[data-report=send]')
        shown.until("document.querySelector('#report').hidden")
        # A drawing and a statement are not made at the same time.
        shown.page.click('button[data-report=searched]')
        shown.page.click('button[data-draw=area]')
        assert shown.page.is_hidden('#report')
        shown.page.click('button[data-report=searched]')
        assert shown.page.get_attribute('button[data-draw=area]', 'aria-pressed') == 'false'
        # Corners that cross cannot be sent.
        for corner in ([10, 10], [40, 40], [40, 10], [10, 40]):
            click(shown, corner)
        shown.settle()
        assert shown.page.is_disabled('#report button[data-report=send]')
        shown.page.keyboard.press('Escape')
        shown.until("document.querySelector('#report').hidden")
    review, refused, sighting, searched = commander.requests
    fields = {'id': 2, 'confirmed': False, 'reliability': 0.0, 'source': 'Ann'}
    assert review == ReportRequest('review_target', '', fields)
    assert refused.fields['weight'] == 7.0
    assert sighting.service == 'add_sighting'
    assert sighting.fields['position'] == pytest.approx(place[:2], abs=1e-3)
    assert sighting.fields['position'] != pytest.approx(first[:2], abs=1.0)
    assert (sighting.fields['weight'], sighting.fields['radius']) == (0.25, 5.0)
    assert sighting.fields['source'] == 'Ann B'
    zone = shapely.from_wkt(searched.fields['zone'])
    assert zone.hausdorff_distance(shapely.Polygon([corner[:2] for corner in ring])) < 2e-3
    assert searched.fields['detection_probability'] == 0.7


@pytest.mark.parametrize('origin', [None, ORIGIN], ids=['metres', 'degrees'])
def test_positions_can_be_typed(chromium, origin):
    def text(*corners):
        places = np.array(corners, dtype=float)
        places = geodetic(places, origin)[:, :2] if origin else places
        return '; '.join(', '.join(f'{value:.8f}' for value in place) for place in places)

    ring = [(10, 10), (40, 10), (40, 40)]
    with chromium() as shown, serving(origin=origin and origin.model_dump()) as (server, commander):
        shown.open(server.address)
        shown.until("document.querySelectorAll('#finds tr').length == 2")
        shown.page.click('button[data-report=sighting]')
        for wrong in ('here', '1', '1, 2, 3', text((1, 1), (2, 2)), ''):
            shown.page.fill('#report input[name=corners]', wrong)
            assert shown.page.is_disabled('#report button[data-report=send]')
        shown.page.fill('#report input[name=corners]', text((70, 20)))
        shown.page.click('#report button[data-report=send]')
        shown.until("document.querySelector('#report').hidden")
        shown.page.click('button[data-report=searched]')
        shown.page.fill('#report input[name=corners]', text(*ring[:2]))
        # A click adds a corner to those that were typed, and is shown as text.
        *_, last = [click(shown, corner) for corner in ring[2:]]
        written = shown.page.input_value('#report input[name=corners]')
        places = [[float(word) for word in part.split(',')] for part in written.split(';')]
        expected = geodetic(np.array([last[:2]]), origin)[0, :2] if origin else last[:2]
        assert places[2] == pytest.approx(expected, abs=2e-3 if origin is None else 7e-8)
        shown.page.click('#report button[data-report=send]')
        shown.until("document.querySelector('#report').hidden")
    sighting, searched = commander.requests
    assert sighting.fields['position'] == pytest.approx((70.0, 20.0), abs=2e-3)
    zone = shapely.from_wkt(searched.fields['zone'])
    assert zone.hausdorff_distance(shapely.Polygon([*ring[:2], last[:2]])) < 5e-3


def test_a_replay_shows_statements_without_buttons(chromium):
    crop = [3.0, 'crop', '', 2, PIXEL]
    with chromium() as shown:
        shown.show(SCENE, *EVENTS, crop, *REPORTS)
        assert not shown.page.is_visible('button[data-report=sighting]')
        shown.seek(3.5)
        legend = shown.page.inner_text('#legend')
        assert 'sighting' not in legend and 'searched by others' not in legend
        assert len(rows(shown)) == 2
        shown.seek(7.0)
        legend = shown.page.inner_text('#legend')
        assert 'sighting' in legend and 'searched by others' in legend
        assert [row[2] for row in rows(shown)] == [
            '(20, 30) m\nrejected',
            '(60, 50) m\nrover, 3 s, confirmed 1 time',
        ]
        assert shown.page.locator('#finds button').count() == 0
        # N0 grows by the sighting.
        expected = [shown.page.evaluate(f'maasi.log.expected({time})') for time in (3.5, 4.0)]
        assert expected == [6.0, 6.5]
        images = shown.page.locator('#finds img')
        assert images.count() == 1
        assert images.get_attribute('alt') == 'Target 2 in the image of a camera'
        assert images.evaluate('(image) => image.decode().then(() => image.naturalWidth)') == 3
        tips = [shown.tip(70, 20), shown.tip(30, 20)]
        assert tips[0].startswith('sighting: 0.5 expected within 8 m, since 4 s, at (70, 20) m')
        assert tips[1].startswith('searched by others, probability of detection 0.7, since 5 s')


def post(server, body, token=None, path='report'):
    request = urllib.request.Request(
        f'http://127.0.0.1:{server.port}/{path}',
        json.dumps(body).encode(),
        {'X-Maasi-Token': server.token if token is None else token},
    )
    try:
        with urllib.request.urlopen(request) as reply:
            return reply.status, json.load(reply)['message']
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)['message']


REVIEW = {'report': 'review_target', 'id': 1, 'confirmed': True, 'reliability': 0.9}
SIGHTING = {'report': 'add_sighting', 'position': [1, 2.5], 'radius': 3, 'weight': 0.5}


@pytest.mark.parametrize(
    ('body', 'text'),
    [
        ({}, 'report: allowed are review_target, add_sighting, mark_searched'),
        ({'report': ['x']}, 'report: allowed are'),
        ({**REVIEW, 'id': 1.5}, 'id: allowed is a whole number'),
        ({**REVIEW, 'id': True}, 'id: allowed is a whole number'),
        ({**REVIEW, 'id': -1}, 'id: allowed is the number of a found target'),
        ({**REVIEW, 'confirmed': 1}, 'confirmed: allowed is true or false'),
        ({**REVIEW, 'source': 3}, 'source: allowed is text'),
        ({**REVIEW, 'team': '../x'}, 'team: allowed is the namespace of a filter'),
        ({**SIGHTING, 'position': [1]}, 'position: allowed is two numbers'),
        ({**SIGHTING, 'position': [1, 'x']}, 'position: allowed is two numbers'),
        ({**SIGHTING, 'radius': None}, 'radius: allowed is a number'),
        ({**SIGHTING, 'radius': 10**400}, 'radius: allowed is a number of at most 300 digits'),
        ({**SIGHTING, 'position': [10**400, 0]}, 'position: allowed is a number of at most'),
        ({**SIGHTING, 'source': 'A\0nn'}, 'source: allowed is text without control characters'),
        ({**REVIEW, 'source': '\ud800'}, 'source: allowed is text without control characters'),
        ({'report': 'mark_searched', 'zone': 3}, 'zone: allowed is text'),
    ],
)
def test_bad_statements_are_refused_by_name(served, body, text):
    server, commander = served
    status, message = post(server, body)
    assert status == 400 and message.startswith(text)
    assert commander.requests == []


def test_statements_need_the_token_and_a_page_with_controls(served):
    server, commander = served
    assert post(server, REVIEW, 'wrong') == (403, 'wrong token')
    assert post(server, REVIEW) == (200, 'it is counted')
    assert commander.requests == [read_report(REVIEW)]
    with closing(ViewServer(Hub(SCENE), 0)) as silent:
        assert post(silent, REVIEW)[0] == 403


def test_the_filters_receive_a_statement(domain, context):
    received = []

    def answer_of(name):
        def answer(request, response):
            received.append((name, request))
            response.success, response.message = True, name
            return response

        return answer

    node = rclpy.create_node('filters', context=context)
    kinds = {'review_target': ReviewTarget, 'add_sighting': AddSighting}
    kinds['mark_searched'] = MarkSearched
    for space in ('/a', '/b'):
        for name, kind in kinds.items():
            service = f'{space}/search/{name}'
            node.create_service(kind, service, answer_of(service))
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    spinner = threading.Thread(target=executor.spin)
    spinner.start()
    control = Control(domain.number)
    try:
        assert control.report(read_report({**REVIEW, 'team': 'b'})) == (
            True,
            '/b/search/review_target',
        )
        done, text = control.report(read_report(SIGHTING))
        assert done and text == '/a/search/add_sighting; /b/search/add_sighting'
    finally:
        control.close()
        executor.shutdown()
        spinner.join()
    wait_until(lambda: len(received) == 3, lambda: None)
    assert (received[0][1].id, received[0][1].confirmed) == (1, True)
    assert {(item.position.x, item.position.y, item.radius) for _, item in received[1:]} == {
        (1.0, 2.5, 3.0)
    }
    assert control.report(read_report(REVIEW)) == (False, 'the run has ended')
