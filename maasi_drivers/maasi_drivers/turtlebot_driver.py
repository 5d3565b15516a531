"""The driver of a TurtleBot3, or another ground robot with a camera."""

from __future__ import annotations

from typing import Any

from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.links.turtlebot_link import TurtlebotLink
from maasi_drivers.vision.camera_input import CameraInput
from maasi_filter.ros.run_node import run


class TurtlebotDriver(AgentDriver):
    """A ground robot with a camera; see `TurtlebotLink` and `CameraInput`."""

    def __init__(self, **options: Any) -> None:
        super().__init__({'topics': TurtlebotLink}, CameraInput, **options)


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(TurtlebotDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
