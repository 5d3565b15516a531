"""Input and output of a search filter: measurements, clusters, found targets, results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor


@dataclass(frozen=True)
class Label:
    """Class and identity of a detection or a found target."""

    class_id: str = ''  #: Name of the class; empty: not known.
    score: float = 0.0  #: Confidence in the class, 0 to 1; 0: not known.
    #: What tells this target from all others, such as the id of a marker; empty: not known.
    identity: str = ''

    def __post_init__(self) -> None:
        # Negated, so that NaN is refused too.
        if not 0.0 <= self.score <= 1.0:
            raise ValueError(f'score: got {self.score}, allowed is 0 to 1')


#: Of a detection about which nothing is known but its position.
UNLABELLED = Label()


@dataclass
class AgentMeasurement:
    """Measurement of one robot at one step; one without detections is information too."""

    robot: str  #: Its name; robots are processed in the order of their names.
    pose: Pose  #: Of the sensor at the time of the measurement.
    sensor: Sensor
    #: (m, d): Detections: range, bearing and, in 3D, elevation; m, rad, rad.
    values: FloatArray
    #: (m, d, d): Of each detection, instead of the sensor's; not used by the PHD filter.
    covariances: FloatArray | None = None
    index: int = 0  #: That robot's measurement index.
    #: (3, 3): Covariance of the robot's position error as it reports it, square metres.
    #: Covariances of detections are assumed to include it.
    position_covariance: FloatArray | None = None
    labels: Sequence[Label] = ()  #: Of each detection; empty: none is known.


@dataclass
class Cluster:
    """A potential target."""

    position: FloatArray  #: (d,): Weighted mean, metres, frame `map`.
    covariance: FloatArray  #: (d, d): Weighted covariance, square metres.
    radius: float  #: Weighted root mean square distance from the mean, metres.
    mass: float  #: Expected number of targets in it.


@dataclass
class FoundTarget:
    """A target marked as found."""

    id: int  #: From 1, in the order of being found.
    position: FloatArray  #: (d,): Metres, frame `map`.
    covariance: FloatArray  #: (d, d): Of the error of `position`, square metres.
    robot: str  #: Robot whose measurement completed it.
    measurement: int  #: That robot's measurement index then.
    time: float  #: Seconds.
    origin: int = 0  #: Its id in the filter of another robot that found it; 0: this filter did.
    #: Its class with the share of its detections that named it, and its identity.
    label: Label = UNLABELLED


@dataclass
class FilterResult:
    """Result of a step."""

    #: Potential targets after the step, without found targets.
    clusters: list[Cluster] = field(default_factory=list)
    newly_found: list[FoundTarget] = field(default_factory=list)  #: In this step.
    found_changed: bool = False  #: Whether any found target is new or has moved.
    expected_number: float = 0.0  #: Expected number of targets that are not found.
    #: Number of detections that were not used, by the reason.
    dropped: dict[str, int] = field(default_factory=dict)
    #: Warnings that the detections of a robot do not fit its settings, by robot.
    misfits: dict[str, str] = field(default_factory=dict)
