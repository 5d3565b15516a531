"""Waiting for what is to happen."""

import time

# Of a test [s]; the machine may be busy.
PATIENCE = 120.0


def wait_until(condition, turn=lambda: time.sleep(0.01), what='nothing came of it', limit=PATIENCE):
    """Take turns until a condition is true, and return its value.

    After `limit` seconds the test fails with `what`, which may be a function that says it.
    """
    end = time.monotonic() + limit
    while not (value := condition()):
        if time.monotonic() >= end:
            raise AssertionError(what() if callable(what) else what)
        turn()
    return value
