"""Input and output of search filters: measurements, clusters, found targets, results."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor


def rounded_score(score: float) -> float:
    """Return a score moved into [0, 1], as sums of probabilities have rounding errors."""
    return float(min(max(score, 0.0), 1.0)) if -1e-6 <= score <= 1.0 + 1e-6 else score


@dataclass(frozen=True)
class Label:
    """Class and identity of a detection or a found target.

    Parameters
    ----------
    class_id : str
        Name of the class; empty if unknown.
    score : float
        Confidence in the class, 0 to 1; 0 if unknown.
    identity : str
        Unique identity of the target, such as the id of a marker; empty if unknown.

    Raises
    ------
    ValueError
        If the score is outside of [0, 1].
    """

    class_id: str = ''
    score: float = 0.0
    identity: str = ''

    def __post_init__(self) -> None:
        # Negated, so that NaN is refused too.
        if not 0.0 <= self.score <= 1.0:
            raise ValueError(f'score: got {self.score}, allowed is 0 to 1')


UNLABELLED = Label()  #: without class and identity


@dataclass
class AgentMeasurement:
    """Measurement of one robot at one step, possibly without detections.

    Parameters
    ----------
    robot : str
        Name of the robot; robots are processed in the order of their names.
    pose : Pose
        Pose of the sensor at the time of the measurement, frame `map`.
    sensor : Sensor
        Sensor that measured.
    values : (m, d) array
        Range [m], bearing [rad] and, in 3D, elevation [rad] of each detection.
    covariances : (m, d, d) array, optional
        Covariance of each detection, in place of the sensor's; not used by the PHD filter.
    index : int
        Measurement index of the robot.
    position_covariance : (3, 3) array, optional
        Covariance of the reported robot position, square metres. Covariances of detections are
        assumed to include it.
    labels : sequence of Label
        Class and identity of each detection; empty if all are unknown.
    """

    robot: str
    pose: Pose
    sensor: Sensor
    values: FloatArray
    covariances: FloatArray | None = None
    index: int = 0
    position_covariance: FloatArray | None = None
    labels: Sequence[Label] = ()


@dataclass
class Cluster:
    """A potential target.

    Parameters
    ----------
    position : (d,) array
        Weighted mean, metres, frame `map`.
    covariance : (d, d) array
        Weighted covariance, square metres.
    radius : float
        Weighted root mean square distance from the mean, metres.
    mass : float
        Expected number of targets in the cluster.
    """

    position: FloatArray
    covariance: FloatArray
    radius: float
    mass: float


@dataclass
class FoundTarget:
    """A found target.

    Parameters
    ----------
    id : int
        Number from 1, in the order of being found.
    position : (d,) array
        Estimated position, metres, frame `map`.
    covariance : (d, d) array
        Covariance of the position error, square metres.
    robot : str
        Robot whose measurement completed the target.
    measurement : int
        Measurement index of that robot.
    time : float
        Time of the find, seconds.
    origin : int
        Id in the filter of the robot that found it; 0 if this filter found it.
    label : Label
        Class, with the share of its detections that named it, and identity.
    """

    id: int
    position: FloatArray
    covariance: FloatArray
    robot: str
    measurement: int
    time: float
    origin: int = 0
    label: Label = UNLABELLED


@dataclass
class FilterResult:
    """Result of a step.

    Parameters
    ----------
    clusters : list of Cluster
        Potential targets after the step.
    newly_found : list of FoundTarget
        Targets found in this step.
    found_changed : bool
        Whether any found target is new or has moved.
    expected_number : float
        Expected number of targets that are not found yet.
    dropped : dict
        Number of unused detections by reason.
    misfits : dict
        Warnings by robot: its detections do not fit its settings, or targets were left out.
    """

    clusters: list[Cluster] = field(default_factory=list)
    newly_found: list[FoundTarget] = field(default_factory=list)
    found_changed: bool = False
    expected_number: float = 0.0
    dropped: dict[str, int] = field(default_factory=dict)
    misfits: dict[str, str] = field(default_factory=dict)
