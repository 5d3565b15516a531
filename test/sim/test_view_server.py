"""The server of a live page: what browsers get, what is refused, and that none slows a run."""

import http.client
import json
import re
import socket
import threading
import time
from urllib.parse import urlsplit

import pytest
from browsers import chromium, needs_chromium
from waiting import wait_until

from maasi_sim.view.event_log import STATE_PERIOD
from maasi_sim.view.live_view import LiveFeed, LiveView
from maasi_sim.view.server import LARGEST_BODY, MOST_BROWSERS, MOST_IDLE, Hub, ViewServer

PATIENCE = 20.0


def state(index):
    return [index * STATE_PERIOD, 'robot', 'rover', [float(index), 0.0, 0.0, 0.0], 1.0, 1, '']


@pytest.fixture
def hub():
    return Hub({'name': 'test', 'robots': {}})


@pytest.fixture
def server(hub):
    made = ViewServer(hub, 0)
    yield made
    made.close()


@pytest.fixture
def commanded(hub):
    """Return a function that commands a server with its token, and what was carried out."""
    calls = []

    def commander(*command):
        calls.append(command)
        return True, 'paused'

    def command(body, headers=None, length=None):
        headers = {'X-Maasi-Token': made.token} if headers is None else headers
        if length is not None:
            headers['Content-Length'] = length
        return ask(made, 'POST', '/control', body, headers)

    made = ViewServer(hub, 0, commander=commander)
    assert made.token in made.address
    yield command, calls
    made.close()


def ask(server, method, path, body=None, headers=None):
    """Return status and body of an answer."""
    connection = http.client.HTTPConnection('127.0.0.1', server.port, timeout=PATIENCE)
    try:
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def send(server, data, reads=True):
    """Send bytes, and return what is answered until the connection ends."""
    with socket.create_connection(('127.0.0.1', server.port), timeout=PATIENCE) as connection:
        connection.sendall(data)
        answer = b''
        while reads and (part := connection.recv(65536)):
            answer += part
    return answer


class Browser:
    """Reads a stream of events."""

    def __init__(self, server):
        self.connection = socket.create_connection(('127.0.0.1', server.port), timeout=PATIENCE)
        self.connection.sendall(b'GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n')
        self.file = self.connection.makefile('rb')
        self.head = list(iter(self.file.readline, b'\r\n'))
        self.scenes = []
        self.events = []

    def read(self):
        """Return the kind of the next message."""
        kind = None
        while True:
            line = self.file.readline().decode().rstrip('\n')
            if line.startswith('event: '):
                kind = line.removeprefix('event: ')
            elif line.startswith('data:') and kind == 'scene':
                self.scenes.append(json.loads(line[5:]))
                self.events.clear()
            elif line.startswith('data:') and kind == 'events':
                self.events += json.loads(line[5:])
            elif not line and kind:
                return kind

    def until(self, number):
        while len(self.events) < number:
            self.read()

    def close(self):
        self.file.close()
        self.connection.close()


def test_a_late_browser_gets_the_whole_state_first(hub, server):
    for index in range(5000):
        hub.put(state(index))
    first, second = Browser(server), Browser(server)
    for browser in (first, second):
        browser.until(5000)
        assert browser.scenes == [{'name': 'test', 'robots': {}}]
        assert browser.events[-1] == state(4999)
    hub.put(state(5000))
    for browser in (first, second):
        browser.until(5001)
        browser.close()


def test_the_end_of_a_run_ends_the_stream(hub, server):
    browser = Browser(server)
    hub.put(state(0))
    hub.close()
    kinds = []
    while 'end' not in kinds:
        kinds.append(browser.read())
    assert browser.events == [state(0)]
    assert browser.file.read() == b''
    browser.close()


def test_a_browser_that_reads_nothing_holds_up_nobody(hub, server):
    stuck = Browser(server)
    reader = Browser(server)
    text = 'x' * 300
    for index in range(50_000):
        hub.put([float(index), 'log', '', 'team', 'rover', text])
    reader.until(50_000)
    for browser in (reader, stuck):
        browser.close()
    wait_until(lambda: hub.put(state(1)) or server.browsers == 0)


def test_a_long_run_is_thinned_and_browsers_begin_anew():
    hub = Hub({'name': 'long', 'robots': {}}, most=1000)
    for index in range(1500):
        hub.put(state(index))
        if index % 100 == 0:
            hub.put([index * STATE_PERIOD, 'log', '', 'found', 'rover', 'target'])
    text, _, _ = hub.next(0, 900, 0.0)
    scene, events = map(json.loads, re.findall('^data: (.*)$', text, re.MULTILINE))
    assert scene['thinned'] > STATE_PERIOD
    assert sum(event[1] == 'log' for event in events) == 15
    assert len(events) <= 1000 and events[-1] == state(1499)


def test_there_are_only_so_many_browsers(server):
    browsers = [Browser(server) for _ in range(MOST_BROWSERS)]
    status, _ = ask(server, 'GET', '/events')
    assert status == 503
    for browser in browsers:
        browser.close()


def test_half_open_connections_make_room(hub, server):
    reader = Browser(server)
    threads = threading.active_count()
    held = [
        socket.create_connection(('127.0.0.1', server.port), timeout=PATIENCE)
        for _ in range(3 * MOST_IDLE)
    ]
    # The oldest were closed, and their threads ended.
    assert held[0].recv(1) == b'' and held[MOST_IDLE].recv(1) == b''
    wait_until(lambda: threading.active_count() <= threads + MOST_IDLE)
    assert ask(server, 'GET', '/')[0] == 200
    hub.put(state(0))
    reader.until(1)
    for connection in (reader, *held):
        connection.close()


def test_other_machines_need_the_whole_link(hub, capsys):
    view = LiveView({'name': 'test', 'robots': {}}, 0, '0.0.0.0')
    server = view.server
    link = urlsplit(server.address)
    assert link.hostname not in ('0.0.0.0', '127.0.0.1') and link.query == f'token={server.token}'
    view.announce(print)
    said = capsys.readouterr().out
    assert f'view: {server.address}\n' in said and 'other machines see it' in said
    for path in ('/', '/events', '/?token=', '/?token=wrong'):
        status, text = ask(server, 'GET', path)
        assert status == 403 and 'whole link' in text
    assert ask(server, 'GET', f'/?{link.query}')[0] == 200
    # By a number or by its own name, but by no name that somebody made point here.
    for host, status in (('192.0.2.7', 200), (socket.gethostname(), 200), ('evil.example', 403)):
        assert ask(server, 'GET', f'/?{link.query}', headers={'Host': host})[0] == status
    assert ask(server, 'POST', '/control', '{}', {'X-Maasi-Token': server.token})[0] == 403
    view.close()


@needs_chromium
def test_a_browser_on_another_machine_gets_the_events_by_the_whole_link(hub):
    view = LiveView({'name': 'far', 'robots': {}, 'bounds': [[0, 1], [0, 1]]}, 0, '0.0.0.0')
    view.hub.put(state(3))
    with chromium() as shown:
        shown.open(view.server.address)
        shown.until("maasi.log.robots().includes('rover')")
    view.close()


def test_where_a_port_is_in_use_the_next_one_is_taken_and_said(server, capsys):
    view = LiveView({'name': 'test', 'robots': {}}, server.port)
    assert server.port < view.server.port <= server.port + 20
    view.announce(print)
    said = capsys.readouterr().out
    assert f'port {server.port} is in use: the page is at {view.server.port}' in said
    view.close()


def test_the_page_is_served_and_nothing_else(server):
    status, page = ask(server, 'GET', '/')
    assert status == 200 and page.startswith('<!DOCTYPE html>')
    for path in ('/page.css', '/../server.py', '/..%2f..%2fetc/passwd', '//etc/passwd', '/%00'):
        assert ask(server, 'GET', path)[0] == 404
    for method in ('PUT', 'DELETE', 'OPTIONS'):
        assert ask(server, method, '/')[0] == 501


@pytest.mark.parametrize(
    'data',
    [
        b'\x00\xff\x16\x03\x01 nonsense\r\n\r\n',
        b'GET\r\n\r\n',
        b'GET / HTTP/9.9\r\n\r\n',
        b'GET /' + b'a' * 100_000 + b' HTTP/1.1\r\n\r\n',
        b'GET / HTTP/1.1\r\n' + b'X: y\r\n' * 500 + b'\r\n',
    ],
)
def test_malformed_requests_are_refused(server, data):
    try:
        answer = send(server, data)
    except ConnectionError:
        # Refused before all of it was read.
        answer = b''
    assert b' 200 ' not in answer
    assert ask(server, 'GET', '/')[0] == 200


def test_another_host_name_is_refused(server):
    status, text = ask(server, 'GET', '/', headers={'Host': 'attacker.example'})
    assert status == 403 and 'Host' in text


def test_a_request_that_breaks_off_harms_nothing(server):
    send(server, b'POST /control HTTP/1.1\r\nContent-Le', reads=False)
    send(server, b'GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n', reads=False)
    assert ask(server, 'GET', '/')[0] == 200


def test_it_is_read_only_by_default(server):
    status, text = ask(server, 'POST', '/control', '{"command": "stop"}')
    assert status == 403 and 'read only' in text
    assert '?' not in server.address


def test_commands_are_carried_out_with_the_token(commanded):
    command, calls = commanded
    body = json.dumps({'command': 'pause', 'robot': 'rover'})
    for headers in ({}, {'X-Maasi-Token': 'wrong'}):
        assert command(body, headers)[0] == 403
    assert calls == []
    status, text = command(body)
    assert status == 200 and json.loads(text) == {'done': True, 'message': 'paused'}
    assert calls.pop() == ('pause', 'rover')
    for word in ('pause', 'resume', 'home', 'stop', 'release'):
        assert command(json.dumps({'command': word, 'robot': None}))[0] == 200
        assert calls.pop() == (word, None)


@pytest.mark.parametrize(
    ('body', 'length', 'status'),
    [
        ('{', None, 400),
        ('[' * 4000, None, 400),
        ('null', None, 400),
        ('{"command": "launch"}', None, 400),
        ('{"command": ["stop"]}', None, 400),
        ('{"command": "stop", "robot": "../../other"}', None, 400),
        ('{"command": "stop", "robot": 7}', None, 400),
        ('x' * (LARGEST_BODY + 1), None, 413),
        # Of unknown or huge length: not read.
        ('', '', 411),
        ('', '-1', 411),
        ('', '99999999999', 413),
    ],
)
def test_wrong_commands_are_refused(commanded, body, length, status):
    command, calls = commanded
    assert command(body, length=length)[0] == status
    assert calls == []


def test_a_feed_never_waits_and_says_what_it_dropped():
    taken = []
    feed = LiveFeed(lambda item: (time.sleep(0.01), taken.append(item)), most=10)
    begin = time.monotonic()
    for index in range(1000):
        feed.put(index)
    assert time.monotonic() - begin < 0.2
    feed.close()
    assert len(taken) + feed.dropped == 1000 and feed.dropped > 900


def test_a_feed_survives_what_it_cannot_take():
    taken = []
    feed = LiveFeed(lambda item: taken.append(1 / item))
    for item in (1, 0, 2):
        feed.put(item)
    feed.close()
    assert taken == [1.0, 0.5] and feed.refused == 1
