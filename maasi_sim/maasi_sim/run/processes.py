"""Processes of a run: a ROS domain, nodes that never outlive the run, shutdown in bounded time."""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from setproctitle import setproctitle

from maasi_sim.run.shared_memory import FIRST_PORT, PORTS_PER_DOMAIN, remove_dead

# Domains whose ports lie below the ephemeral ports of Linux (from 32768).
DOMAINS = range(0, 102)
_PR_SET_PDEATHSIG = 1
# Environment variable of the profiles of Fast DDS.
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
# Loaded at import: loading between fork and exec is not safe.
_libc = ctypes.CDLL(None)


class ProcessError(RuntimeError):
    """A process cannot be started, or no domain is free."""


class Domain:
    """A ROS domain that no other run on this host uses, until `release`.

    A domain, and a namespace in it, is locked by the name of an abstract Unix socket: it is valid
    for all users, makes no file, and ends with the process.

    Parameters
    ----------
    number : int, optional
        The domain to use; the first free one from 1 if not given (0 is the ROS default).
    purpose : str
        Locks of different purposes are independent.
    team : str
        Namespace of the run.
    shared : bool
        Whether other runs, in other namespaces, may use it as well.

    Raises
    ------
    ProcessError
        If the requested one is used by another run or not from 0 to 101, if none is free, or if
        the loopback interface, through which nodes discover each other, is down.
    """

    def __init__(
        self,
        number: int | None = None,
        purpose: str = 'run',
        *,
        team: str = '',
        shared: bool = False,
    ) -> None:
        # Deferred: it imports NumPy, whose threads keep a process from being forked.
        from maasi_filter.ros.loopback import loopback_fault

        if fault := loopback_fault():
            raise ProcessError(fault)
        self._purpose = purpose
        self._shared = shared
        self._locks: list[socket.socket] = []
        if number is not None and number not in DOMAINS:
            raise ProcessError(f'domain id: read {number}, allowed are 0 to {DOMAINS[-1]}')
        for candidate in DOMAINS[1:] if number is None else [number]:
            # A requested domain may be in use by other nodes.
            if number is None and _port_used(FIRST_PORT + PORTS_PER_DOMAIN * candidate):
                continue
            problem = self._take(candidate, team, shared)
            if not problem:
                self.number = candidate
                self._remove_dead()
                return
            if number is not None:
                raise ProcessError(f'domain id: {problem} is used by another run')
        raise ProcessError(f'no ROS domain from 1 to {DOMAINS[-1]} is free')

    def _take(self, number: int, team: str, shared: bool) -> str:
        """Lock a domain and a namespace in it; return the name of a taken one, else empty."""
        wanted = {} if shared else {f'{number}': f'{number}'}
        wanted[f'{number} {team}'] = f'namespace /{team} in {number}'
        for name, words in wanted.items():
            lock = self._lock(name)
            if lock is None:
                self._unlock()
                return words
            self._locks.append(lock)
        return ''

    def _lock(self, name: str) -> socket.socket | None:
        # A digest, as the names of sockets are short.
        digest = hashlib.sha256(f'{self._purpose} {name}'.encode()).hexdigest()
        lock = socket.socket(socket.AF_UNIX)
        try:
            lock.bind(f'\0maasi {digest}')
        except OSError:
            lock.close()
            return None
        return lock

    def environment(self) -> dict[str, str]:
        """Return the variables that keep nodes in this domain, and on this host.

        Without a profile of the user for Fast DDS, one with faster discovery is set.
        """
        variables = {
            'ROS_DOMAIN_ID': str(self.number),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        }
        if _PROFILES not in os.environ:
            variables[_PROFILES] = str(Path(__file__).with_name('discovery.xml'))
        return variables

    def release(self) -> None:
        """Release the domain; what killed nodes left in shared memory goes before."""
        self._remove_dead()
        self._unlock()

    def _remove_dead(self) -> None:
        # Nodes of other runs may be starting in a shared domain.
        remove_dead(None if self._shared else self.number)

    def _unlock(self) -> None:
        while self._locks:
            self._locks.pop().close()

    def __enter__(self) -> Domain:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Release it."""
        self.release()


def _port_used(port: int) -> bool:
    """Return whether some process on this host listens on a UDP port."""
    for table in ('/proc/net/udp', '/proc/net/udp6'):
        try:
            lines = Path(table).read_text().splitlines()[1:]
        except OSError:
            continue
        if any(int(line.split()[1].rpartition(':')[2], 16) == port for line in lines):
            return True
    return False


def find_executable(package: str, executable: str) -> Path:
    """Return the file that `ros2 run package executable` would run.

    Raises
    ------
    ProcessError
        If the package is not installed or has no such executable.
    """
    from ament_index_python.packages import PackageNotFoundError, get_package_prefix

    try:
        folder = Path(get_package_prefix(package)) / 'lib' / package
    except PackageNotFoundError:
        raise ProcessError(f'package {package} is not installed: source the workspace') from None
    path = folder / executable
    if not os.access(path, os.X_OK):
        raise ProcessError(f'package {package}: has no executable {executable} in {folder}')
    return path


def _die_with_parent(parent: int) -> None:
    """Let Linux kill this process when its parent ends for any reason."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


class ForkedProcess:
    """A copy of this process that runs a function; with the interface of `subprocess.Popen`.

    Imported modules and compiled kernels are inherited: a node starts in a tenth of the time.

    Parameters
    ----------
    function : callable
        To run; its result is the exit code.
    command : list of str
        Its `sys.argv`, also shown by `ps`.
    log : int
        File of its output.
    environment : dict
        Additional variables.
    """

    def __init__(
        self,
        function: Callable[[], Any],
        command: list[str],
        log: int,
        environment: Mapping[str, str],
    ) -> None:
        parent = os.getpid()
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        self.returncode: int | None = None
        if self.pid == 0:
            _run_and_exit(function, command, log, environment, parent)

    def poll(self) -> int | None:
        """Return the exit code, negative for a signal, or None while it runs."""
        if self.returncode is None:
            try:
                pid, status = os.waitpid(self.pid, os.WNOHANG)
            except ChildProcessError:
                # Another waitpid has reaped it.
                self.returncode = 0
            else:
                if pid:
                    self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, if it still runs."""
        if self.poll() is None:
            os.kill(self.pid, number)


def _run_and_exit(
    function: Callable[[], Any],
    command: list[str],
    log: int,
    environment: Mapping[str, str],
    parent: int,
) -> NoReturn:
    """Run as an independent process; never return to the code that forked it."""
    code: Any = 1
    try:
        os.setsid()
        _die_with_parent(parent)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for source, target in ((nothing, 0), (log, 1), (log, 2)):
            os.dup2(source, target)
        sys.stdout = open(1, 'w', buffering=1, encoding='utf-8', closefd=False)  # noqa: SIM115
        sys.stderr = open(2, 'w', buffering=1, encoding='utf-8', closefd=False)  # noqa: SIM115
        os.environ.update(environment)
        sys.argv = list(command)
        setproctitle(' '.join(command))
        code = function()
    except SystemExit as leaving:
        code = leaving.code
        if isinstance(code, str):
            with contextlib.suppress(OSError):
                print(code, file=sys.stderr)
    except BaseException:
        with contextlib.suppress(OSError):
            traceback.print_exc()
    finally:
        # Even if the disk is full, the forked process must not continue as the run.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        os._exit(code if isinstance(code, int) else 0 if code is None else 1)


def _single_threaded() -> bool:
    """Return whether this process may fork: locks of other threads would stay locked."""
    return len(os.listdir('/proc/self/task')) == 1


@dataclass
class NodeProcess:
    """A node that runs as a process and cannot outlive this one.

    Attributes
    ----------
    name : str
        Of the node, with namespace.
    command : list of str
        What is run.
    log : Path
        Of its output; kept over restarts.
    environment : dict
        Variables on top of this process's own.
    main : callable, optional
        The function that `command` runs, if loaded: the node is then forked from this process,
        unless that has several threads.
    restarts : int
        Number of restarts.
    """

    name: str
    command: list[str]
    log: Path
    environment: Mapping[str, str] = field(default_factory=dict)
    main: Callable[[], Any] | None = None
    restarts: int = 0
    _process: subprocess.Popen[bytes] | ForkedProcess | None = None

    def start(self) -> None:
        """Start it.

        Raises
        ------
        ProcessError
            If it cannot be.
        """
        parent = os.getpid()
        with self._output() as output:
            try:
                if self.main is not None and _single_threaded():
                    self._process = ForkedProcess(
                        self.main, self.command, output.fileno(), self.environment
                    )
                    return
                self._process = subprocess.Popen(
                    self.command,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, **self.environment},
                    # Own process group: Ctrl-C reaches only the run, which stops its nodes.
                    start_new_session=True,
                    preexec_fn=lambda: _die_with_parent(parent),
                )
            except OSError as error:
                raise ProcessError(f'{self.name}: cannot be started: {error}') from error

    def _output(self) -> BinaryIO:
        """Open the log; if that fails (disk full), the node runs without one."""
        try:
            return self.log.open('ab')
        except OSError:
            return open(os.devnull, 'ab')

    def restart(self) -> None:
        """Restart it after it died."""
        self.restarts += 1
        remove_dead()
        with contextlib.suppress(OSError), self.log.open('ab') as output:
            output.write(f'--- start number {self.restarts + 1} ---\n'.encode())
        self.start()

    @property
    def pid(self) -> int | None:
        """Number of the process."""
        return None if self._process is None else self._process.pid

    @property
    def code(self) -> int | None:
        """Exit code; negative: the signal that killed it; None while it runs."""
        return None if self._process is None else self._process.poll()

    @property
    def running(self) -> bool:
        """Whether it was started and has not ended."""
        return self._process is not None and self._process.poll() is None

    def signal(self, number: int) -> None:
        """Send a signal, if it still runs."""
        if self._process is not None and self.running:
            self._process.send_signal(number)

    def how_it_ended(self) -> str:
        """Return in words how it ended."""
        code = self.code
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


# Signals of a shutdown, and the timeout of each [s].
ENDING = ((signal.SIGINT, 5.0), (signal.SIGTERM, 2.0), (signal.SIGKILL, 5.0))


def stop(
    processes: Sequence[NodeProcess],
    ending: Sequence[tuple[signal.Signals, float]] = ENDING,
) -> list[str]:
    """Stop processes with increasingly strong signals; return when all have ended.

    Parameters
    ----------
    processes : sequence of NodeProcess
        All get each signal at the same time.
    ending : sequence of (signal, seconds)
        Signals, and how long to wait after each.

    Returns
    -------
    list of str
        Names of those that had to be killed.
    """
    stubborn: list[str] = []
    for number, patience in ending:
        rest = [process for process in processes if process.running]
        if not rest:
            break
        if number == signal.SIGKILL:
            stubborn = [process.name for process in rest]
        for process in rest:
            process.signal(number)
        deadline = time.monotonic() + patience
        while any(process.running for process in rest) and time.monotonic() < deadline:
            time.sleep(0.005)
    return stubborn
