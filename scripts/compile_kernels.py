"""Compile the kernels of all packages into the cache, so that no node waits for it."""

import signal
import subprocess
import sys

# Side by side; they share few kernels.
PARTS = (
    ('maasi_filter', 'maasi_planner'),
    ('maasi_sim.run.warm_up',),
)
PART = 'import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name).warm_up()'


def main() -> int:
    """Compile; on SIGTERM the parts end too."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    started = [subprocess.Popen([sys.executable, '-c', PART, *names]) for names in PARTS]
    try:
        return max(abs(process.wait()) for process in started)
    finally:
        for process in started:
            process.kill()


if __name__ == '__main__':
    sys.exit(main())
