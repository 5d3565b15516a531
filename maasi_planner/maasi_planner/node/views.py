"""Topics of the planner node for viewers, at a limited rate."""

import math

import numpy as np
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from maasi_filter.colours import robot_colours
from maasi_filter.ros.conversions import MarkerBoard, particles_to_ros
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import LATCHED
from maasi_planner.conversions import area_markers, exploration_to_ros, planner_markers
from maasi_planner.coordinator import Coordinator
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.robot_plan import PresentRobot
from maasi_planner.terrain_frame import on_map


class PlannerViews:
    """The exploration function, and markers of robots and their paths."""

    def __init__(self, node: LockstepLifecycleNode[PlannerNodeSettings]) -> None:
        self._node = node
        bounds = node.settings.environment.array()
        self._size = 0.02 * float((bounds[:, 1] - bounds[:, 0]).max())
        self._flat = node.settings.environment.dimension == 2
        self.reset()

    def reset(self) -> None:
        """Reset for a new search."""
        self._board = MarkerBoard()
        self._at = -math.inf

    def set_up(self) -> None:
        """Create the publishers."""
        self._markers = self._node.create_publisher(MarkerArray, 'markers', 10)
        kind = OccupancyGrid if self._flat else PointCloud2
        self._exploration = self._node.create_publisher(kind, 'exploration', LATCHED)

    def publish(
        self, coordinator: Coordinator, robots: dict[str, PresentRobot], header: Header, now: float
    ) -> None:
        """Publish what is due at the time `now` [s]."""
        rate = self._node.settings.views_rate
        if rate <= 0.0 or abs(now - self._at) < 1.0 / rate:
            return
        self._at = now
        exploration = coordinator.exploration
        if self._flat:
            self._exploration.publish(exploration_to_ros(exploration, header))
        else:
            unseen = np.ravel(exploration.unseen())
            # Viewers omit NaN.
            unseen[unseen < 0.0] = np.nan
            self._exploration.publish(particles_to_ros(exploration.nodes(), unseen, header))
        shown, terrain = {}, coordinator.area.terrain
        for name, robot in robots.items():
            plan = coordinator.robots[name].plan
            here = np.asarray(robot.state.pose.position)
            waypoint = plan.positions[-1] if len(plan.positions) else here
            ends = on_map(np.stack([here, waypoint]), terrain)
            shown[name] = (*ends, on_map(plan.positions, terrain), on_map(plan.tour, terrain))
        # Colours are those of the whole team, also for a robot with its own planner.
        tints = robot_colours([*coordinator.names, *self._node.settings.others])
        markers = planner_markers(shown, tints, header, self._size)
        markers.markers += area_markers(coordinator.area, header, self._size).markers
        self._markers.publish(self._board.replace(markers))
