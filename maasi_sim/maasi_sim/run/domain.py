"""ROS domains of runs, and the shared memory of Fast DDS in them."""

import contextlib
import fcntl
import hashlib
import os
import re
import signal
import socket
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from maasi_filter.ros.loopback import loopback_fault

DOMAINS = range(0, 102)  # domains with ports below the ephemeral ports of Linux (from 32768)
# Environment variables with the profiles: of Fast DDS 3, and of Fast DDS 2 (Jazzy and before).
_PROFILES = ('FASTDDS_DEFAULT_PROFILES_FILE', 'FASTRTPS_DEFAULT_PROFILES_FILE')
# Files of Fast DDS 2.14 and 3.2: ports, segments, their locks and semaphores.
_NAME = re.compile(r'(?:sem\.)?(fast(?:rtps|dds)_(?:port(\d+)|[0-9a-f]{16}))(?:_el|_sl|_mutex)?')
# Ports of the RTPS specification: number per domain, and first one.
FIRST_PORT, PORTS_PER_DOMAIN = 7400, 250
# Fast DDS contacts 32 participants per host, unless its profile says otherwise; some are programs
# that are started during a run.
_FOUND, _OTHERS, _LAST = 32, 8, 119
# First word of a shared memory that is ready (Boost.Interprocess).
_READY = (2).to_bytes(4, sys.byteorder)


class DomainError(RuntimeError):
    """No domain is free, or the requested one cannot be used."""


class Domain(contextlib.AbstractContextManager['Domain']):
    """A ROS domain reserved for this run on this host until `release`; the first free one from 1.

    An abstract Unix socket locks the domain, or only the namespace `team` of a `shared` one:
    for all users, without files, until the process ends.
    """

    def __init__(
        self,
        number: int | None = None,
        purpose: str = 'run',
        *,
        team: str = '',
        shared: bool = False,
    ) -> None:
        # Nodes discover each other by multicast in it.
        if fault := loopback_fault():
            raise DomainError(fault)
        self._purpose = purpose
        self._locks: list[socket.socket] = []
        self._files = contextlib.ExitStack()
        if number is not None and number not in DOMAINS:
            raise DomainError(f'domain id: read {number}, allowed are 0 to {DOMAINS[-1]}')
        # Other nodes may use a requested domain.
        used = _domains_in_use() if number is None else set()
        for candidate in DOMAINS[1:] if number is None else [number]:
            if candidate in used:
                continue
            problem = self._claim(candidate, team, shared)
            if not problem:
                self.number = candidate
                # Nodes of other runs may be starting in a shared domain.
                self._own = None if shared else candidate
                remove_dead(self._own)
                return
            if number is not None:
                raise DomainError(f'domain id: another run uses {problem}')
        raise DomainError(f'no ROS domain from 1 to {DOMAINS[-1]} is free')

    def _claim(self, number: int, team: str, shared: bool) -> str:
        wanted = {} if shared else {f'{number}': f'{number}'}
        wanted[f'{number} {team}'] = f'namespace /{team} in {number}'
        for name, words in wanted.items():
            # Socket names are short: use a digest.
            digest = hashlib.sha256(f'{self._purpose} {name}'.encode()).hexdigest()
            self._locks.append(socket.socket(socket.AF_UNIX))
            try:
                self._locks[-1].bind(f'\0maasi {digest}')
            except OSError:
                self._unlock()
                return words
        return ''

    def environment(self, participants: int = 0) -> dict[str, str]:
        """Return environment variables for nodes of this domain on this host.

        participants: number of processes that must discover each other.
        """
        variables = {
            'ROS_DOMAIN_ID': str(self.number),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        }
        if any(name in os.environ for name in _PROFILES):
            return variables
        profiles = _PROFILES[os.environ.get('ROS_DISTRO', 'jazzy') <= 'jazzy']
        if participants + _OTHERS <= _FOUND:
            variables[profiles] = str(Path(__file__).with_name('discovery.xml'))
            return variables
        # rmw_fastrtps replaces the transports of a profile unless the range is the default one.
        variables['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SYSTEM_DEFAULT'
        text = Path(__file__).with_name('discovery_many.xml').read_text()
        text = text.replace('PROCESSES', str(min(participants + _OTHERS, _LAST)))
        with tempfile.NamedTemporaryFile('w', prefix='maasi_', suffix='.xml', delete=False) as file:
            self._files.callback(Path(file.name).unlink, missing_ok=True)
            file.write(text)
        variables[profiles] = file.name
        return variables

    def release(self) -> None:
        """Release the domain after removing the shared memory of killed nodes."""
        remove_dead(self._own)
        self._unlock()

    def _unlock(self) -> None:
        while self._locks:
            self._locks.pop().close()
        self._files.close()

    def __exit__(self, *_: object) -> None:
        self.release()


def _domains_in_use() -> set[int]:
    used = set()
    for table in ('/proc/net/udp', '/proc/net/udp6'):
        with contextlib.suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                port = int(line.split()[1].rpartition(':')[2], 16)
                used.add((port - FIRST_PORT) // PORTS_PER_DOMAIN)
    return used


def remove_dead(domain: int | None = None, folder: Path = Path('/dev/shm')) -> list[str]:
    """Remove shared memory of this user that no process has open; return the removed files.

    Dead files fill the memory, and a process that opens a half-created port waits forever. All
    ports of `domain` are removed, of other domains only half-created ones, as new processes
    reuse their names.
    """
    parts: dict[str, list[Path]] = defaultdict(list)
    for path in folder.iterdir() if folder.is_dir() else ():
        if match := _NAME.fullmatch(path.name):
            parts[match[1]].append(path)
    removed = []
    for name, paths in parts.items():
        # Without the port Fast DDS would treat a dead reader's lock as alive.
        if all(map(_is_unused, paths)) and _may_go(folder / name, domain):
            for path in paths:
                with contextlib.suppress(OSError):
                    path.unlink()
                    removed.append(path.name)
    return removed


def _may_go(path: Path, domain: int | None) -> bool:
    match = _NAME.fullmatch(path.name)
    number = match and match[2]
    if number is None:
        return True
    if domain is not None and (int(number) - FIRST_PORT) // PORTS_PER_DOMAIN == domain:
        return True
    with contextlib.suppress(OSError), path.open('rb') as file:
        return file.read(4) != _READY
    return False


def _is_unused(path: Path) -> bool:
    """Return whether no process has a file open or mapped: Linux grants a write lease."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        if os.fstat(file).st_uid != os.getuid():
            return False
        # If a process opens it now, Linux sends this signal (ignored by default) instead of SIGIO.
        fcntl.fcntl(file, fcntl.F_SETSIG, signal.SIGURG)
        fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_WRLCK)
    except OSError:
        return False
    finally:
        os.close(file)
    return True
