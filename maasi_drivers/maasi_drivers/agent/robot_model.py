"""The frames that are fixed on a robot, and its description (URDF). Without ROS."""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree import ElementTree

from maasi_drivers.agent.driver_settings import DriverSettings
from maasi_filter.models.pose import Pose

# From a camera (x forward) to its optical frame (x right, y down, z forward).
_OPTICAL = (-0.5 * math.pi, 0.0, -0.5 * math.pi)
_NOWHERE = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class FixedFrame:
    """A frame that is fixed on a robot.

    Attributes
    ----------
    parent, name : str
        Names of the frames.
    position : tuple of 3 floats
        Of the frame in its parent [m].
    rpy : tuple of 3 floats
        Roll, pitch, yaw about fixed axes of the parent [rad].
    """

    parent: str
    name: str
    position: tuple[float, ...]
    rpy: tuple[float, ...]

    def pose(self) -> Pose:
        """Return the pose of the frame in its parent."""
        return Pose.from_rpy(self.position, self.rpy)


def base_frame(robot: str, settings: DriverSettings) -> str:
    """Return the name of a robot's own frame."""
    return settings.base_frame.strip('/') or f'{robot}/base_link'


def sensor_frames(robot: str, settings: DriverSettings) -> list[FixedFrame]:
    """Return the frames of a robot's sensors, as far as the settings say where these sit.

    Parameters
    ----------
    robot : str
        Its name.
    settings : DriverSettings
        Of its driver.
    """
    base = base_frame(robot, settings)
    frames: list[FixedFrame] = []
    if settings.camera is not None:
        mount, camera = settings.camera.mount, f'{robot}/camera'
        frames.append(FixedFrame(base, camera, tuple(mount.position), tuple(mount.rpy)))
        frames.append(FixedFrame(camera, f'{robot}/camera_optical', _NOWHERE, _OPTICAL))
    if settings.scan is not None:
        scan = settings.scan
        place = (*scan.position, 0.0)
        frames.append(FixedFrame(base, f'{robot}/base_scan', place, (0.0, 0.0, scan.yaw)))
    ranging = settings.ranging
    if ranging.frame == 'body':
        place, rpy = tuple(ranging.position), tuple(ranging.rpy)
        frames.append(FixedFrame(base, f'{robot}/ranging', place, rpy))
    return frames


def robot_description(robot: str, settings: DriverSettings) -> str:
    """Return the URDF of a robot: a cylinder of its radius, and the frames of its sensors.

    Links have the names of the frames. The height is not known: it is drawn as the radius.
    """
    root = ElementTree.Element('robot', name=robot)
    link = ElementTree.SubElement(root, 'link', name=base_frame(robot, settings))
    for part in ('visual', 'collision'):
        geometry = ElementTree.SubElement(ElementTree.SubElement(link, part), 'geometry')
        size = repr(settings.radius)
        ElementTree.SubElement(geometry, 'cylinder', radius=size, length=size)
    for frame in sensor_frames(robot, settings):
        ElementTree.SubElement(root, 'link', name=frame.name)
        joint = ElementTree.SubElement(root, 'joint', name=f'{frame.name}_joint', type='fixed')
        ElementTree.SubElement(joint, 'parent', link=frame.parent)
        ElementTree.SubElement(joint, 'child', link=frame.name)
        numbers = {'xyz': frame.position, 'rpy': frame.rpy}
        text = {key: ' '.join(map(repr, map(float, value))) for key, value in numbers.items()}
        ElementTree.SubElement(joint, 'origin', text)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding='unicode') + '\n'
