"""Serves the page of a live run, its events, and its controls if enabled.

GET / is the page, GET /events a stream of Server-Sent Events, POST /control a command, POST /report
a statement of a person for the filter. These two always need a token, the rest unless the server
listens on this machine only. Each browser has its own thread, so that it delays neither the run nor
other browsers.
"""

import contextlib
import errno
import hmac
import ipaddress
import json
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from maasi_sim.run.view.event_log import STATE_PERIOD, Event, Scene, line, thin
from maasi_sim.run.view.page_file import empty_page
from maasi_sim.run.view.report_request import read_report

PORT = 8420
_MORE_PORTS = 20  # further ports to try if one is in use
# Executes a command for a robot (None: all); returns success and answer.
Commander = Callable[[str, 'str | None'], 'tuple[bool, str]']
COMMANDS = ('start', 'pause', 'resume', 'home', 'stop', 'release')
MOST_BROWSERS = 32  # most browsers at a time
MOST_IDLE = 64  # most other connections at a time; beyond that the oldest is closed
# Largest request body [bytes], and longest wait for a browser to read or write [s].
LARGEST_BODY = 4096
PATIENCE = 10.0
_EVERYWHERE = ('0.0.0.0', '::')
# Period of event portions, which limits a browser's load, and of keep-alive comments [s].
_PORTION_PERIOD = 0.1
_BEAT = 5.0
# Most events kept, above which gradual changes are thinned, and most events per portion.
MOST_EVENTS = 200_000
_MOST_AT_ONCE = 2000


class Hub:
    """Keeps the events of a run, about `most`, without waiting for browsers."""

    def __init__(self, scene: Scene, most: int = MOST_EVENTS) -> None:
        self._scene = dict(scene)
        self._most = most
        self._events: list[Event] = []
        self._period = STATE_PERIOD
        self._generation = 0
        self._closed = False
        self._changed = threading.Condition()

    def put(self, event: Event) -> None:
        """Add an event."""
        with self._changed:
            if event[1] == 'scene':
                self._scene.update(event[3])
            self._events.append(event)
            if len(self._events) > self._most:
                self._thin()
            self._changed.notify_all()

    def restart(self, scene: Scene) -> None:
        """Drop all events: another run begins."""
        with self._changed:
            self._scene = dict(scene)
            self._events.clear()
            self._generation += 1

    def close(self) -> None:
        """Mark the end of the events."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def next(
        self, generation: int, position: int, patience: float
    ) -> tuple[str, tuple[int, int], bool]:
        """Return Server-Sent Events after a position, the next position, and whether it is the end.

        A browser begins with generation -1 and receives the scene again when the generation
        changes. Without new events within `patience` [s] it receives a comment.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: (
                    self._closed or generation != self._generation or position < len(self._events)
                ),
                patience,
            )
            text = ''
            if generation != self._generation:
                text, position = f'event: scene\ndata: {line(self._scene)}\n\n', 0
            events = self._events[position : position + _MOST_AT_ONCE]
            position += len(events)
            closed = self._closed and position == len(self._events)
            generation = self._generation
        # Outside of the lock, as a large portion takes a while.
        if events:
            text += f'event: events\ndata: [{",".join(map(line, events))}]\n\n'
        if closed:
            text += 'event: end\ndata:\n\n'
        return text or ': \n\n', (generation, position), closed

    def _thin(self) -> None:
        while len(self._events) > 0.9 * self._most and self._period < 1e5:
            self._period *= 2.0
            self._events = thin(self._events, self._period)
        # If nothing can be thinned, drop the oldest events.
        del self._events[: max(0, len(self._events) - self._most)]
        self._scene['thinned'] = self._period
        self._generation += 1


class ViewServer(ThreadingHTTPServer):
    """Serves a hub to browsers until it is closed; read only without a `commander`.

    Takes the next free port (0: any); raises OSError if it cannot listen on the address.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(
        self,
        hub: Hub,
        port: int | None = None,
        host: str = '127.0.0.1',
        commander: Commander | None = None,
    ) -> None:
        self.hub, self.host, self.commander = hub, host, commander
        number = _number(host)
        # Whether only this machine can connect.
        self.is_private = host == 'localhost' or (number is not None and number.is_loopback)
        self.token = '' if self.is_private and commander is None else secrets.token_urlsafe(16)
        self.wanted_port = PORT if port is None else port
        self.browsers = 0
        self._lock = threading.Lock()
        # Connections without a stream or command, the oldest first.
        self._idle: dict[socket.socket, None] = {}
        last = min(self.wanted_port + _MORE_PORTS, 65535)
        for wanted in range(self.wanted_port, last + 1):
            try:
                super().__init__((host, wanted), _Handler)
                break
            except OSError as error:
                if error.errno != errno.EADDRINUSE or wanted == last:
                    raise
        self.port = int(self.server_address[1])  # listening port
        threading.Thread(target=self.serve_forever, name='view server', daemon=True).start()

    @property
    def address(self) -> str:
        """Address of the page, with its token if one is needed."""
        host = _own_address() if self.host in _EVERYWHERE else self.host
        host = f'[{host}]' if ':' in host else host
        place = f'http://{host}:{self.port}/'
        return f'{place}?token={self.token}' if self.token else place

    def close(self) -> None:
        """Stop serving after a short time for browsers to receive the rest."""
        self.hub.close()
        self.shutdown()
        self.server_close()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in its own thread; close the oldest if there are too many."""
        with self._lock:
            self._idle[request] = None
            oldest = next(iter(self._idle)) if len(self._idle) > MOST_IDLE else None
            if oldest is not None:
                del self._idle[oldest]
        if oldest is not None:
            # Its thread wakes and ends.
            with contextlib.suppress(OSError):
                oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        self.keep(request)
        super().shutdown_request(request)

    def keep(self, connection: Any, browsers: int = 0) -> bool:
        """Keep a command or the streams of some browsers open; return whether there is capacity."""
        with self._lock:
            self._idle.pop(connection, None)
            if self.browsers + browsers > MOST_BROWSERS:
                return False
            self.browsers += browsers
            return True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of browsers."""


def _number(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host)
    return None


def _own_address() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Address of a documentation network: only its route is looked up, nothing is sent.
            probe.connect(('192.0.2.1', 9))
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()


def _command_of(body: Mapping[str, Any]) -> tuple[str, str | None]:
    command, robot = body.get('command'), body.get('robot')
    if command not in COMMANDS:
        raise ValueError(f'command: allowed are {", ".join(COMMANDS)}')
    if robot is not None and not (isinstance(robot, str) and robot.isidentifier()):
        raise ValueError('robot: allowed is a robot name or null')
    return str(command), robot


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    server_version = 'maasi'
    sys_version = ''
    protocol_version = 'HTTP/1.1'
    timeout = PATIENCE

    def do_GET(self) -> None:
        """Answer with the page or the stream of events."""
        if not self._is_for_this_host():
            return
        path = urlsplit(self.path).path
        given = parse_qs(urlsplit(self.path).query).get('token', [''])[-1]
        if not (self.server.is_private or self._has_token(given)):
            self._refuse(HTTPStatus.FORBIDDEN, 'wrong token: use the full link that was printed')
        elif path == '/':
            self._answer(HTTPStatus.OK, empty_page().encode(), 'text/html; charset=utf-8')
        elif path == '/events':
            self._stream()
        else:
            self._refuse(HTTPStatus.NOT_FOUND, 'no such page')

    def do_POST(self) -> None:
        """Carry out a command, or pass a statement to the filters."""
        # The rest of a refused request is not read.
        self.close_connection = True
        if not self._is_for_this_host():
            return
        path = urlsplit(self.path).path
        if path not in ('/control', '/report'):
            self._refuse(HTTPStatus.NOT_FOUND, 'no such page')
            return
        commander: Any = self.server.commander
        if commander is None:
            self._refuse(
                HTTPStatus.FORBIDDEN, 'read only: start the run with --control to send commands'
            )
        elif not self._has_token(self.headers.get('X-Maasi-Token', '')):
            self._refuse(HTTPStatus.FORBIDDEN, 'wrong token')
        else:
            body = self._read_body()
            if body is None:
                return
            try:
                request = read_report(body) if path == '/report' else _command_of(body)
            except ValueError as error:
                self._refuse(HTTPStatus.BAD_REQUEST, str(error))
                return
            self.server.keep(self.connection)
            answer = commander.report(request) if path == '/report' else commander(*request)
            self._report(HTTPStatus.OK, *answer)

    def _read_body(self) -> dict[str, Any] | None:
        length, body = self.headers.get('Content-Length', ''), None
        if not (length.isascii() and length.isdecimal()):
            self._refuse(HTTPStatus.LENGTH_REQUIRED, 'Content-Length: allowed is a number')
            return None
        if int(length) > LARGEST_BODY:
            too_large = HTTPStatus.REQUEST_ENTITY_TOO_LARGE
            self._refuse(too_large, f'allowed are {LARGEST_BODY} bytes at most')
            return None
        with contextlib.suppress(ValueError, RecursionError):
            body = json.loads(self.rfile.read(int(length)))
        if isinstance(body, dict):
            return body
        self._refuse(HTTPStatus.BAD_REQUEST, 'allowed is a JSON object')
        return None

    def _has_token(self, given: str) -> bool:
        token = self.server.token
        return hmac.compare_digest(given.encode('utf-8', 'replace'), token.encode())

    def _is_for_this_host(self) -> bool:
        """Refuse requests with another host name (DNS rebinding)."""
        host, own = self.server.host, socket.gethostname()
        name = urlsplit(f'//{self.headers.get("Host", "")}').hostname or ''
        allowed = name in (host, 'localhost', '127.0.0.1', '::1')
        # A server on all addresses accepts each address as a number.
        if host in _EVERYWHERE:
            allowed = allowed or name in (own, f'{own}.local') or _number(name) is not None
        if not allowed:
            self._refuse(HTTPStatus.FORBIDDEN, 'Host: allowed is the printed address')
        return allowed

    def _stream(self) -> None:
        self.close_connection = True
        if not self.server.keep(self.connection, 1):
            self._refuse(
                HTTPStatus.SERVICE_UNAVAILABLE, f'{MOST_BROWSERS} browsers are already connected'
            )
            return
        try:
            self._begin(HTTPStatus.OK, 'text/event-stream', {})
            self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            begin, closed = (-1, 0), False
            while not closed:
                text, begin, closed = self.server.hub.next(*begin, _BEAT)
                self.wfile.write(text.encode())
                time.sleep(0.0 if closed else _PORTION_PERIOD)
        except OSError:
            pass  # the client disconnected or does not read
        finally:
            self.server.keep(self.connection, -1)

    def _refuse(self, status: HTTPStatus, text: str) -> None:
        self.close_connection = True
        self._report(status, False, text)

    def _report(self, status: HTTPStatus, done: bool, text: str) -> None:
        content = json.dumps({'done': done, 'message': text})
        self._answer(status, content.encode(), 'application/json')

    def _answer(self, status: HTTPStatus, content: bytes, kind: str) -> None:
        with contextlib.suppress(OSError):
            self._begin(status, kind, {'Content-Length': str(len(content))})
            self.wfile.write(content)

    def _begin(self, status: HTTPStatus, kind: str, headers: Mapping[str, str]) -> None:
        self.send_response(status)
        fixed = {'X-Content-Type-Options': 'nosniff', 'Referrer-Policy': 'no-referrer'}
        fixed |= {'Content-Type': kind, 'Cache-Control': 'no-store'}
        for name, value in {**fixed, **headers}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log no requests."""
