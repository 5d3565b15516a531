"""The driver of a vehicle that speaks MAVLink and has a camera."""

from __future__ import annotations

from typing import Any

from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.links.mavlink.mavlink_robot_link import MavlinkRobotLink
from maasi_drivers.links.topic_link import TopicLink
from maasi_drivers.vision.camera_input import CameraInput
from maasi_filter.ros.run_node import run


class MavlinkCameraDriver(AgentDriver):
    """A vehicle with a camera; see `MavlinkRobotLink` and `CameraInput`."""

    def __init__(self, **options: Any) -> None:
        links = {'topics': TopicLink, 'mavlink': MavlinkRobotLink}
        super().__init__(links, CameraInput, **options)


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(MavlinkCameraDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
