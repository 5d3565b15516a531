"""
A driver for a robot of one's own: here a rover with a camera, which speaks JSON over UDP.

Ten times a second or more it sends, to whoever sent it a command last, one datagram
`{"x": m, "y": m, "yaw": rad, "forward": m/s, "turn": rad/s, "battery": 0 to 1}`, counted from where
it was switched on, and takes `{"forward": m/s, "turn": rad/s}`. Its images come as ROS topics.
"""

import json
import socket
from typing import Any

from maasi_drivers.agent.odometry import MapOdometry, StampedPose
from maasi_drivers.camera_driver import CameraDriver
from maasi_filter.models.pose import Pose
from maasi_filter.ros.lifecycle_node import run

ROVER = ('192.168.4.1', 9000)


class RoverDriver(CameraDriver):
    """A rover that speaks JSON over UDP; goals, images, detections and state are inherited."""

    def connect_robot(self) -> None:
        """Open the link, in *configure*: where this raises, the node stays unconfigured."""
        self._link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._link.setblocking(False)
        self._in_map = MapOdometry(Pose.from_yaw(self.settings.start, self.settings.yaw))
        self._timer = self.create_wall_timer(0.02, self._receive)

    def disconnect_robot(self) -> None:
        """Close it, in *cleanup*."""
        self.destroy_timer(self._timer)
        self._link.close()

    def _receive(self) -> None:
        while self.active:
            try:
                data = self._link.recv(1500)
            except OSError:
                return  # nothing there, or nobody: silence is judged by odometry_timeout
            try:
                report: dict[str, Any] = json.loads(data)
                pose = Pose.from_yaw([report['x'], report['y'], 0.0], report['yaw'])
                velocity, turn = (report['forward'], 0.0, 0.0), (0.0, 0.0, report['turn'])
                stamp = self.get_clock().now().nanoseconds
                placed = self._in_map.apply(stamp, pose, None, velocity, turn)
                charge = float(report['battery'])
            except (KeyError, TypeError, ValueError) as error:
                self.drop('report', f'rover: read {data[:80]!r}: {error!r}')
                continue
            self.take_charge(charge)
            self.take_pose(placed)  # publishes the state, and asks for the next command

    def send_command(self, placed: StampedPose, command: list[float]) -> None:
        """Have the robot move: vx, vy, vz in its own axes [m/s], turning rate [rad/s]."""
        words = json.dumps({'forward': command[0], 'turn': command[3]})
        self._link.sendto(words.encode(), ROVER)

    def hold_robot(self) -> None:
        """Stop it: a goal was cancelled, or its pose is not known."""
        self._link.sendto(b'{"forward": 0.0, "turn": 0.0}', ROVER)

    def stop_robot(self) -> None:
        """Stop it for good: the driver ends. A datagram may be lost."""
        for _ in range(3):
            self.hold_robot()

    def watch_robot(self) -> None:
        """Ten times a second: it answers to whoever speaks to it."""
        if self._history.latest is None:
            self.hold_robot()


if __name__ == '__main__':
    raise SystemExit(run(RoverDriver))
