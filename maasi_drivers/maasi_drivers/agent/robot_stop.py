"""The services that stop one robot independently of the planner, and release it again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from std_srvs.srv import Trigger

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode

# Reason in `state` while it is latched.
STOPPED = 'stopped by the service stop, until the service release is called'


class RobotStop:
    """A latched stop.

    It outlives *cleanup* and *configure* of its node, but not its process.

    Parameters
    ----------
    on_stop, on_release : callable
        Called after the service.

    Attributes
    ----------
    latched : bool
        Whether the stop is in force.
    """

    def __init__(self, on_stop: Callable[[], None], on_release: Callable[[], None]) -> None:
        self.latched = False
        self._on_stop = on_stop
        self._on_release = on_release

    def offer(self, node: LockstepLifecycleNode[Any]) -> None:
        """Offer the services `stop` and `release` (std_srvs/Trigger) of a node."""
        node.offer_service('stop', self._stop)
        node.offer_service('release', self._release)

    def _stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.latched = True
        self._on_stop()
        response.success = True
        response.message = 'the robot is stopped; it takes no goals until release'
        return response

    def _release(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        response.message = 'the robot takes goals' if self.latched else 'the robot was not stopped'
        self.latched = False
        self._on_release()
        return response
