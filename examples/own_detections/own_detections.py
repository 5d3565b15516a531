"""Feeds detections of your own to the filter, without planner and drivers.

Start the filter with `ros2 run maasi_filter filter_node --ros-args --params-file filter.yaml`,
then this script; it ends when the filter has found the target.
"""

import math

import rclpy
from rclpy.node import Node

from maasi_msgs.msg import Detection, DetectionArray, FoundTargetArray

TARGET = (3.0, 2.0)


class Detections(Node):
    """A camera at (1, 1) that sees the target twice a second."""

    def __init__(self):
        super().__init__('own_detections')
        self.measurement = 0
        self.found = []
        self.publisher = self.create_publisher(DetectionArray, 'camera/detections', 10)
        self.create_subscription(FoundTargetArray, 'found_targets', self.on_found, 10)
        self.create_timer(0.5, self.measure)

    def measure(self):
        """Publish what is seen now; an array without detections counts too."""
        message = DetectionArray(batch_id=0, robot='camera', measurement=self.measurement)
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = 'map'
        message.pose.pose.position.x = message.pose.pose.position.y = 1.0
        message.pose.pose.orientation.w = 1.0
        x, y = TARGET[0] - 1.0, TARGET[1] - 1.0
        message.detections = [Detection(range=math.hypot(x, y), bearing=math.atan2(y, x))]
        self.publisher.publish(message)
        self.measurement += 1

    def on_found(self, message):
        """Take what the filter has found so far."""
        self.found = [(item.position.x, item.position.y) for item in message.targets]


if __name__ == '__main__':
    rclpy.init()
    node = Detections()
    while rclpy.ok() and not node.found:
        rclpy.spin_once(node)
    for x, y in node.found:
        print(f'found a target at ({x:.2f}, {y:.2f}) m after {node.measurement} measurements')
