"""Conversions between messages and library records, in pairs."""

import array
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Quaternion
from geometry_msgs.msg import Pose as PoseMessage
from sensor_msgs.msg import NavSatFix, NavSatStatus, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from maasi_filter.arrays import FloatArray
from maasi_filter.colours import FOUND, POTENTIAL
from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor, is_covariance
from maasi_filter.records import (
    UNLABELLED,
    AgentMeasurement,
    Cluster,
    FoundTarget,
    Label,
    rounded_score,
)
from maasi_filter.reports import KINDS, Report
from maasi_msgs.msg import Cluster as ClusterMessage
from maasi_msgs.msg import Detection, DetectionArray, FoundFixArray, RangeMeasurement
from maasi_msgs.msg import FoundTarget as FoundTargetMessage
from maasi_msgs.msg import Report as ReportMessage

#: Largest number of detections used from one message, which bounds the computation time.
MOST_DETECTIONS = 200

FARTHEST = 4e7  #: largest accepted coordinate [m]: the circumference of the Earth
FASTEST = 1e5  #: largest accepted speed [m/s, rad/s]

LONGEST_NAME = 100  #: most characters of a class or identity


def stamp_to_ros(nanoseconds: int) -> Time:
    """Return a stamp."""
    seconds, rest = divmod(int(nanoseconds), 1_000_000_000)
    return Time(sec=seconds, nanosec=rest)


def stamp_from_ros(stamp: Time) -> int:
    """Return a stamp in nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_of_step(step: int, duration: float) -> int:
    """Return the time [ns] of a step of `duration` seconds."""
    return round(step * duration * 1e9)


def bounded(name: str, values: Iterable[float], limit: float) -> None:
    """Raise ValueError for numbers of a field that are not finite or would overflow later."""
    # Also false for NaN.
    if not all(abs(value) <= limit for value in values):
        raise ValueError(
            f'{name}: got {np.asarray(values).tolist()}, allowed are finite numbers up to '
            f'{limit:g} in magnitude'
        )


def check_frame(header: Header, frame: str) -> None:
    """Refuse a message in another frame; ValueError names it."""
    if header.frame_id != frame:
        raise ValueError(f'header.frame_id: read {header.frame_id!r}, allowed is {frame!r}')


def point_to_ros(position: Sequence[float] | FloatArray) -> Point:
    """Return a position of two or three coordinates [m]."""
    z = float(position[2]) if len(position) == 3 else 0.0
    return Point(x=float(position[0]), y=float(position[1]), z=z)


def point_from_ros(point: Point) -> FloatArray:
    """Return a position, (3,) [m]."""
    return np.array([point.x, point.y, point.z])


def pose_to_ros(pose: Pose) -> PoseMessage:
    """Return a pose."""
    w, x, y, z = (float(value) for value in pose.orientation)
    return PoseMessage(
        position=point_to_ros(pose.position), orientation=Quaternion(x=x, y=y, z=z, w=w)
    )


def pose_from_ros(message: PoseMessage) -> Pose:
    """Return a pose."""
    turn = message.orientation
    position = message.position
    bounded('position', (position.x, position.y, position.z), FARTHEST)
    bounded('orientation', (turn.w, turn.x, turn.y, turn.z), 1e6)
    return Pose(point_from_ros(message.position), np.array([turn.w, turn.x, turn.y, turn.z]))


def covariance_to_ros(covariance: FloatArray) -> list[float]:
    """Return a covariance (2, 2) or (3, 3) as nine numbers, row-major."""
    values: list[float] = np.pad(covariance, (0, 3 - len(covariance))).ravel().tolist()
    return values


def covariance_from_ros(values: Sequence[float], dimension: int) -> FloatArray:
    """Return the first `dimension` rows and columns of nine numbers."""
    return np.array(values, dtype=float).reshape(3, 3)[:dimension, :dimension]


def cluster_to_ros(cluster: Cluster) -> ClusterMessage:
    """Return a cluster."""
    return ClusterMessage(
        position=point_to_ros(cluster.position),
        covariance=covariance_to_ros(cluster.covariance),
        radius=float(cluster.radius),
        mass=float(cluster.mass),
    )


def cluster_from_ros(message: ClusterMessage, dimension: int) -> Cluster:
    """Return a cluster."""
    position = message.position
    bounded('clusters: position', (position.x, position.y, position.z), FARTHEST)
    bounded('clusters: covariance', message.covariance, FARTHEST**2)
    bounded('clusters: radius, mass', (message.radius, message.mass), FARTHEST)
    if message.mass < 0.0:
        raise ValueError(f'clusters: mass: read {message.mass}, allowed is from 0')
    return Cluster(
        position=point_from_ros(message.position)[:dimension],
        covariance=covariance_from_ros(message.covariance, dimension),
        radius=message.radius,
        mass=message.mass,
    )


def found_target_to_ros(target: FoundTarget, batch: int) -> FoundTargetMessage:
    """Return a found target and the batch that completed it."""
    return FoundTargetMessage(
        id=target.id,
        position=point_to_ros(target.position),
        covariance=covariance_to_ros(target.covariance),
        robot=target.robot,
        measurement=target.measurement,
        batch_id=batch,
        stamp=stamp_to_ros(round(target.time * 1e9)),
        class_id=target.label.class_id,
        score=target.label.score,
        identity=target.label.identity,
    )


def found_target_from_ros(message: FoundTargetMessage, dimension: int) -> FoundTarget:
    """Return a found target."""
    return FoundTarget(
        id=int(message.id),
        position=point_from_ros(message.position)[:dimension],
        covariance=covariance_from_ros(message.covariance, dimension),
        robot=message.robot,
        measurement=int(message.measurement),
        time=stamp_from_ros(message.stamp) * 1e-9,
        label=label_from_ros(message),
    )


def report_to_ros(report: Report, header: Header) -> ReportMessage:
    """Return the message of a statement of a person."""
    return ReportMessage(
        header=header,
        id=report.id,
        batch_id=report.batch,
        kind=KINDS.index(report.kind),
        source=report.source,
        target=report.target,
        position=point_to_ros([*report.position, 0.0, 0.0][:3]),
        radius=report.radius,
        weight=report.weight,
        zone=report.zone,
    )


def report_from_ros(message: ReportMessage, dimension: int) -> Report:
    """Return a statement of a person; ValueError for unusable numbers."""
    if not 0 < message.kind < len(KINDS):
        raise ValueError(f'kind: read {message.kind}, allowed are 1 to {len(KINDS) - 1}')
    at = message.position
    position = (at.x, at.y, at.z)
    bounded('position', position, FARTHEST)
    bounded('radius', [message.radius], FARTHEST)
    bounded('weight', [message.weight], FARTHEST)
    report = Report(
        KINDS[message.kind],
        float(message.weight),
        message.source,
        int(message.target),
        [float(value) for value in position[:dimension]],
        float(message.radius),
        message.zone,
        int(message.id),
        1e-9 * stamp_from_ros(message.header.stamp),
        int(message.batch_id),
    )
    report.check()
    return report


def found_fixes_to_ros(
    targets: Sequence[FoundTarget], origin: OriginSettings, header: Header, batch: int
) -> FoundFixArray:
    """Return geographic positions of found targets; in 2D at the origin's altitude."""
    fixes = [geodetic(target.position[None], origin)[0].tolist() for target in targets]
    fixes = [
        NavSatFix(
            header=Header(stamp=stamp_to_ros(round(target.time * 1e9)), frame_id=header.frame_id),
            status=NavSatStatus(status=NavSatStatus.STATUS_FIX),
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=covariance_to_ros(target.covariance),
            position_covariance_type=NavSatFix.COVARIANCE_TYPE_KNOWN,
        )
        for target, (latitude, longitude, altitude) in zip(targets, fixes)
    ]
    ids = [target.id for target in targets]
    return FoundFixArray(header=header, batch_id=batch, ids=ids, fixes=fixes)


def detections_to_ros(
    values: FloatArray, covariances: FloatArray | None, labels: Sequence[Label] = ()
) -> list[Detection]:
    """Return detections."""
    names = labels or [UNLABELLED] * len(values)
    return [
        Detection(
            range=float(value[0]),
            bearing=float(value[1]),
            elevation=float(value[2]) if len(value) == 3 else 0.0,
            covariance=[] if covariances is None else covariances[index].ravel().tolist(),
            class_id=label.class_id,
            score=label.score,
            identity=label.identity,
        )
        for index, (value, label) in enumerate(zip(values, names))
    ]


def label_from_ros(message: Detection | RangeMeasurement | FoundTargetMessage) -> Label:
    """Return the label of a message; its score may exceed [0, 1] by rounding."""
    return Label(message.class_id, rounded_score(message.score), message.identity)


def labels_of(messages: Sequence[Detection] | Sequence[RangeMeasurement]) -> tuple[Label, ...]:
    """Return the labels of messages; empty if none has one."""
    labels = tuple(map(label_from_ros, messages))
    return labels if any(label != UNLABELLED for label in labels) else ()


def label_problem(message: Detection | RangeMeasurement | Label) -> str | None:
    """Return the error of a class, score or identity: field, read and allowed values."""
    if not 0.0 <= rounded_score(message.score) <= 1.0:
        return f'score: read {message.score}, allowed is 0 to 1'
    for name in ('class_id', 'identity'):
        text = getattr(message, name)
        if len(text) > LONGEST_NAME:
            return f'{name}: read {len(text)} characters, allowed are {LONGEST_NAME}'
    return None


def detection_problem(detection: Detection, dimension: int) -> str | None:
    """Return the error of a detection: field, read and allowed values."""
    if not 0.0 <= detection.range < math.inf:
        return f'range: read {detection.range}, allowed are finite numbers from 0 [m]'
    for name, limit in (('bearing', math.pi), ('elevation', 0.5 * math.pi)):
        value = getattr(detection, name)
        if not abs(value) <= limit + 1e-6:
            return f'{name}: read {value}, allowed is {-limit:.4f} to {limit:.4f} [rad]'
    if problem := label_problem(detection):
        return problem
    size = len(detection.covariance)
    if size not in (0, dimension * dimension):
        return f'covariance: read {size} numbers, allowed are {dimension * dimension}, or none'
    if size and not is_covariance(np.reshape(detection.covariance, (dimension, dimension))):
        return (
            f'covariance: read {list(detection.covariance)}, allowed is a symmetric positive '
            'definite matrix of finite numbers'
        )
    return None


def measurement_from_ros(
    message: DetectionArray, sensor: Sensor, drop: Callable[[str, str, int], None]
) -> AgentMeasurement:
    """Return a robot's measurement; `drop` receives invalid, equal and surplus detections."""
    pose = pose_from_ros(message.pose.pose)
    errors = np.array(message.pose.covariance, dtype=float).reshape(6, 6)[:3, :3]
    if not np.isfinite(errors).all():
        raise ValueError(f'pose.covariance: read {errors.tolist()}, allowed is finite')
    d, total = sensor.dimension, len(message.detections)
    kept: list[Detection] = []
    seen: set[tuple[float, ...]] = set()
    for index, item in enumerate(message.detections):
        if len(kept) == MOST_DETECTIONS:
            text = f'detections: read {total}, allowed are {MOST_DETECTIONS} that can be used'
            drop('too many detections', text, total - index)
            break
        key = (item.range, item.bearing, item.elevation)
        if problem := detection_problem(item, d):
            drop('bad detection', f'detections[{index}].{problem}', 1)
        elif key in seen:
            text = f'detections[{index}]: read {key}, allowed is each one once'
            drop('equal detection', text, 1)
        else:
            seen.add(key)
            kept.append(item)
    values = np.array([[item.range, item.bearing, item.elevation][:d] for item in kept], float)
    covariances = None
    if any(len(item.covariance) for item in kept):
        given = [item.covariance if len(item.covariance) else sensor.covariance for item in kept]
        covariances = np.array([np.reshape(item, (d, d)) for item in given])
    return AgentMeasurement(
        robot=message.robot,
        pose=pose,
        sensor=sensor,
        values=values.reshape(-1, d),
        covariances=covariances,
        index=int(message.measurement),
        # A negative variance means that the error is unknown.
        position_covariance=errors if np.diagonal(errors).min() >= 0.0 else None,
        labels=labels_of(kept),
    )


def particles_to_ros(positions: FloatArray, weights: FloatArray, header: Header) -> PointCloud2:
    """Return particles as a cloud of x, y, z [m] and weight, all float32."""
    number, dimension = positions.shape
    data = np.zeros((number, 4), dtype='<f4')
    data[:, :dimension] = positions
    data[:, 3] = weights
    return PointCloud2(
        header=header,
        height=1,
        width=number,
        fields=[
            PointField(name=name, offset=4 * index, datatype=PointField.FLOAT32, count=1)
            for index, name in enumerate(('x', 'y', 'z', 'weight'))
        ],
        is_bigendian=False,
        point_step=16,
        row_step=16 * number,
        data=array.array('B', data.tobytes()),
        is_dense=True,
    )


def colour_of(text: str, alpha: float = 1.0) -> ColorRGBA:
    """Return a colour given as #RRGGBB."""
    red, green, blue = (value / 255.0 for value in bytes.fromhex(text[1:]))
    return colour(red, green, blue, alpha)


def colour(red: float, green: float, blue: float, alpha: float = 1.0) -> ColorRGBA:
    """Return a colour."""
    return ColorRGBA(r=red, g=green, b=blue, a=alpha)


def shape_marker(
    header: Header,
    namespace: str,
    number: int,
    position: FloatArray,
    size: float | FloatArray,
    tint: ColorRGBA,
    kind: int = Marker.SPHERE,
) -> Marker:
    """Return a marker of one size or (3,), which namespace and number identify."""
    marker = Marker(header=header, ns=namespace, id=number, type=kind, color=tint)
    marker.pose.position = point_to_ros(position)
    marker.pose.orientation.w = 1.0
    marker.scale.x, marker.scale.y, marker.scale.z = map(float, np.broadcast_to(size, 3))
    return marker


def line_marker(
    header: Header,
    namespace: str,
    number: int,
    points: Iterable[Sequence[float] | FloatArray],
    width: float,
    tint: ColorRGBA,
) -> Marker:
    """Return a marker of a line through points, as `shape_marker`."""
    marker = Marker(header=header, ns=namespace, id=number, type=Marker.LINE_STRIP, color=tint)
    marker.pose.orientation.w = 1.0
    marker.scale.x = width
    marker.points = [point_to_ros(point) for point in points]
    return marker


def filter_markers(
    header: Header, clusters: Iterable[Cluster], found: Iterable[FoundTarget], size: float
) -> MarkerArray:
    """Return markers of clusters (orange, scaled by width) and found targets (green)."""
    markers = [
        shape_marker(
            header,
            'clusters',
            number,
            cluster.position,
            max(2.0 * cluster.radius, 0.5 * size),
            colour_of(POTENTIAL, 0.2 + 0.6 * min(cluster.mass, 1.0)),
        )
        for number, cluster in enumerate(clusters, start=1)
    ]
    tint = colour_of(FOUND)
    markers += [shape_marker(header, 'found', t.id, t.position, size, tint) for t in found]
    return MarkerArray(markers=markers)


class MarkerBoard:
    """Lets each array of markers replace the previous one."""

    def __init__(self) -> None:
        self._shown: dict[tuple[str, int], Marker] | None = None

    def replace(self, markers: MarkerArray) -> MarkerArray:
        """Return an array that shows only these markers of the node."""
        now = {(item.ns, item.id): item for item in markers.markers if item.action == Marker.ADD}
        if self._shown is None:
            header = markers.markers[0].header if markers.markers else Marker().header
            gone = [Marker(header=header, action=Marker.DELETEALL)]
        else:
            gone = [
                Marker(header=before.header, ns=before.ns, id=before.id, action=Marker.DELETE)
                for key, before in self._shown.items()
                if key not in now
            ]
        self._shown = now
        return MarkerArray(markers=[*gone, *markers.markers])
