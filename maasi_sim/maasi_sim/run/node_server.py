"""The fork server of `multiprocessing` that nodes are started from, and what it loads before.

A node inherits imported modules and compiled kernels: it starts in a tenth of the time.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import multiprocessing
import os
import signal
import sys
import tempfile
from multiprocessing import forkserver, resource_tracker, util
from multiprocessing.process import BaseProcess
from pathlib import Path

from setproctitle import getproctitle, setproctitle

import maasi_entry

_PR_SET_PDEATHSIG = 1
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PACKAGES = ('maasi_filter', 'maasi_planner', 'maasi_drivers', 'maasi_sim')
# In the environment of the server only: the process that started it.
_STARTED_BY = 'MAASI_NODE_SERVER_OF'
# One thread for each linear algebra library: there is a process for each node, and a process with
# several threads must not be forked.
_ENVIRONMENT = {
    'PYTHONUNBUFFERED': '1',
    'OMP_NUM_THREADS': '1',
    'OPENBLAS_NUM_THREADS': '1',
    'MKL_NUM_THREADS': '1',
}
# Addresses of Unix sockets have at most 107 bytes; multiprocessing adds 32 to the folder.
_LONGEST_FOLDER = 75
_context = multiprocessing.get_context('forkserver')


class ProcessError(RuntimeError):
    """A process cannot be started."""


def start_server() -> None:
    """Start the server, which loads what nodes share while the caller goes on."""
    _context.set_forkserver_preload([__name__])
    resource_tracker.ensure_running()
    for key, value in _ENVIRONMENT.items():
        os.environ.setdefault(key, value)
    os.environ[_STARTED_BY] = str(os.getpid())
    # Ctrl-C in the terminal must not reach the server before it has a session of its own.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    folder = tempfile.gettempdir()
    try:
        # The server's socket needs a folder whose path is not too long for an address.
        if len(os.fsencode(folder)) > _LONGEST_FOLDER:
            tempfile.tempdir = '/tmp'
        util.get_temp_dir()
        forkserver.ensure_running()
    except OSError as error:
        raise ProcessError(f'the server of the nodes cannot be started: {error}') from error
    finally:
        tempfile.tempdir = folder
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        del os.environ[_STARTED_BY]


def wait_for_server() -> None:
    """Return once the server has loaded what nodes share."""
    process = _context.Process(target=int)
    try:
        process.start()
    except (OSError, EOFError) as error:
        raise ProcessError('the server of the nodes has ended: its error is above') from error
    process.join()


def _load(started_by: int) -> None:
    """Load what nodes need; the server ends with the process that started it."""
    os.setsid()
    _die_with(started_by)
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    gc.disable()
    # Not rclpy, which starts threads.
    importlib.import_module('maasi_sim.run.warm_up').prepare_nodes()
    # What exists now is never garbage: nodes share its memory.
    gc.freeze()
    gc.enable()


def _die_with(parent: int) -> None:
    """Let Linux kill this process when its parent ends for any reason."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


def node_process(package: str, command: list[str], log: Path) -> BaseProcess:
    """Return the process of a node with its output in a log, not started yet.

    A node of another package than ours is executed. The command is the path of the executable and
    its arguments, also shown by `ps`. It has the environment of this process.
    """
    name = Path(command[0]).name
    script = name if package in _PACKAGES and hasattr(maasi_entry, name) else ''
    return _context.Process(target=_run, args=(script, command, log, dict(os.environ)))


def _run(script: str, command: list[str], log: Path, environment: dict[str, str]) -> None:
    """Become the node: an independent process that ends with the server, and so with the run."""
    os.setsid()
    _die_with(_server)
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    try:
        output = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        # The disk is full: the node runs without a log.
        output = os.open(os.devnull, os.O_WRONLY)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for source, target in ((nothing, 0), (output, 1), (output, 2)):
        os.dup2(source, target)
    os.environ.clear()
    os.environ.update(environment)
    if not script:
        for number in (signal.SIGPIPE, signal.SIGXFSZ):
            signal.signal(number, signal.SIG_DFL)
        os.execv(command[0], command)
    sys.argv = list(command)
    setproctitle(' '.join(command))
    try:
        sys.exit(getattr(maasi_entry, script)())
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()


if _STARTED_BY in os.environ:
    # It finds the place of the title beside an environment that has not changed yet.
    getproctitle()
    _load(int(os.environ.pop(_STARTED_BY)))
#: Of a node, its parent: a node is forked from where this module was loaded before.
_server = os.getpid()
