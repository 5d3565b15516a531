"""Waiting for what is to happen."""

import time

PATIENCE = 120.0  # of a test [s]; the machine may be busy


def wait_until(condition, turn=lambda: time.sleep(0.01), what='nothing came of it', limit=PATIENCE):
    """Return a condition's value once it is true; after `limit` s fail with `what` or its value."""
    end = time.monotonic() + limit
    while not (value := condition()):
        if time.monotonic() >= end:
            raise AssertionError(what() if callable(what) else what)
        turn()
    return value
