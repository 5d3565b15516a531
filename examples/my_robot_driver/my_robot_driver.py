"""
A driver for a robot of one's own: here a rover with a camera, which speaks JSON over UDP.

Ten times a second or more it sends, to whoever sent it a command last, one datagram
`{"x": m, "y": m, "yaw": rad, "forward": m/s, "turn": rad/s, "battery": 0 to 1}`, relative to where
it was switched on, and takes `{"forward": m/s, "turn": rad/s}`. Its images are ROS topics.
"""

import json
import socket

from maasi_drivers.agent.agent_driver import AgentDriver, run
from maasi_drivers.agent.odometry import MapOdometry
from maasi_drivers.links.robot_link import RobotLink
from maasi_drivers.vision.camera_input import CameraInput
from maasi_filter.models.pose import Pose

ROVER = ('192.168.4.1', 9000)


class RoverLink(RobotLink):
    """The link to the rover; goals, images, detections and state are the driver's."""

    def connect(self):
        """Open the socket, and read it fifty times a second."""
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.odometry = MapOdometry(self.driver.start_pose)
        self.driver.create_wall_timer(0.02, self.receive)

    def close(self):
        """Close the socket."""
        self.socket.close()

    def receive(self):
        """Hand each report to the driver, which then sends the next command."""
        while self.driver.active:
            try:
                data = self.socket.recv(1500)
            except OSError:
                return  # no report: the driver judges silence by odometry_timeout
            try:
                report = json.loads(data)
                pose = Pose.from_yaw([report['x'], report['y'], 0.0], report['yaw'])
                velocity, turn = (report['forward'], 0.0, 0.0), (0.0, 0.0, report['turn'])
                stamp = self.driver.get_clock().now().nanoseconds
                placed = self.odometry.apply(stamp, pose, None, velocity, turn)
                charge = float(report['battery'])
            except (KeyError, TypeError, ValueError) as error:
                self.driver.drop('report', f'rover: read {data[:80]!r}: {error!r}')
                continue
            self.driver.take_charge(charge)
            self.driver.take_pose(placed)

    def send(self, placed, command):
        """Drive: vx [m/s] and yaw rate [rad/s]."""
        self.drive(command[0], command[3])

    def hold(self):
        """Stop it now."""
        self.drive(0.0, 0.0)

    def stop(self):
        """Stop it because the driver ends; a datagram may be lost."""
        for _ in range(3):
            self.hold()

    def poll(self):
        """Speak first: it answers to whoever speaks to it."""
        if self.driver.history.latest is None:
            self.hold()

    def drive(self, forward, turn):
        self.socket.sendto(json.dumps({'forward': forward, 'turn': turn}).encode(), ROVER)


class RoverDriver(AgentDriver):
    """For a scenario: `driver: my_robot_driver:RoverDriver`."""

    def __init__(self, **options):
        super().__init__({'topics': RoverLink}, CameraInput, **options)


if __name__ == '__main__':
    raise SystemExit(run(RoverLink, CameraInput))
