"""What the team believes: sensors, exploration, the particle PHD filter and found targets."""

from maasi_filter.exploration import Exploration
from maasi_filter.ic_phd.clusters import Cluster
from maasi_filter.ic_phd.found_targets import FoundTarget
from maasi_filter.ic_phd.search_filter import AgentMeasurement, FilterResult, SearchFilter
from maasi_filter.metrics import (
    Gospa,
    Match,
    RestrictedMean,
    gospa,
    match_targets,
    ospa,
    restricted_mean,
)
from maasi_filter.models.detection import (
    BoxDetection,
    DetectionModel,
    ExponentialDetection,
    FunctionDetection,
    GaussianDetection,
    detection_probability,
)
from maasi_filter.models.measurement import (
    MeasurementModel,
    RangeBearing,
    RangeBearingElevation,
    wrap_angle,
)
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.models.sensor import Sensor
from maasi_filter.settings import (
    DetectionSettings,
    EnvironmentSettings,
    FilterSettings,
    NoiseSettings,
    SensorSettings,
)
from maasi_filter.state_file import StateFileError
from maasi_filter.warm_up import warm_up

__all__ = [
    'AgentMeasurement',
    'BoxDetection',
    'Cluster',
    'DetectionModel',
    'DetectionSettings',
    'EnvironmentSettings',
    'Exploration',
    'ExponentialDetection',
    'FilterResult',
    'FilterSettings',
    'FoundTarget',
    'FunctionDetection',
    'GaussianDetection',
    'Gospa',
    'Match',
    'MeasurementModel',
    'NoiseSettings',
    'Pose',
    'RangeBearing',
    'RangeBearingElevation',
    'RestrictedMean',
    'SearchFilter',
    'Sensor',
    'SensorSettings',
    'StateFileError',
    'compose',
    'detection_probability',
    'gospa',
    'inverse',
    'match_targets',
    'ospa',
    'restricted_mean',
    'warm_up',
    'wrap_angle',
]
