"""Compile the kernels of all packages into the cache, so that no node waits for it."""

import subprocess
import sys

# Side by side; each part takes about as long as the other.
PARTS = (('maasi_filter', 'maasi_drivers.warm_up'), ('maasi_planner', 'maasi_sim.warm_up'))
PART = 'import importlib, sys\nfor name in sys.argv[1:]: importlib.import_module(name).warm_up()'
# What one part compiled and the other overwrote in the cache.
REST = 'from maasi_sim.warm_up import warm_up_all\nwarm_up_all()'

if __name__ == '__main__':
    started = [subprocess.Popen([sys.executable, '-c', PART, *names]) for names in PARTS]
    codes = [process.wait() for process in started]
    sys.exit(max(map(abs, codes)) or subprocess.call([sys.executable, '-c', REST]))
