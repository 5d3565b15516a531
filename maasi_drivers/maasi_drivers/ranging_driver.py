"""The driver of a robot with topics and a sensor of range, bearing and elevation."""

from __future__ import annotations

from typing import Any

from maasi_drivers.agent.agent_driver import AgentDriver
from maasi_drivers.agent.sensor_input import RangingInput
from maasi_drivers.links.topic_link import TopicLink
from maasi_filter.ros.run_node import run


class RangingDriver(AgentDriver):
    """A robot with topics and a ranging sensor; see `TopicLink` and `RangingInput`."""

    def __init__(self, **options: Any) -> None:
        super().__init__({'topics': TopicLink}, RangingInput, **options)


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(RangingDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
