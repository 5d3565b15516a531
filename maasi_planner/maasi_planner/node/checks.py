"""Checks of messages that the planner node receives.

Each raises `ValueError` naming the field, what was read, and what is allowed.
"""

from __future__ import annotations

from collections.abc import Collection

from std_msgs.msg import Header

from maasi_filter.models.pose import Pose
from maasi_filter.records import Cluster
from maasi_filter.ros.clocks import LAST_STAMP, batch_id_limit
from maasi_filter.ros.conversions import cluster_from_ros, pose_from_ros
from maasi_msgs.msg import AgentState, FilterUpdate
from maasi_planner.conversions import robot_state_from_ros
from maasi_planner.motion import RobotState
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planners.base import check_clusters


def _check_frame(header: Header, frame: str) -> None:
    if header.frame_id != frame:
        raise ValueError(f'header.frame_id: read {header.frame_id!r}, allowed is {frame!r}')


def checked_state(name: str, message: AgentState, settings: PlannerNodeSettings) -> RobotState:
    """Return the state in a message that came on the topic of a robot."""
    if message.robot != name:
        raise ValueError(f'robot: read {message.robot!r}, allowed is {name!r}')
    _check_frame(message.header, settings.frame)
    state = robot_state_from_ros(message)
    if message.step * settings.step >= LAST_STAMP:
        raise ValueError(f'step: read {message.step}, allowed are steps whose time is a stamp')
    return state


def checked_update(
    message: FilterUpdate, names: Collection[str], settings: PlannerNodeSettings, batch: int
) -> tuple[list[Cluster], dict[str, Pose]]:
    """Return the clusters of an update and the poses of its members, by name.

    Members may be robots of `names`; `batch` is the id of the last batch.

    Ids and indices so large that the planner could not continue from them are refused.
    """
    _check_frame(message.header, settings.frame)
    dimension = settings.environment.dimension
    clusters = [cluster_from_ros(item, dimension) for item in message.clusters]
    strangers = {item.robot for item in message.members} - set(names)
    if strangers:
        raise ValueError(f'members: read {sorted(strangers)}, allowed are {names}')
    check_clusters(clusters)
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
