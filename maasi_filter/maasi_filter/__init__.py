"""What the team believes: sensors, exploration, the particle PHD filter and found targets."""

from maasi_filter.clusters import Cluster
from maasi_filter.detection_model import (
    BoxDetection,
    DetectionModel,
    ExponentialDetection,
    FunctionDetection,
    GaussianDetection,
    detection_probability,
)
from maasi_filter.exploration import Exploration
from maasi_filter.found_targets import FoundTarget
from maasi_filter.measurement_model import (
    MeasurementModel,
    RangeBearing,
    RangeBearingElevation,
    wrap_angle,
)
from maasi_filter.pose import Pose, compose, inverse
from maasi_filter.search_filter import AgentMeasurement, FilterResult
from maasi_filter.sensor import Sensor
from maasi_filter.settings import (
    DetectionSettings,
    EnvironmentSettings,
    FilterSettings,
    NoiseSettings,
    SensorSettings,
)

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
    'MeasurementModel',
    'NoiseSettings',
    'Pose',
    'RangeBearing',
    'RangeBearingElevation',
    'Sensor',
    'SensorSettings',
    'compose',
    'detection_probability',
    'inverse',
    'wrap_angle',
]
