"""A robot's sensor as its driver uses it, and what it reads at one instant."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Generic, TypeVar

from maasi_drivers.agent.odometry import StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.sensor_reading import SensorReading

DataT = TypeVar('DataT')


class SensorInput(ABC, Generic[DataT]):
    """Where images or sweeps come from, and how targets are detected in them.

    Each image or sweep goes to `driver.take_frame`.

    Parameters
    ----------
    driver : RobotNode
        The robot's node.

    Attributes
    ----------
    name : str
        What it delivers, for messages.
    offset : int
        Added to the stamp of an image for the time of its pose [ns].
    """

    name = 'sweep'

    def __init__(self, driver: RobotNode) -> None:
        self.driver = driver
        self.offset = 0

    def prepare(self) -> None:
        """Check the settings; raise `SettingsError` for one that is not allowed."""

    @abstractmethod
    def set_up(self) -> None:
        """Compile the kernels and subscribe, in *configure*."""

    @abstractmethod
    def detect(self, data: DataT, pose: StampedPose) -> SensorReading:
        """Return what an image or sweep shows.

        Raises
        ------
        ValueError
            If it cannot be used: the next one answers instead.
        """

    def close(self) -> None:
        """Release what is no ROS entity; may be called more than once."""
