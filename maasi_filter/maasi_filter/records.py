"""Input and output of a search filter: measurements, clusters, found targets, results."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor


def rounded_score(score: float) -> float:
    """Return a score; sums of probabilities may miss 0 or 1 by their rounding."""
    return float(min(max(score, 0.0), 1.0)) if -1e-6 <= score <= 1.0 + 1e-6 else score


@dataclass(frozen=True)
class Label:
    """Class and identity of a detection or a found target.

    Parameters
    ----------
    class_id : str
        Name of the class; empty: not known.
    score : float
        Confidence in the class, 0 to 1; 0: not known.
    identity : str
        What tells this target from all others, such as the id of a marker; empty: not known.

    Raises
    ------
    ValueError
        If the score is not from 0 to 1.
    """

    class_id: str = ''
    score: float = 0.0
    identity: str = ''

    def __post_init__(self) -> None:
        # Negated, so that NaN is refused too.
        if not 0.0 <= self.score <= 1.0:
            raise ValueError(f'score: got {self.score}, allowed is 0 to 1')


UNLABELLED = Label()  #: of a detection about which nothing is known but its position


@dataclass
class AgentMeasurement:
    """Measurement of one robot at one step; one without detections is information too.

    Parameters
    ----------
    robot : str
        Its name; robots are processed in the order of their names.
    pose : Pose
        Of the sensor at the time of the measurement.
    sensor : Sensor
        The sensor that measured.
    values : (m, d) array
        Detections: range, bearing and, in 3D, elevation; m, rad, rad.
    covariances : (m, d, d) array, optional
        Covariance of each detection, instead of the sensor's; not used by the PHD filter.
    index : int
        That robot's measurement index.
    position_covariance : (3, 3) array, optional
        Covariance of the robot's position error as it reports it, square metres. Covariances of
        detections are assumed to include it.
    labels : sequence of Label
        Class and identity of each detection; empty: none is known.
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
        Expected number of targets in it.
    """

    position: FloatArray
    covariance: FloatArray
    radius: float
    mass: float


@dataclass
class FoundTarget:
    """A target marked as found.

    Parameters
    ----------
    id : int
        From 1, in the order of being found.
    position : (d,) array
        Metres, frame `map`.
    covariance : (d, d) array
        Of the error of `position`, square metres.
    robot : str
        Robot whose measurement completed it.
    measurement : int
        That robot's measurement index then.
    time : float
        Seconds.
    origin : int
        Its id in the filter of another robot that found it; 0 if this filter found it.
    label : Label
        Its class with the share of its detections that named it, and its identity.
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
        Potential targets after the step, without found targets.
    newly_found : list of FoundTarget
        Targets found in this step.
    found_changed : bool
        Whether any found target is new or has moved.
    expected_number : float
        Expected number of targets that are not found.
    dropped : dict
        Detections that were not used: reason to count.
    misfits : dict
        Warnings that the detections of a robot do not fit its settings, by robot; or that some
        potential targets were left out.
    """

    clusters: list[Cluster] = field(default_factory=list)
    newly_found: list[FoundTarget] = field(default_factory=list)
    found_changed: bool = False
    expected_number: float = 0.0
    dropped: dict[str, int] = field(default_factory=dict)
    misfits: dict[str, str] = field(default_factory=dict)
