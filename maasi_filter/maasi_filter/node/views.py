"""What the filter node publishes for viewers, at a limited rate."""

from __future__ import annotations

import math

from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from maasi_filter.ros.conversions import MarkerBoard, filter_markers, particles_to_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.node_settings import FilterNodeSettings
from maasi_filter.search_filter import SearchFilter


class FilterViews:
    """Particles and markers.

    Publishes
    ---------
    `particles` (sensor_msgs/PointCloud2), `markers` (visualization_msgs/MarkerArray)

    Parameters
    ----------
    node : LockstepLifecycleNode
        The filter node.
    """

    def __init__(self, node: LockstepLifecycleNode[FilterNodeSettings]) -> None:
        self._node = node
        bounds = node.settings.environment.array()
        self._size = 0.01 * float((bounds[:, 1] - bounds[:, 0]).max())
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self._board = MarkerBoard()
        self._particles_at = self._markers_at = -math.inf

    def set_up(self) -> None:
        """Create the publishers."""
        self._particles = self._node.create_publisher(PointCloud2, 'particles', 2)
        self._markers = self._node.create_publisher(MarkerArray, 'markers', 10)

    def publish(self, search: SearchFilter, header: Header, now: float) -> None:
        """Publish what is due at the time `now` [s]."""
        settings = self._node.settings
        if _is_due(settings.particles_rate, now, self._particles_at):
            self._particles_at = now
            self._particles.publish(particles_to_ros(search.particles, search.weights, header))
        if _is_due(settings.markers_rate, now, self._markers_at):
            self._markers_at = now
            markers = filter_markers(header, search.clusters, search.found_targets, self._size)
            self._markers.publish(self._board.replace(markers))


def _is_due(rate: float, now: float, last: float) -> bool:
    return rate > 0.0 and abs(now - last) >= 1.0 / rate
