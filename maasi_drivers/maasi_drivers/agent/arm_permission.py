"""The permission to take off: given by a service, for one take-off and a limited time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from std_srvs.srv import Trigger

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode

# Reason in `state` while a vehicle waits for it.
UNTIL_ARM = 'until the service arm is called'


class ArmPermission:
    """Whether a vehicle may take off: one take-off for each call of the service.

    Parameters
    ----------
    timeout : float
        After which an unused permission expires [s].
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self._end = -math.inf

    def give(self, now: float) -> None:
        """Give it, from `now` on the steady clock [s]."""
        self._end = now + self.timeout

    def end(self) -> bool:
        """End it, as after a take-off or a refusal; return whether there was one."""
        given, self._end = self._end > -math.inf, -math.inf
        return given

    def holds(self, now: float) -> bool:
        """Return whether there is one."""
        return now < self._end

    def expired(self, now: float) -> bool:
        """Return whether a permission has just expired."""
        return now >= self._end and self.end()


def offer_arm(
    node: LockstepLifecycleNode[Any],
    arm: Callable[[], str],
    in_air: Callable[[], bool] = lambda: False,
) -> None:
    """Offer the service `arm` (std_srvs/Trigger) of a node.

    Parameters
    ----------
    node : LockstepLifecycleNode
        Of a robot that takes off.
    arm : callable
        Gives the permission, or returns the reason of a refusal; empty where it is given.
    in_air : callable
        Whether it flies already, and is taken over.
    """

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        problem = arm() if node.active else 'the driver is not active'
        response.success = not problem
        if problem:
            response.message = problem
            node.get_logger().warning(f'arm: refused: {problem}')
            return response
        response.message = 'it takes off as soon as it is ready'
        if in_air():
            response.message = 'it is in the air: it is taken over where it is'
        node.get_logger().info(f'arm: {response.message}')
        return response

    node.offer_service('arm', answer)
