"""Nodes as processes: found, started, restarted, and stopped in bounded time."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_prefix

from maasi_sim.run.domain import remove_dead
from maasi_sim.run.node_server import ProcessError, node_process, start_server


def find_executable(package: str, executable: str) -> Path:
    """Return the file that `ros2 run package executable` would run."""
    try:
        folder = Path(get_package_prefix(package)) / 'lib' / package
    except PackageNotFoundError:
        raise ProcessError(f'package {package} is not installed: source the workspace') from None
    path = folder / executable
    if not os.access(path, os.X_OK):
        raise ProcessError(f'package {package}: has no executable {executable} in {folder}')
    return path


@dataclass
class NodeProcess:
    """A node that runs as a process and cannot outlive this one.

    Its log is kept over restarts. A node of a package of this suite inherits what the node server
    has loaded.
    """

    name: str
    command: list[str]
    log: Path
    package: str = ''
    restarts: int = 0
    _process: BaseProcess | None = None

    def start(self) -> None:
        """Start it."""
        # The node itself opens it.
        with contextlib.suppress(OSError):
            self.log.touch()
        self._process = node_process(self.package, self.command, self.log)
        try:
            start_server()
            self._process.start()
        except (OSError, EOFError) as error:
            self._process = None
            raise ProcessError(f'{self.name}: cannot be started: {error}') from error

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
        return None if self._process is None else self._process.exitcode

    @property
    def running(self) -> bool:
        """Whether it was started and has not ended."""
        return self._process is not None and self._process.exitcode is None

    def signal(self, number: int) -> None:
        """Send a signal, if it still runs."""
        if self.running and self.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

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

    All get each signal of `ending` at the same time, and that many seconds [s] until the next one.
    Returned are the names of those that had to be killed.
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
