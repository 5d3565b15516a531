"""Robots that are reached by a link of their own, which the simulation plays in real time."""

from __future__ import annotations

from typing import Protocol

from maasi_sim.noise_streams import noise_stream
from maasi_sim.robots import Leader
from maasi_sim.scenario import RobotSettings


class LinkedRobot(Leader, Protocol):
    """A robot at the other end of a link."""

    @property
    def obeys(self) -> bool:
        """Whether it moves as its driver says."""

    def cut(self, cut: bool = True) -> None:
        """Cut the link, or mend it."""

    def close(self) -> None:
        """End it."""


def linked_robot(name: str, robot: RobotSettings, seed: int) -> LinkedRobot:
    """
    Return the other end of a robot's link; time passes for it at once.

    Raises
    ------
    OSError, RuntimeError
        If it cannot be opened.

    """
    from maasi_sim.fake_mavlink_vehicle import vehicle_of

    return vehicle_of(robot, noise_stream(seed, name, purpose='autopilot'))
