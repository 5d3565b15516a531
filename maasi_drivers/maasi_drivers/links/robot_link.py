"""The interface of links, for drivers of users' own."""

from maasi_drivers.agent.robot_link import RobotLink

__all__ = ['RobotLink']
