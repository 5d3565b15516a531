"""A context of rclpy in its own domain."""

import gc
from contextlib import contextmanager

import rclpy
from rclpy.context import Context

from maasi_sim.run.domain import Domain


@contextmanager
def own_context():
    """Yield a context; nodes of earlier tests are gone from domain and /rosout."""
    # Actions and life cycle of a destroyed node are held by cycles. rcl unregisters /rosout by the
    # name of the logger: one that is collected later takes the log of a new node with it.
    gc.unfreeze()
    gc.collect()
    with Domain() as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain.number)
        try:
            yield context
        finally:
            rclpy.try_shutdown(context=context)
            # Services of type descriptions stay in the domain as well, which others may get next.
            gc.collect()
