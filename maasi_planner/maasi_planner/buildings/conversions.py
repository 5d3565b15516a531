"""Conversions between messages and records of the search of buildings."""

from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Vector3
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from maasi_filter.arrays import FloatArray
from maasi_filter.colours import robot_colours
from maasi_filter.ros.conversions import (
    FARTHEST,
    FASTEST,
    bounded,
    colour,
    colour_of,
    line_marker,
    point_from_ros,
    point_to_ros,
    shape_marker,
)
from maasi_msgs.msg import CuboidDecision, SearchLink
from maasi_msgs.msg import Snapshot as SnapshotMessage
from maasi_planner.buildings.agent import Broadcast, SearchAgent, Snapshot
from maasi_planner.buildings.preplanning import CoveragePlan
from maasi_planner.buildings.problem import Plan
from maasi_planner.buildings.settings import HazardSettings

_LARGEST_HAZARD = 1e9  # upper bound of the parameters of a battery


def vector_to_ros(values: FloatArray) -> Vector3:
    """Return a vector (3,)."""
    x, y, z = map(float, values)
    return Vector3(x=x, y=y, z=z)


def vector_from_ros(message: Vector3) -> FloatArray:
    """Return a vector, (3,)."""
    return np.array([message.x, message.y, message.z])


def broadcast_to_ros(broadcast: Broadcast, header: Header) -> SearchLink:
    """Return the message of a robot to the others."""
    return SearchLink(
        header=header,
        step=broadcast.step,
        robot=broadcast.robot,
        silent=False,
        searching=broadcast.searching,
        position=point_to_ros(broadcast.position),
        velocity=vector_to_ros(broadcast.velocity),
        visited=broadcast.visited.tolist(),
        flight_steps=broadcast.flight_steps,
        planned=list(broadcast.plan),
        planned_in=list(broadcast.plan.values()),
        alpha=broadcast.hazard.alpha,
        beta=broadcast.hazard.beta,
        failures=broadcast.hazard.failures,
        predicted=point_to_ros(broadcast.predicted),
    )


def broadcast_from_ros(message: SearchLink, cuboids: int) -> Broadcast:
    """Return the broadcast of another robot."""
    if len(message.visited) != cuboids:
        raise ValueError(
            f'visited: read {len(message.visited)} cuboids, allowed are {cuboids}: the missions '
            'must be the same'
        )
    if len(message.planned) != len(message.planned_in):
        raise ValueError(
            f'planned_in: read {len(message.planned_in)} numbers, allowed are as many as planned, '
            f'{len(message.planned)}'
        )
    if any(n >= cuboids for n in message.planned):
        raise ValueError(f'planned: read {max(message.planned)}, allowed is below {cuboids}')
    position, velocity = point_from_ros(message.position), vector_from_ros(message.velocity)
    predicted = point_from_ros(message.predicted)
    bounded('position, predicted', [*position, *predicted], FARTHEST)
    bounded('velocity', velocity, FASTEST)
    bounded('alpha, beta', (message.alpha, message.beta), _LARGEST_HAZARD)
    if message.alpha <= 0.0 or message.beta <= 0.0:
        raise ValueError(
            f'alpha, beta: read {message.alpha}, {message.beta}, allowed are numbers above 0'
        )
    return Broadcast(
        robot=message.robot,
        step=int(message.step),
        position=position,
        velocity=velocity,
        searching=bool(message.searching),
        visited=np.array(message.visited, dtype=bool),
        flight_steps=int(message.flight_steps),
        plan={int(n): int(k) for n, k in zip(message.planned, message.planned_in)},
        hazard=HazardSettings(
            alpha=message.alpha, beta=message.beta, failures=bool(message.failures)
        ),
        predicted=predicted,
    )


def decision_to_ros(
    agent: SearchAgent, plan: Plan, shots: list[Snapshot], header: Header
) -> CuboidDecision:
    """Return a decision with its new snapshots; received robots are not set."""
    return CuboidDecision(
        header=header,
        step=agent.step,
        robot=agent.name,
        activity=agent.activity.value,
        how=plan.how,
        target=point_to_ros(agent.target),
        visited=int(agent.visited.sum()),
        done=agent.done,
        objective=plan.objective,
        nodes=plan.nodes,
        control=vector_to_ros(plan.controls[0]),
        planned=[n for _, n in plan.visits],
        planned_in=[k for k, _ in plan.visits],
        snapshots=[
            SnapshotMessage(
                cuboid=shot.cuboid,
                position=point_to_ros(shot.position),
                direction=vector_to_ros(shot.direction),
                distance=shot.distance,
                detection_probability=shot.detection_probability,
            )
            for shot in shots
        ],
    )


def mission_markers(mission: CoveragePlan, header: Header) -> MarkerArray:
    """Return objects and obstacles as boxes."""
    solid, barrier = colour(0.6, 0.6, 0.7, 0.6), colour(0.4, 0.38, 0.33, 0.9)
    objects = [_box(header, 'objects', n, box, solid) for n, box in enumerate(mission.objects)]
    others = [_box(header, 'obstacles', n, box, barrier) for n, box in enumerate(mission.obstacles)]
    return MarkerArray(markers=objects + others)


def agent_markers(
    agent: SearchAgent, plan: Plan, header: Header, team: Sequence[str] = ()
) -> MarkerArray:
    """Return markers of a robot, its plan, search map and camera direction."""
    name = agent.name
    tint_of_robot = colour_of(robot_colours({name, *team})[name])
    markers = []
    for number, box in enumerate(agent.mission.boxes):
        visited = bool(agent.visited[number])
        tint = colour(0.3, 0.7, 0.9, 0.1) if visited else colour(0.85, 0.4, 0.0, 0.35)
        markers.append(_box(header, f'{name}/cuboids', number, box, tint))
    robot = shape_marker(header, f'{name}/robot', 0, agent.position, 4.0, tint_of_robot)
    line = line_marker(header, f'{name}/plan', 0, plan.positions, 0.8, tint_of_robot)
    ends = []
    if agent.snapshots:
        shot = agent.snapshots[-1]
        ends = [shot.position, shot.position + shot.distance * shot.direction]
    arrow = line_marker(header, f'{name}/camera', 0, ends, 0.8, colour(0.9, 0.1, 0.1))
    arrow.type, arrow.scale.y = Marker.ARROW, 2.0
    arrow.action = Marker.ADD if ends else Marker.DELETE
    return MarkerArray(markers=[*markers, robot, line, arrow])


def _box(header: Header, namespace: str, number: int, box: FloatArray, tint: ColorRGBA) -> Marker:
    sides = box[:, 1] - box[:, 0]
    return shape_marker(header, namespace, number, box.mean(axis=1), sides, tint, Marker.CUBE)
