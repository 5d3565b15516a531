"""The server of a live page: what browsers get, what is refused, and that none slows a run."""

import contextlib
import http.client
import json
import os
import pty
import re
import socket
import sys
import threading
import time
import urllib.request
from urllib.parse import urlsplit

import pytest
from waiting import PATIENCE, wait_until

from maasi_sim.run.view import live_view
from maasi_sim.run.view import server as server_module
from maasi_sim.run.view.event_log import STATE_PERIOD
from maasi_sim.run.view.live_view import LiveView
from maasi_sim.run.view.server import LARGEST_BODY, Hub, ViewServer

SCENE = {'name': 'test', 'robots': {}, 'bounds': [[0, 1], [0, 1]]}


def state(index):
    return [index * STATE_PERIOD, 'robot', 'rover', [float(index), 0.0, 0.0, 0.0], 1.0, 1, '']


@pytest.fixture
def server():
    made = ViewServer(Hub(SCENE), 0)
    yield made
    made.close()


def ask(server, method, path, body=None, headers=None):
    connection = http.client.HTTPConnection('127.0.0.1', server.port, timeout=PATIENCE)
    try:
        connection.request(method, path, body, headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


class Browser:
    def __init__(self, server):
        self.connection = socket.create_connection(('127.0.0.1', server.port), timeout=PATIENCE)
        self.connection.sendall(b'GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n')
        self.file = self.connection.makefile('rb')
        self.head = list(iter(self.file.readline, b'\r\n'))
        self.scenes, self.events, self.ended = [], [], False

    def until(self, number=0):
        kind, deadline = None, time.monotonic() + PATIENCE
        while not self.ended and not 0 < number <= len(self.events):
            line = self.file.readline().decode()
            # Signs of life come for ever.
            assert line and time.monotonic() < deadline
            line = line.rstrip('\n')
            if line.startswith('event: '):
                kind = line.removeprefix('event: ')
                self.ended = kind == 'end'
            elif line.startswith('data:') and kind == 'scene':
                self.scenes.append(json.loads(line[5:]))
                self.events.clear()
            elif line.startswith('data:') and kind == 'events':
                self.events += json.loads(line[5:])

    def close(self):
        self.file.close()
        self.connection.close()


def test_a_browser_that_reads_nothing_holds_up_nobody_and_a_late_one_gets_everything(server):
    stuck = Browser(server)
    for index in range(5_000):
        server.hub.put([float(index), 'log', '', 'team', 'rover', 'x' * 3000])
    late = Browser(server)
    late.until(5_000)
    assert late.scenes == [SCENE]
    server.hub.close()
    late.until()
    for browser in (late, stuck):
        browser.close()
    wait_until(lambda: server.browsers == 0)


def test_a_long_run_is_thinned_and_browsers_begin_anew():
    hub = Hub(SCENE, most=1000)
    for index in range(1500):
        hub.put(state(index))
        if index % 100 == 0:
            hub.put([index * STATE_PERIOD, 'log', '', 'found', 'rover', 'target'])
    text, _, _ = hub.next(0, 900, 0.0)
    scene, events = map(json.loads, re.findall('^data: (.*)$', text, re.MULTILINE))
    assert scene['thinned'] > STATE_PERIOD
    assert sum(event[1] == 'log' for event in events) == 15
    assert len(events) <= 1000 and events[-1] == state(1499)


def test_there_are_only_so_many_browsers_and_half_open_connections_make_room(server, monkeypatch):
    # None is closed because it is slow.
    monkeypatch.setattr(server_module._Handler, 'timeout', None)
    monkeypatch.setattr(server_module, 'MOST_BROWSERS', 4)
    monkeypatch.setattr(server_module, 'MOST_IDLE', 8)
    browsers = [Browser(server) for _ in range(4)]
    assert all(b' 200 ' in browser.head[0] for browser in browsers)
    assert b' 503 ' in Browser(server).head[0]
    for browser in browsers[1:]:
        browser.close()
    threads = threading.active_count()
    place = ('127.0.0.1', server.port)
    held = [socket.create_connection(place, timeout=PATIENCE) for _ in range(24)]
    # The oldest were closed, and their threads ended.
    assert held[0].recv(1) == b'' and held[8].recv(1) == b''
    wait_until(lambda: threading.active_count() <= threads + 8)
    # One that breaks off harms nothing.
    held[-1].sendall(b'POST /control HTTP/1.1\r\nContent-Le')
    for connection in held:
        connection.close()
    assert ask(server, 'GET', '/')[0] == 200
    server.hub.put(state(0))
    browsers[0].until(1)
    browsers[0].close()


@pytest.fixture
def public():
    """Return a page that other machines see."""
    view = LiveView(SCENE, 0, '0.0.0.0')
    yield view
    view.close()


def test_other_machines_need_the_whole_link(public, capsys):
    server = public.server
    link = urlsplit(server.address)
    assert link.hostname not in ('0.0.0.0', '127.0.0.1') and link.query == f'token={server.token}'
    public.announce(print)
    said = capsys.readouterr().out
    assert f'view: {server.address}\n' in said and 'other machines' in said
    for path in ('/', '/events', '/?token=', '/?token=wrong'):
        status, text = ask(server, 'GET', path)
        assert status == 403 and 'wrong token' in text
    # By a number or by its own name, but by no name that others made point here.
    own = socket.gethostname()
    for host, status in (('127.0.0.1', 200), ('192.0.2.7', 200), (own, 200), ('evil.example', 403)):
        assert ask(server, 'GET', f'/?{link.query}', headers={'Host': host})[0] == status
    assert ask(server, 'POST', '/control', '{}', {'X-Maasi-Token': server.token})[0] == 403


def test_where_a_port_is_in_use_the_next_one_is_taken_and_said(server, capsys):
    view = LiveView(SCENE, server.port)
    view.announce(print)
    view.close()
    assert server.port < view.server.port <= server.port + 20
    said = capsys.readouterr().out
    assert f'port {server.port} is in use: using port {view.server.port}' in said


STAYING = """
from maasi_sim.run.view.live_view import LiveView
page = LiveView({'name': 'test', 'robots': {}}, 0)
page.announce(print, browser=False)
page.finish('the run has ended')
page.wait_for_reader(print)
page.close()
print('gone')
"""


def test_a_finished_page_stays_in_a_terminal_until_enter():
    command = [sys.executable, '-c', STAYING]
    child, terminal = pty.fork()
    if child == 0:
        os.execv(command[0], command)
    with open(terminal, 'r+b', buffering=0) as shown, contextlib.suppress(OSError):
        said = b''
        while b'Enter' not in said:
            said += shown.read(1000)
        address = re.search(rb'view: (http\S+)', said).group(1).decode()
        for _ in range(2):
            with urllib.request.urlopen(f'{address}events', timeout=PATIENCE) as stream:
                text = stream.read().decode()
            assert 'the run has ended' in text and 'event: end' in text
        shown.write(b'\n')
        while True:
            said += shown.read(1000)
    assert said.endswith(b'gone\r\n')
    assert os.waitpid(child, 0)[1] == 0


def test_the_page_is_served_and_nothing_else(server):
    status, page = ask(server, 'GET', '/')
    assert status == 200 and page.startswith('<!DOCTYPE html>') and '?' not in server.address
    for path in ('/page.css', '/../server.py', '/..%2f..%2fetc/passwd', '//etc/passwd', '/%00'):
        assert ask(server, 'GET', path)[0] == 404
    status, text = ask(server, 'POST', '/control', '{"command": "stop"}')
    assert status == 403 and 'read only' in text
    status, text = ask(server, 'GET', '/', headers={'Host': 'attacker.example'})
    assert status == 403 and 'Host' in text


def test_commands_are_carried_out_with_the_token_and_wrong_ones_refused():
    calls = []

    def commander(*command):
        calls.append(command)
        return True, 'paused'

    def command(body, **headers):
        given = {name.replace('_', '-').title(): value for name, value in headers.items()}
        return ask(made, 'POST', '/control', body, {'X-Maasi-Token': made.token, **given})

    made = ViewServer(Hub(SCENE), 0, commander=commander)
    assert made.token in made.address
    for token in ('', 'wrong'):
        assert command('{"command": "pause", "robot": "rover"}', x_maasi_token=token)[0] == 403
    for body in (
        *('{', '[' * 4000, 'null', '{"command": "launch"}', '{"command": ["stop"]}'),
        *('{"command": "stop", "robot": "../../other"}', '{"command": "stop", "robot": 7}'),
    ):
        assert command(body)[0] == 400, body
    assert command('x' * (LARGEST_BODY + 1))[0] == 413
    # Of unknown or huge length: not read.
    for length, status in (('', 411), ('-1', 411), ('99999999999', 413)):
        assert command('', content_length=length)[0] == status
    assert calls == []
    names = ('start', 'pause', 'resume', 'home', 'stop', 'release')
    words = [(word, robot) for word in names for robot in ('rover', None)]
    for word, robot in words:
        status, text = command(json.dumps({'command': word, 'robot': robot}))
        assert status == 200 and json.loads(text) == {'done': True, 'message': 'paused'}
    assert calls == words
    made.close()


def test_a_page_holds_up_nobody_drops_what_is_too_much_and_survives_what_it_cannot_show(
    monkeypatch,
):
    monkeypatch.setattr(live_view, 'MOST_WAITING', 10)
    view, go, taken = LiveView(SCENE, 0), threading.Event(), []
    for index in range(1000):
        view.put(lambda _, index: (go.wait(), taken.append(1 / index)), index)
    go.set()
    view.close()
    assert taken[0] == 1.0 and len(taken) <= 10
