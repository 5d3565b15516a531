"""Conversions between messages and records of the planner, and checks of received messages."""

import array
import math
from collections.abc import Collection

import numpy as np
import shapely
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Path
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from maasi_filter.arrays import FloatArray
from maasi_filter.colours import KEEP_OUT
from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose
from maasi_filter.records import Cluster
from maasi_filter.ros.clocks import LAST_STAMP, batch_id_limit
from maasi_filter.ros.conversions import (
    FASTEST,
    bounded,
    check_frame,
    cluster_from_ros,
    colour_of,
    line_marker,
    point_to_ros,
    pose_from_ros,
    shape_marker,
)
from maasi_filter.unexplored_map import UnexploredMap
from maasi_msgs.msg import AgentState, Candidate, FilterUpdate, PlanDecision
from maasi_msgs.msg import RobotDecision as RobotDecisionMessage
from maasi_planner.motion import RobotState
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.team import Decision, RobotDecision

NOT_ALLOWED = -1e30  # J of an inadmissible candidate; messages contain finite numbers only


def _robot_to_ros(name: str, index: int, decision: RobotDecision) -> RobotDecisionMessage:
    objective = decision.objective.tolist()
    rows = zip(
        decision.candidates.tolist(),
        decision.control_cost.tolist(),
        decision.target_refinement.tolist(),
        decision.exploration.tolist(),
        objective,
        decision.lengths.tolist(),
        decision.measurements.tolist(),
    )
    return RobotDecisionMessage(
        robot=name,
        decision=index,
        chosen=decision.chosen,
        waypoint=point_to_ros(decision.waypoint),
        candidates=[
            Candidate(
                position=point_to_ros(position),
                control_cost=cost,
                target_refinement=refinement,
                exploration=exploration,
                objective=value if math.isfinite(value) else NOT_ALLOWED,
                length=length,
                measurements=measurements,
            )
            for position, cost, refinement, exploration, value, length, measurements in rows
        ],
        tour=list(map(point_to_ros, decision.tour)),
    )


def decision_to_ros(
    decision: Decision,
    indices: dict[str, int],
    planner: str,
    batch: int,
    explored: float,
    header: Header,
) -> PlanDecision:
    """Return a joint decision."""
    # Terms of the objective explain its choices.
    reasons = [
        f'{name}: {robot.reason}'
        for name, robot in sorted(decision.robots.items())
        if robot.stays or not robot.objective.any()
    ]
    return PlanDecision(
        header=header,
        step=decision.step,
        planner=planner,
        batch_id=batch,
        objective=decision.objective if math.isfinite(decision.objective) else NOT_ALLOWED,
        explored=explored,
        reason='; '.join(reasons) if decision.robots else decision.reason,
        robots=[
            _robot_to_ros(name, indices[name], robot)
            for name, robot in sorted(decision.robots.items())
        ],
    )


def path_to_ros(positions: FloatArray, header: Header, most: int = 50) -> Path:
    """Return a trajectory with at most `most` poses."""
    count = len(positions)
    chosen = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
    poses = []
    for index in chosen.tolist() if count else []:
        pose = PoseStamped(header=header)
        pose.pose.position = point_to_ros(positions[index])
        pose.pose.orientation.w = 1.0
        poses.append(pose)
    return Path(header=header, poses=poses)


def exploration_to_ros(exploration: UnexploredMap, header: Header) -> OccupancyGrid:
    """Return e in 2D as a grid: 100 is unseen, 0 searched, -1 where no target can be."""
    lower, step, values = exploration.shown()
    grid = OccupancyGrid(header=header)
    grid.info.map_load_time = header.stamp
    grid.info.resolution = float(step[0])
    grid.info.width, grid.info.height = values.shape[:2]
    grid.info.origin.position = point_to_ros(lower - 0.5 * step)
    grid.info.origin.orientation.w = 1.0
    cells = np.where(values < 0.0, -1.0, np.rint(100.0 * values)).T.astype(np.int8)
    grid.data = array.array('b', cells.tobytes())
    return grid


def planner_markers(
    robots: dict[str, tuple[FloatArray, FloatArray, FloatArray, FloatArray]],
    tints: dict[str, str],
    header: Header,
    size: float,
) -> MarkerArray:
    """Return markers of robots, waypoints, paths and tours, in the robots' colours."""
    markers = []
    for number, name in enumerate(sorted(robots)):
        position, waypoint, path, tour = robots[name]
        tint = colour_of(tints[name])
        for namespace, centre, shape in (
            ('robots', position, Marker.SPHERE),
            ('waypoints', waypoint, Marker.CUBE),
        ):
            markers.append(shape_marker(header, namespace, number, centre, size, tint, shape))
        thinned = path[:: max(1, len(path) // 50)]
        for namespace, corners, width in (
            ('ways', thinned, 0.2 * size),
            ('tours', [waypoint, *tour], 0.07 * size),
        ):
            line = line_marker(header, namespace, number, corners, width, tint)
            line.action = Marker.ADD if len(line.points) > 1 else Marker.DELETE
            markers.append(line)
    return MarkerArray(markers=markers)


def area_markers(area: Area, header: Header, size: float) -> MarkerArray:
    """Return markers of the outlines of area, keep-outs and solid polygons."""
    tints = {'area': '#1B1F24', 'keep_out': KEEP_OUT, 'obstacle': '#59636E'}
    markers: list[Marker] = []
    for kind, shapes in area.shapes.items():
        for ring in shapely.get_rings(shapely.get_parts(shapes)):
            corners, tint = shapely.get_coordinates(ring), colour_of(tints[kind])
            markers.append(line_marker(header, kind, len(markers), corners, 0.1 * size, tint))
    return MarkerArray(markers=markers)


def checked_state(name: str, message: AgentState, settings: PlannerNodeSettings) -> RobotState:
    """Return the state in a message on the topic of a robot."""
    if message.robot != name:
        raise ValueError(f'robot: read {message.robot!r}, allowed is {name!r}')
    check_frame(message.header, settings.frame)
    linear, angular = message.twist.linear, message.twist.angular
    velocity, rates = (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z)
    bounded('twist.linear', velocity, FASTEST)
    bounded('twist.angular', rates, FASTEST)
    state = RobotState(pose_from_ros(message.pose.pose), np.array(velocity), np.array(rates))
    if message.step * settings.step >= LAST_STAMP:
        raise ValueError(f'step: read {message.step}, allowed are steps whose time is a stamp')
    return state


def checked_update(
    message: FilterUpdate, names: Collection[str], settings: PlannerNodeSettings, batch: int
) -> tuple[list[Cluster], dict[str, Pose]]:
    """Return clusters and poses of an update; ValueError for unknown members and impossible ids."""
    check_frame(message.header, settings.frame)
    dimension = settings.environment.dimension
    clusters = [cluster_from_ros(item, dimension) for item in message.clusters]
    strangers = {item.robot for item in message.members} - set(names)
    if strangers:
        raise ValueError(f'members: read {sorted(strangers)}, allowed are {names}')
    limit = batch_id_limit(batch)
    if message.batch_id > limit:
        raise ValueError(f'batch_id: read {message.batch_id}, allowed is up to {limit}')
    limit = batch_id_limit(0)
    poses = {}
    for member in message.members:
        if member.measurement > limit:
            raise ValueError(
                f'members: {member.robot}: measurement: read {member.measurement}, allowed is '
                f'up to {limit}'
            )
        try:
            poses[member.robot] = pose_from_ros(member.pose)
        except ValueError as error:
            raise ValueError(f'members: {member.robot}: pose.{error}') from None
    return clusters, poses
