"""The drivers of the suite by executable; MAVLink, an extra, is imported on demand."""

from functools import partial
from pkgutil import resolve_name
from typing import Any

from maasi_drivers.agent.agent_driver import AgentDriver, MakeLink
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.sensor_input import RangingInput
from maasi_drivers.links.robot_link import RobotLink
from maasi_drivers.settings.driver import LINKS
from maasi_drivers.vision.camera_input import CameraInput
from maasi_filter.ros.lifecycle_node import SettingsError


def _link(name: str, driver: RobotNode) -> RobotLink:
    try:
        link: RobotLink = resolve_name(f'maasi_drivers.links.{name}')(driver)
    except ModuleNotFoundError as error:
        raise SettingsError(
            f'parameter link: read {driver.settings.link!r}, which needs the Python package '
            f'{error.name} (docs/install.md)'
        ) from error
    return link


_CLASSES = {
    'topics': 'topic_link:TopicLink',
    'mambo_wifi': 'mambo.mambo_robot_link:MamboRobotLink',
    'mambo_ble': 'mambo.mambo_robot_link:MamboRobotLink',
    'mambo_feed': 'mambo.onboard_link:OnboardLink',
    'mavlink': 'mavlink.mavlink_robot_link:MavlinkRobotLink',
    'crazyswarm2': 'crazyswarm_link:CrazyswarmLink',
    'aerostack2': 'aerostack_link:AerostackLink',
}


def _links(driver: str) -> dict[str, MakeLink]:
    return {name: partial(_link, _CLASSES[name]) for name in LINKS[driver]}


class MamboDriver(AgentDriver):
    """Fly a Parrot Mambo, or a quadrotor on ROS topics, with a camera that looks down.

    Services
    --------
    `arm` (std_srvs/Trigger), with links mambo_wifi and mambo_ble: permits one take-off
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(_links('mambo_driver'), CameraInput, **options)


class MamboOnboardDriver(AgentDriver):
    """Send waypoints to a drone whose own program flies it (docs/measurement_feed.md).

    Services
    --------
    `arm` (std_srvs/Trigger): permits one take-off
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(_links('mambo_onboard_driver'), CameraInput, **options)


class MavlinkDriver(AgentDriver):
    """Drive a vehicle under ArduPilot or PX4 that has a ranging sensor.

    Services
    --------
    `arm` (std_srvs/Trigger), with link mavlink: permits one take-off
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(_links('mavlink_driver'), RangingInput, **options)


class MavlinkCameraDriver(AgentDriver):
    """Drive a vehicle under ArduPilot or PX4 that has a camera.

    Services
    --------
    `arm` (std_srvs/Trigger), with link mavlink: permits one take-off
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(_links('mavlink_camera_driver'), CameraInput, **options)


class CameraDriver(AgentDriver):
    """Drive a robot with a camera, over ROS topics, Crazyswarm2 or Aerostack2.

    Services
    --------
    `arm` (std_srvs/Trigger), with links crazyswarm2 and aerostack2: permits one take-off
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(_links('camera_driver'), CameraInput, **options)


class RangingDriver(AgentDriver):
    """Drive a robot with a ranging sensor, over ROS topics, Crazyswarm2 or Aerostack2.

    Services
    --------
    `arm` (std_srvs/Trigger), with links crazyswarm2 and aerostack2: permits one take-off
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(_links('ranging_driver'), RangingInput, **options)


class TurtlebotDriver(AgentDriver):
    """Drive a ground robot with a camera, by velocity commands or by Nav2."""

    def __init__(self, **options: Any) -> None:
        def link(driver: RobotNode) -> RobotLink:
            kind = 'Nav2Link' if driver.settings.navigation == 'nav2' else 'TurtlebotLink'
            return _link(f'turtlebot_link:{kind}', driver)

        super().__init__({'topics': link}, CameraInput, **options)
