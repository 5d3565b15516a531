"""The driver of a vehicle that speaks MAVLink and has a camera."""

from __future__ import annotations

from maasi_drivers.camera_driver import CameraDriver, Picture
from maasi_drivers.mavlink_driver import MavlinkRobot
from maasi_filter.ros.lifecycle_node import run


class MavlinkCameraDriver(MavlinkRobot[Picture], CameraDriver):
    """A vehicle with an autopilot and a camera; see `CameraDriver`."""


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(MavlinkCameraDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
