"""Multi-target search filters: sensor models, exploration map and found targets."""

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.ic_phd.filter import IcPhdFilter
from maasi_filter.make_filter import load_filter, make_filter, warm_up
from maasi_filter.metrics import Gospa, Match, gospa, match_targets
from maasi_filter.models.detection import (
    BoxDetection,
    DetectionModel,
    ExponentialDetection,
    GaussianDetection,
    detection_probability_at,
)
from maasi_filter.models.measurement import RangeAndAngles, wrap_angle
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.models.sensor import Sensor
from maasi_filter.pmb.filter import PmbFilter
from maasi_filter.records import AgentMeasurement, Cluster, FilterResult, FoundTarget
from maasi_filter.search_filter import SearchFilter
from maasi_filter.settings import DetectionSettings, FilterSettings, NoiseSettings, SensorSettings
from maasi_filter.state_file import StateFileError
from maasi_filter.unexplored_map import UnexploredMap

__all__ = [
    'AgentMeasurement',
    'Area',
    'BoxDetection',
    'Cluster',
    'DetectionModel',
    'DetectionSettings',
    'EnvironmentSettings',
    'ExponentialDetection',
    'FilterResult',
    'FilterSettings',
    'FoundTarget',
    'GaussianDetection',
    'Gospa',
    'IcPhdFilter',
    'Match',
    'NoiseSettings',
    'PmbFilter',
    'Pose',
    'RangeAndAngles',
    'SearchFilter',
    'Sensor',
    'SensorSettings',
    'StateFileError',
    'UnexploredMap',
    'compose',
    'detection_probability_at',
    'gospa',
    'inverse',
    'load_filter',
    'make_filter',
    'match_targets',
    'warm_up',
    'wrap_angle',
]
