"""What holds for all tests, and fixtures that they share."""

import gc
import signal
from functools import partial

import hypothesis
import pytest

# Workers of pytest-xdist ignore SIGINT, and so would the processes that their tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)

try:
    hypothesis.settings.get_profile('ci')
except hypothesis.errors.InvalidArgument:  # before hypothesis 6.117
    hypothesis.settings.register_profile('ci', derandomize=True, deadline=None, database=None)


def pytest_addoption(parser):
    """Add the option of tests that make random searches."""
    about = 'seeds of random searches, the first and the one after the last'
    parser.addoption('--search-seeds', nargs=2, type=int, default=[0, 4], help=about)
    about = 'random fields that are searched, the first and the one after the last'
    parser.addoption('--fields', nargs=2, type=int, default=[0, 12], help=about)


def pytest_sessionfinish():
    """Remove what killed nodes left in shared memory."""
    from maasi_sim.run.domain import remove_dead

    remove_dead()


@pytest.fixture
def domain(monkeypatch, request):
    """Reserve a ROS domain for this test and the processes that it starts."""
    from maasi_sim.run.domain import Domain

    with Domain() as reserved:
        for name, value in reserved.environment().items():
            monkeypatch.setenv(name, value)
        yield reserved
        # See `own_context`. What fixtures returned may hold nodes, and is held by the test.
        request.node.funcargs.clear()
        # A command that a test has called may have frozen what existed.
        gc.unfreeze()
        gc.collect()


@pytest.fixture(scope='module')
def chromium():
    """Return what `browsers.chromium` is, with one browser for all pages of a module."""
    from browsers import CHROMIUM, browser, needs_chromium, page_of

    if CHROMIUM is None:
        pytest.skip(needs_chromium.kwargs['reason'])
    with browser() as own:
        yield partial(page_of, own)


@pytest.fixture
def context(domain):
    """Return a context of rclpy in its own domain."""
    # rclpy starts threads when it is imported, and some tests fork.
    import rclpy
    from rclpy.context import Context

    made = Context()
    rclpy.init(context=made, domain_id=domain.number)
    yield made
    rclpy.try_shutdown(context=made)


@pytest.fixture
def ros(domain):
    """Initialise rclpy's global context in its own domain."""
    import rclpy

    rclpy.init(domain_id=domain.number)
    yield
    rclpy.try_shutdown()
