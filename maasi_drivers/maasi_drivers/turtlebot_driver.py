"""The driver of a TurtleBot3, or another ground robot with a camera."""

from __future__ import annotations

from maasi_drivers.camera_driver import CameraDriver
from maasi_filter.search_node import run


class TurtlebotDriver(CameraDriver):
    """
    A differential drive with a camera that sees the floor; see `CameraDriver`.

    A TurtleBot has no time limit on commands: the last one goes on. So zeros are published when the
    driver stops, loses the odometry or ends, and `guard_node` does so when the driver dies.
    """


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(TurtlebotDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
