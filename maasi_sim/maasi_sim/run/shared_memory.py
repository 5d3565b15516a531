"""Shared memory that Fast DDS processes leave when they are killed while they create it."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

# First word of a segment that is ready (Boost.Interprocess).
_READY = 2
# The creator writes it within microseconds; after this time it is dead [s].
LONGEST_CREATION = 5.0


# Period of checks of a port that is being created [s].
_PERIOD = 0.02


def remove_dead_ports(folder: Path = Path('/dev/shm'), patience: float = 0.0) -> list[str]:
    """Remove ports whose creator died before they were ready; return their names.

    A process that opens such a port waits for its creator for ever, on this host in all domains.

    Parameters
    ----------
    folder : Path
        Where shared memory is.
    patience : float
        How long to wait for ports that may be in creation: until they are ready, or their creator
        is known to be dead [s].
    """
    removed = []
    deadline = time.monotonic() + patience
    while True:
        dead, young = _unready_ports(folder)
        for path in dead:
            with contextlib.suppress(OSError):
                path.unlink()
                removed.append(path.name)
        if not young or time.monotonic() >= deadline:
            return removed
        time.sleep(_PERIOD)


def _unready_ports(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the ports whose creator is dead, and those that may be in creation."""
    dead: list[Path] = []
    young: list[Path] = []
    for path in sorted(folder.glob('fastrtps_port*')):
        if path.name.endswith(('_el', '_sl')):
            continue
        try:
            with path.open('rb') as file:
                if int.from_bytes(file.read(4), 'little') == _READY:
                    continue
            old = time.time() - path.stat().st_mtime > LONGEST_CREATION
        except OSError:
            # Removed meanwhile, or owned by another user.
            continue
        (dead if old else young).append(path)
    return dead, young
