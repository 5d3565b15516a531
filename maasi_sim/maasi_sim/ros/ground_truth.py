"""The true targets and the obstacles as topics, for scoring and for display only."""

from __future__ import annotations

from geometry_msgs.msg import PoseArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from maasi_filter.models.pose import Pose
from maasi_filter.ros.conversions import (
    MarkerBoard,
    colour,
    point_to_ros,
    pose_to_ros,
    sphere_marker,
)
from maasi_filter.ros.qos import LATCHED
from maasi_sim.world.world import World


def publish_truth(node: Node, world: World, frame: str) -> list[Publisher]:
    """Publish `ground_truth/targets` and `ground_truth/markers` once, and return the publishers."""
    header = Header(frame_id=frame)
    targets = node.create_publisher(PoseArray, 'ground_truth/targets', LATCHED)
    markers = node.create_publisher(MarkerArray, 'ground_truth/markers', LATCHED)
    targets.publish(
        PoseArray(header=header, poses=[pose_to_ros(Pose(target)) for target in world.targets_3d])
    )
    size = 0.01 * float((world.bounds[:, 1] - world.bounds[:, 0]).max())
    shapes = [
        sphere_marker(header, 'truth', number, target, size, colour(0.0, 0.3, 1.0, 0.7))
        for number, target in enumerate(world.targets_3d, start=1)
    ]
    obstacles = world.obstacles
    for number, (centre, radius, sphere) in enumerate(
        zip(obstacles.centres, obstacles.radii, obstacles.spheres), start=1
    ):
        shape = sphere_marker(
            header, 'obstacles', number, centre, 2.0 * float(radius), colour(0.3, 0.3, 0.3)
        )
        if not sphere:
            shape.type = Marker.CYLINDER
            low, high = world.bounds[2] if world.dimension == 3 else (0.0, float(radius))
            shape.pose.position = point_to_ros([*centre[:2], 0.5 * (low + high)])
            shape.scale.z = float(high - low)
        shapes.append(shape)
    markers.publish(MarkerBoard().replace(MarkerArray(markers=shapes)))
    return [targets, markers]
