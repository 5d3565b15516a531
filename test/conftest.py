"""What holds for all tests."""

import signal

# Workers of pytest-xdist ignore SIGINT, and so would the processes that their tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)
