"""The driver of a Mambo whose own program segments, flies, and takes waypoints by UDP (001)."""

from __future__ import annotations

from typing import Any

from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.links.mambo.onboard_link import OnboardLink
from maasi_drivers.vision.camera_input import CameraInput
from maasi_filter.ros.run_node import run


class MamboOnboardDriver(AgentDriver):
    """A drone with a program of its own; see `OnboardLink` and docs/measurement_feed.md."""

    def __init__(self, **options: Any) -> None:
        super().__init__({'mambo_feed': OnboardLink}, CameraInput, **options)


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(MamboOnboardDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
