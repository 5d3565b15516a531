"""Log messages about batteries."""

from typing import Any

from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_planner.homing import Homing


class BatteryLog:
    """Logs changes of batteries; alarms are robots that reach no charger, by name."""

    def __init__(self, node: LockstepLifecycleNode[Any]) -> None:
        self._node = node
        self.alarms: dict[str, str] = {}

    def report(self, homing: Homing) -> None:
        """Log news, estimated charges, and the begin and end of alarms."""
        logger = self._node.get_logger()
        for text in homing.news:
            logger.warning(text)
        homing.news.clear()
        for name in sorted(homing.alarms.keys() - self.alarms.keys()):
            logger.error(f'{name}: {homing.alarms[name]}')
        for name in sorted(self.alarms.keys() - homing.alarms.keys()):
            logger.warning(f'{name}: it can reach a charger again')
        self.alarms = dict(homing.alarms)
        for text in homing.estimates():
            self._node.warn_throttled(text.partition(':')[0], text)
