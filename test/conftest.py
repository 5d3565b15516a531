"""What holds for all tests."""

import signal
import sys
from pathlib import Path

# Workers of pytest-xdist ignore SIGINT, and so would the processes that their tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)
# What the tests of several directories share.
sys.path.insert(0, str(Path(__file__).parent))
