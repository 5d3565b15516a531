"""Nodes as processes, forked from a server that has loaded the shared modules."""

import contextlib
import ctypes
import gc
import importlib
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import Pipe, forkserver, resource_tracker, util
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from setproctitle import getproctitle, setproctitle

_PR_SET_PDEATHSIG = 1
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Nodes of other packages are executed and inherit nothing.
_PACKAGES = ('maasi_filter', 'maasi_planner', 'maasi_drivers', 'maasi_sim')
# Set for the server only: the process that started it.
_STARTED_BY = 'MAASI_NODE_SERVER_OF'
# One thread per linear algebra library: there is one process per node, and a process with several
# threads must not be forked.
_ENVIRONMENT = {
    'PYTHONUNBUFFERED': '1',
    'OMP_NUM_THREADS': '1',
    'OPENBLAS_NUM_THREADS': '1',
    'MKL_NUM_THREADS': '1',
}
# Unix socket addresses have at most 107 bytes; multiprocessing adds 32 to the folder.
_LONGEST_FOLDER = 75
_LEAST_START = 0.5  # a heartbeat this soon after a restart is from the previous process [s]
# Shutdown signals and their timeouts [s].
ENDING = ((signal.SIGINT, 5.0), (signal.SIGTERM, 2.0), (signal.SIGKILL, 5.0))


class ProcessError(RuntimeError):
    """A process cannot be started."""


def start_server() -> None:
    """Start the server, which loads the shared modules in the background."""
    forkserver.set_forkserver_preload([__name__])
    resource_tracker.ensure_running()
    for key, value in _ENVIRONMENT.items():
        os.environ.setdefault(key, value)
    os.environ[_STARTED_BY] = str(os.getpid())
    # Ctrl-C in the terminal must not reach the server before it has its own session.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    folder = tempfile.gettempdir()
    try:
        # The path of the folder of the server's socket must not be too long.
        if len(os.fsencode(folder)) > _LONGEST_FOLDER:
            tempfile.tempdir = '/tmp'
        util.get_temp_dir()
        forkserver.ensure_running()
    finally:
        tempfile.tempdir = folder
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        del os.environ[_STARTED_BY]


def wait_for_server() -> None:
    """Return once the server has loaded the shared modules."""
    process = ForkServerProcess(target=int)
    try:
        process.start()
    except (OSError, EOFError) as error:
        raise ProcessError('the node server has ended; its error is above') from error
    process.join()


def _load(started_by: int) -> None:
    # setproctitle must run before the environment changes.
    getproctitle()
    os.setsid()
    _die_with(started_by)
    # Nodes inherit these modules.
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    gc.disable()
    # Not rclpy, which starts threads.
    importlib.import_module('maasi_sim.run.warm_up').prepare_nodes()
    # Nodes share this memory, so it is never collected.
    gc.freeze()
    gc.enable()


def _die_with(parent: int) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


def find_executable(package: str, executable: str) -> Path:
    """Return the file that `ros2 run package executable` runs."""
    try:
        folder = Path(get_package_prefix(package)) / 'lib' / package
    except PackageNotFoundError:
        raise ProcessError(f'package {package} is not installed: source the workspace') from None
    path = folder / executable
    if not os.access(path, os.X_OK):
        raise ProcessError(f'package {package} has no executable {executable} in {folder}')
    return path


def in_background(function: Callable[..., None], *arguments: Any) -> Iterator[Any]:
    """Run a function in a fork of the server and yield what it sends through its last argument."""
    receives, sends = Pipe(duplex=False)
    words = (function, *arguments, sends.send)
    with sends, contextlib.suppress(OSError, EOFError):
        ForkServerProcess(target=_call, args=words, daemon=True).start()
    return _received(receives)


def _call(function: Callable[..., None], *arguments: Any) -> None:
    _die_with(_server)
    function(*arguments)


def _received(connection: Connection) -> Iterator[Any]:
    with contextlib.suppress(EOFError):
        while True:
            yield connection.recv()


class NodeProcess(ForkServerProcess):
    """A node as a process that ends with this one; times are wall times [s].

    Before its executor's first heartbeat (1 Hz) the node is starting and may be compiling.
    """

    def __init__(self, name: str, command: list[str], log: Path) -> None:
        super().__init__(name=name)
        self.command, self.log = command, log
        self.restarts = 0
        self.started = 0.0
        #: Time of the last heartbeat, and the processor waiting time until then.
        self.beaten: float | None = None
        self._waited = 0.0

    def start(self) -> None:
        """Start it."""
        self._environment = dict(os.environ)
        try:
            start_server()
            super().start()
        except (OSError, EOFError) as error:
            raise ProcessError(f'{self.name}: cannot be started: {error}') from error
        self.started, self.beaten = time.monotonic(), None

    def restart(self) -> None:
        """Restart it after it died."""
        self.restarts += 1
        with contextlib.suppress(OSError), self.log.open('ab') as output:
            output.write(f'--- start number {self.restarts + 1} ---\n'.encode())
        # A process object can be started only once.
        self.join()
        super().__init__(name=self.name)
        self.start()

    def run(self) -> None:
        """Become the node: an independent process that ends with the server."""
        os.setsid()
        _die_with(_server)
        try:
            output = os.open(self.log, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError:
            # The disk is full; run without a log.
            output = os.open(os.devnull, os.O_WRONLY)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for source, target in ((nothing, 0), (output, 1), (output, 2)):
            os.dup2(source, target)
        os.environ.clear()
        os.environ.update(self._environment)
        executable = Path(self.command[0])
        if executable.parent.name not in _PACKAGES:
            for number in (signal.SIGPIPE, signal.SIGXFSZ):
                signal.signal(number, signal.SIG_DFL)
            os.execv(self.command[0], self.command)
        sys.argv = list(self.command)
        setproctitle(' '.join(self.command))
        commands = importlib.import_module(f'{executable.parent.name}_entry')
        sys.exit(getattr(commands, executable.name)())

    def signal(self, number: int) -> None:
        """Send a signal if it is running."""
        if self.is_alive() and self.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def beat(self, now: float) -> None:
        """Note a heartbeat."""
        first = self.beaten is None and self.restarts
        if not first or now - self.started >= _LEAST_START:
            self.beaten, self._waited = now, waited_for_processor(self.pid)

    def hangs(self, now: float, limit: float) -> bool:
        """Return whether heartbeats have been missing for a time, without waits for a processor."""
        if self.beaten is None or now - self.beaten <= limit:
            return False
        waited = waited_for_processor(self.pid) - self._waited
        return now - self.beaten - waited > limit

    def how_it_ended(self) -> str:
        """Return how it ended, as text."""
        code = self.exitcode
        if code is None:
            return 'is running'
        if code >= 0:
            return f'exited with {code}'
        try:
            return f'was killed by {signal.Signals(-code).name}'
        except ValueError:
            return f'was killed by signal {-code}'

    def last_words(self, lines: int = 12) -> str:
        """Return the last lines of its log."""
        try:
            text = self.log.read_text(encoding='utf-8', errors='replace')
        except OSError:
            return ''
        return '\n'.join(text.splitlines()[-lines:])


def waited_for_processor(pid: int | None) -> float:
    """Return how long the main thread of a process was runnable but not running [s]."""
    try:
        return 1e-9 * int(Path(f'/proc/{pid}/schedstat').read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0


def stop(processes: Sequence[NodeProcess]) -> list[str]:
    """Stop processes with increasingly strong signals; return the names of those killed."""
    for number, patience in ENDING:
        rest = [process for process in processes if process.is_alive()]
        for process in rest:
            process.signal(number)
        deadline = time.monotonic() + patience
        while any(process.is_alive() for process in rest) and time.monotonic() < deadline:
            time.sleep(0.005)
    return [process.name for process in rest]  # the last signal is SIGKILL


if _STARTED_BY in os.environ:
    _load(int(os.environ.pop(_STARTED_BY)))
#: Parent process of a node: it was forked from the process that loaded this module first.
_server = os.getpid()
