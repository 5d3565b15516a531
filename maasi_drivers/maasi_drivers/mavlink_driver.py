"""The driver of a vehicle that speaks MAVLink: ArduCopter, ArduSub or PX4."""

from __future__ import annotations

from typing import Any

from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.agent.sensor_input import RangingInput
from maasi_drivers.links.mavlink.mavlink_robot_link import MavlinkRobotLink
from maasi_drivers.links.topic_link import TopicLink
from maasi_filter.ros.run_node import run


class MavlinkDriver(AgentDriver):
    """A vehicle with a ranging sensor; see `MavlinkRobotLink` and `RangingInput`."""

    def __init__(self, **options: Any) -> None:
        super().__init__(
            {'topics': TopicLink, 'mavlink': MavlinkRobotLink}, RangingInput, **options
        )


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(MavlinkDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
