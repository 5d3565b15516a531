"""Shared memory that processes with Fast DDS leave when they are killed."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import signal
import sys
from collections import defaultdict
from pathlib import Path

# A port or a segment, its locks, and the semaphore under which a port is opened (Fast DDS 2.14).
_NAME = re.compile(r'(?:sem\.)?(fastrtps_(?:port\d+|[0-9a-f]{16}))(?:_el|_sl|_mutex)?')
# Ports of the RTPS specification: this many for each domain, from this one.
FIRST_PORT, PORTS_PER_DOMAIN = 7400, 250
# First word of a memory that its creator has made ready (Boost.Interprocess).
_READY = (2).to_bytes(4, sys.byteorder)


def remove_dead(domain: int | None = None, folder: Path = Path('/dev/shm')) -> list[str]:
    """Remove segments and ports of this user that no process has open; return the removed files.

    They fill the memory, and a process that opens a port whose creator died before it was ready
    waits for ever, on this host in all domains.

    Parameters
    ----------
    domain : int, optional
        Domain that no process uses, of which all ports are removed; of others only those that were
        never ready. New processes use the names of ports again, some of them in all domains: who
        opens a port while it is removed shares it with nobody.
    folder : Path
        Where Fast DDS keeps them.
    """
    parts: dict[str, list[Path]] = defaultdict(list)
    for path in folder.iterdir() if folder.is_dir() else ():
        if match := _NAME.fullmatch(path.name):
            parts[match[1]].append(path)
    removed = []
    for name, paths in parts.items():
        # Not the lock alone: without it Fast DDS takes the port of a dead reader for a live one.
        if all(map(_is_unused, paths)) and _may_go(folder / name, domain):
            for path in paths:
                with contextlib.suppress(OSError):
                    path.unlink()
                    removed.append(path.name)
    return removed


def _may_go(path: Path, domain: int | None) -> bool:
    """Return whether no process can be about to open an unused port or segment again."""
    number = path.name.removeprefix('fastrtps_port')
    if number == path.name:
        return True
    if domain is not None and (int(number) - FIRST_PORT) // PORTS_PER_DOMAIN == domain:
        return True
    with contextlib.suppress(OSError), path.open('rb') as file:
        return file.read(4) != _READY
    return False


def _is_unused(path: Path) -> bool:
    """Return whether no process, of any container, has this user's file open or mapped.

    Owners keep their locks open and their memory mapped while they live, also in creation. Linux
    grants a lease for writing on a file only that is not open elsewhere.
    """
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        if os.fstat(file).st_uid != os.getuid():
            return False
        # Who opens it meanwhile causes this signal, which is ignored by default, not SIGIO.
        fcntl.fcntl(file, fcntl.F_SETSIG, signal.SIGURG)
        fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_WRLCK)
    except OSError:
        return False
    finally:
        os.close(file)
    return True
