"""The driver of a Parrot Mambo, or another flying robot with a camera, that is linked by topics."""

from __future__ import annotations

from maasi_drivers.camera_driver import CameraDriver
from maasi_filter.search_node import run


class MamboDriver(CameraDriver):
    """A quadrotor with a camera that looks down; see `CameraDriver`."""


def main(arguments: list[str] | None = None) -> int:
    """Run the driver."""
    return run(MamboDriver, arguments)


if __name__ == '__main__':
    raise SystemExit(main())
