"""The topic `keep_outs` of the team, for keep-outs that change during a search."""

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import ValidationError
from std_msgs.msg import Header

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.readers import shapes_of_texts
from maasi_filter.ros.conversions import stamp_from_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL
from maasi_filter.wording import problems
from maasi_msgs.msg import KeepOuts
from maasi_msgs.srv import SetKeepOuts

# Most zones, and most corners of their polygons, in a request.
ZONES, CORNERS = 1000, 10_000


class KeepOutTopic:
    """The area with the active keep-outs; `on_change` receives each changed area.

    `keep` republishes them, to outlive their sender; `service` offers a service to change them.
    """

    def __init__(
        self,
        node: LockstepLifecycleNode[Any],
        on_change: Callable[[Area], None],
        keep: bool,
        service: str = '',
    ) -> None:
        self._node, self._on_change = node, on_change
        self._latest = KeepOuts()
        self._asked = False  # whether the latest ones are from the service
        topic = node.team_topic('keep_outs')
        self._publisher = node.create_publisher(KeepOuts, topic, LATCHED) if keep else None
        node.create_subscription(KeepOuts, topic, self._take, LATCHED_ALL)
        if service:
            node.offer_service(service, self._change, SetKeepOuts)

    def _change(self, request: SetKeepOuts.Request) -> tuple[bool, str]:
        if not self._node.active:
            return False, 'the planner is not active'
        frame, version = self._node.settings.frame, self._latest.version + 1
        header = Header(stamp=self._node.get_clock().now().to_msg(), frame_id=frame)
        try:
            self._adopt(KeepOuts(header=header, version=version, zones=list(request.zones)))
        except ValueError as error:
            return False, str(error)
        self._asked = True
        return True, f'active keep-outs: {len(request.zones)}'

    def _take(self, message: KeepOuts) -> None:
        latest = self._latest
        if self._asked and message.version >= latest.version and _stamp(message) < _stamp(latest):
            # Changed after a restart, before the earlier ones arrived.
            latest.version = message.version + 1
            self._adopt(latest)
        if message.version <= latest.version:
            return
        self._asked = False
        try:
            self._adopt(message)
        except ValueError as error:
            self._node.drop('bad keep-outs', f'keep_outs.zones: {error}')

    def _adopt(self, message: KeepOuts) -> None:
        area = with_keep_outs(self._node.settings.environment, message.zones)
        message.zones = [str(zone) for zone in area.settings.keep_outs]
        self._latest = message
        self._node.get_logger().info(f'active keep-outs: {len(message.zones)}')
        for text in area.warnings:
            self._node.get_logger().warning(text)
        if self._publisher is not None:
            self._publisher.publish(message)
        self._on_change(area)


def _stamp(message: KeepOuts) -> int:
    return stamp_from_ros(message.header.stamp)


def with_keep_outs(environment: EnvironmentSettings, zones: Sequence[str]) -> Area:
    """Return the area of an environment with other keep-outs, given as texts."""
    # Counted first: reading them takes up to a second.
    for read, what, most in (
        (len(zones), 'zones', ZONES),
        (sum(zone.count(',') for zone in zones), 'corners', CORNERS),
    ):
        if read > most:
            raise ValueError(f'read {read} {what}, allowed are {most}')
    try:
        given = {**dict(environment), 'keep_outs': shapes_of_texts(zones)}
        return Area(EnvironmentSettings.model_validate(given))
    except ValidationError as error:
        raise ValueError(problems(error)) from None
