"""The driver of a Parrot Mambo, or of another flying robot with a camera."""

from __future__ import annotations

from typing import Any

from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.links.mambo.mambo_robot_link import MamboRobotLink
from maasi_drivers.links.topic_link import TopicLink
from maasi_drivers.vision.camera_input import CameraInput
from maasi_filter.ros.run_node import run


class MamboDriver(AgentDriver):
    """A quadrotor with a camera that looks down; see `MamboRobotLink` and `CameraInput`."""

    def __init__(self, **options: Any) -> None:
        super().__init__(
            {'topics': TopicLink, 'mambo_wifi': MamboRobotLink, 'mambo_ble': MamboRobotLink},
            CameraInput,
            **options,
        )


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(MamboDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
