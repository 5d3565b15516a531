"""Settings of sensors, filters and environments: checked models for files, parameters and code."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

from maasi_filter.arrays import FloatArray
from maasi_filter.models.detection import (
    BoxDetection,
    DetectionModel,
    ExponentialDetection,
    GaussianDetection,
)
from maasi_filter.models.sensor import Sensor
from maasi_filter.plugins import OwnSettings, PluginGroup

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector2 = Annotated[list[Finite], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]


def _ascending(intervals: list[list[float]]) -> list[list[float]]:
    for axis, pair in enumerate(intervals):
        if not pair[0] < pair[1]:
            raise ValueError(f'axis {axis}: got {pair}, allowed is [lower, upper], lower < upper')
    return intervals


Intervals = Annotated[list[Vector2], AfterValidator(_ascending)]  # lower and upper on each axis


class Settings(BaseModel):
    """Base of all settings: unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(
        extra='forbid', populate_by_name=True, validate_assignment=True, allow_inf_nan=False
    )


DETECTIONS = PluginGroup(
    'maasi.detection_models',
    'kind of detection',
    'maasi_filter.models.own_detection:OwnDetection',
    {
        'exponential': 'maasi_filter.models.detection:ExponentialDetection',
        'gaussian': 'maasi_filter.models.detection:GaussianDetection',
        'box': 'maasi_filter.models.detection:BoxDetection',
    },
)
_DETECTION = OwnSettings(DETECTIONS, 'kind')


class DetectionSettings(Settings):
    """Probability of detection pi(x, q)."""

    kind: Annotated[str, DETECTIONS, AfterValidator(DETECTIONS.check)] = Field(
        'exponential',
        description='Shape of the probability of detection pi: G exp(-|zeta|/2), G '
        'exp(-|zeta|^2/2), G inside a box, or your own module:Class',
    )
    settings: Annotated[Any, _DETECTION, AfterValidator(_DETECTION.check)] = Field(
        None, validate_default=True, description='Settings of your own detection model'
    )
    probability: float = Field(
        0.98,
        ge=0.0,
        le=1.0,
        description='G, the largest probability of detection; scales your own model [1]',
    )
    size: list[Positive] = Field(
        [25.0, 25.0, 25.0],
        min_length=2,
        max_length=3,
        description='F, size of the field of view on each map axis; exponential and gaussian only '
        '[m]',
    )
    lower: list[Finite] = Field(
        [-0.2, -0.2],
        min_length=2,
        max_length=3,
        description='Lower corner of the box, relative to the robot [m]',
    )
    upper: list[Finite] = Field(
        [0.2, 0.2],
        min_length=2,
        max_length=3,
        description='Upper corner of the box, relative to the robot [m]',
    )
    frame: Literal['robot', 'world'] = Field(
        'robot', description='Whether the box turns with the robot or stays aligned with the map'
    )
    edge: NotNegative = Field(
        0.0, description='Half the width of the ramp across the faces of the box; 0: a step [m]'
    )

    @model_validator(mode='after')
    def _box(self) -> DetectionSettings:
        BoxDetection(self.lower, self.upper)
        return self

    def build(self, dimension: int = 3) -> DetectionModel:
        """Return the detection model; ValueError if a plugin's model is invalid."""
        if self.kind not in DETECTIONS.built_in:
            found = DETECTIONS.load(self.kind)(self.settings, self.probability, dimension)
            assert isinstance(found, DetectionModel)
            return found
        if self.kind == 'box':
            return BoxDetection(self.lower, self.upper, self.probability, self.frame, self.edge)
        model = ExponentialDetection if self.kind == 'exponential' else GaussianDetection
        return model(self.probability, self.size)


class NoiseSettings(Settings):
    """Noise of a measurement."""

    range: Positive = Field(1.5, description='Noise of the range [m, or m^2 as variance]')
    bearing: Positive = Field(
        0.175, description='Noise of the bearing [unit of `angles`, squared as variance]'
    )
    elevation: NotNegative = Field(
        0.295,
        description='Noise of the elevation, only in 3D [unit of `angles`, squared as variance]',
    )
    as_: Literal['deviation', 'variance'] = Field(
        'deviation',
        alias='as',
        description='Whether these numbers are standard deviations or variances',
    )
    angles: Literal['radians', 'degrees'] = Field('radians', description='Unit of the angles')

    def deviations(self, dimension: int) -> FloatArray:
        """Return the standard deviations (d,) in metres and radians."""
        values = np.array([self.range, self.bearing, self.elevation][:dimension])
        if not (values > 0.0).all():
            raise ValueError('elevation: got 0, allowed in 3D are numbers above 0')
        if self.as_ == 'variance':
            values = np.sqrt(values)
        if self.angles == 'degrees':
            values[1:] *= math.pi / 180.0
        return values

    def covariance(self, dimension: int) -> FloatArray:
        """Return R (d, d) in squared metres and radians."""
        return np.diag(self.deviations(dimension) ** 2)


class SensorSettings(Settings):
    """A sensor that measures range and angles."""

    detection: DetectionSettings = Field(
        default_factory=DetectionSettings, description='Probability of detection'
    )
    noise: NoiseSettings = Field(
        default_factory=NoiseSettings, description='Noise of a measurement'
    )
    clutter: NotNegative = Field(
        0.0,
        description='Intensity of false detections in a scan [1/(m rad), in 3D 1/(m rad^2); with '
        '`clutter_in: area` 1/m^2, in 3D 1/m^3]',
    )
    clutter_in: Literal['measurements', 'area'] = Field(
        'measurements',
        description='Where false detections are uniform: in range and angles, or in the area',
    )
    period: NotNegative = Field(
        0.0, description='Time from one possible measurement to the next; 0: every step [s]'
    )
    resolution: NotNegative = Field(
        1.0,
        description='pmb: detections of one scan that are closer than this count as one target; 0 '
        'disables this [standard deviations of the noise]',
    )

    def build(self, name: str, dimension: int) -> Sensor:
        """Return the sensor of robot `name` for a problem of `dimension` 2 or 3."""
        if dimension not in (2, 3):
            raise ValueError(f'dimension: got {dimension}, allowed are 2 and 3')
        detection, covariance = self.detection.build(dimension), self.noise.covariance(dimension)
        return Sensor(
            name,
            detection,
            covariance,
            self.clutter,
            self.period,
            resolution=self.resolution,
            clutter_in=self.clutter_in,
        )


class OffsetSettings(Settings):
    """Lasting errors of robot positions; with both 0, errors of measurements are independent."""

    deviation: NotNegative = Field(
        0.0, description='Standard deviation of the constant position offset on each axis [m]'
    )
    drift: NotNegative = Field(
        0.0,
        description='Standard deviation of the drift of x and y after 1 m of travel; it grows '
        'with the square root of the distance [m]',
    )


class PmbSettings(Settings):
    """Settings of the Poisson multi-Bernoulli filter."""

    particles: int = Field(
        300, ge=50, le=100_000, description='Number of particles of each potential target [1]'
    )
    found_probability: float = Field(
        0.99,
        gt=0.5,
        lt=1.0,
        description='Existence probability above which a target can be reported as found [1]',
    )
    withdrawn_probability: float = Field(
        0.5,
        ge=0.0,
        le=0.5,
        description='Existence probability below which a found target is withdrawn [1]',
    )
    clutter_floor: Positive = Field(
        0.05, description='Least mean number of false detections in a scan that is assumed [1]'
    )
    walk: NotNegative = Field(
        0.0,
        description='Standard deviation of the random walk of targets on each axis after 1 s; 0: '
        'targets do not move [m/sqrt(s)]',
    )
    offset: OffsetSettings = Field(
        default_factory=OffsetSettings,
        description='Lasting errors of robot positions, which the filter estimates',
    )


FILTERS = PluginGroup(
    'maasi.filters',
    'filter',
    'maasi_filter.search_filter:SearchFilter',
    {
        'ic_phd': 'maasi_filter.ic_phd.filter:IcPhdFilter',
        'pmb': 'maasi_filter.pmb.filter:PmbFilter',
    },
)
_FILTER = OwnSettings(FILTERS, 'method')


@dataclass(frozen=True)
class _Only:
    """Marks a setting that only one method of the suite uses."""

    method: str
    plugins: bool = False  # whether filters of plugins can use it


_IC_PHD, _PMB_ONLY = _Only('ic_phd'), _Only('pmb')
_CHECKED = _Only('pmb', plugins=True)  # used by `check_measurements`

Preset = Literal['paper_000', 'paper_001', 'paper_002', 'paper_003']

_PAPER_000: dict[str, Any] = {
    'particles': 10000,
    'particles_minimum': 500,
    'particles_per_target': 1000,
    'survival_probability': 1.0,
    'births': 'measurement',
    'birth_particles': 500,
    'birth_targets': 1.0,
    'jitter_deviation': 0.1,
    'found_radius': 1.1,
    'found_mass': 0.5,
    'removal': 'closest',
    'removal_distance': 5.0,
    'kmeans_iterations': 20,
    'use_detection_covariances': False,
    'pose_error': 0.0,
}

# Values of each preset; their sources are in `docs/filter_presets.md`.
PRESETS: dict[str, dict[str, Any]] = {
    'paper_000': _PAPER_000,
    'paper_001': {**_PAPER_000, 'particles': 5000, 'particles_per_target': 500},
    'paper_002': {**_PAPER_000, 'found_radius': 1.2},
    'paper_003': {
        **_PAPER_000,
        'births': 'gaussian',
        'birth_particles': 2000,
        'removal': 'every',
        'removal_distance': 4.0,
        'found_radius': 0.5,
    },
}
_PMB: dict[str, Any] = {'use_detection_covariances': True}


class FilterSettings(Settings):
    """Settings of the search filter.

    With `method: ic_phd`, None stands for the value of the preset; with `method: pmb` it is derived
    at each step from sensor and environment, or unused.
    """

    method: Annotated[str, FILTERS, AfterValidator(FILTERS.check)] = Field(
        'ic_phd',
        description='Particle PHD filter of the papers, Poisson multi-Bernoulli filter, or your '
        'own module:Class',
    )
    settings: Annotated[Any, _FILTER, AfterValidator(_FILTER.check)] = Field(
        None, validate_default=True, description='Settings of your own filter'
    )
    preset: Annotated[Preset, _IC_PHD] = Field(
        'paper_000', description='ic_phd: paper that provides the values of keys that are not set'
    )
    found_radius: float | None = Field(
        None, gt=0.0, description='T_r, largest root mean square radius of a found target [m]'
    )
    exploration_spacing: float | None = Field(
        None, gt=0.0, description='Spacing of the exploration grid [m]'
    )
    threads: int | None = Field(
        None,
        ge=1,
        le=256,
        description='Threads for large particle sets; results do not depend on it [1]',
    )
    particles: Annotated[int | None, _IC_PHD] = Field(
        None,
        ge=1,
        le=5_000_000,
        description='ic_phd: largest number of particles after resampling [1]',
    )
    particles_minimum: Annotated[int | None, _IC_PHD] = Field(
        None,
        ge=0,
        description='ic_phd: smallest number of particles after resampling, unless the mass is 0 '
        '[1]',
    )
    particles_per_target: Annotated[int | None, _IC_PHD] = Field(
        None,
        ge=1,
        description='ic_phd: l, particles per expected target, within both bounds [1]',
    )
    survival_probability: Annotated[float | None, _IC_PHD] = Field(
        None,
        ge=0.0,
        le=1.0,
        description='ic_phd: p_s, probability that a target still exists one step later [1]',
    )
    births: Annotated[Literal['measurement', 'uniform', 'gaussian'] | None, _IC_PHD] = Field(
        None,
        description='ic_phd: particles are born at each measurement, uniformly, or from one '
        'Gaussian over all measurements',
    )
    birth_particles: Annotated[int | None, _IC_PHD] = Field(
        None,
        ge=1,
        le=1_000_000,
        description='ic_phd: J, particles per birth; with births at measurements, per measurement '
        '[1]',
    )
    birth_targets: Annotated[float | None, _IC_PHD] = Field(
        None,
        ge=0.0,
        description='ic_phd: Y V, expected number of new targets in a batch; not for births at '
        'measurements [1]',
    )
    jitter_deviation: Annotated[float | None, _IC_PHD] = Field(
        None,
        ge=0.0,
        description='ic_phd: standard deviation of the noise that separates copies of a particle '
        '[m]',
    )
    found_mass: Annotated[float | None, _IC_PHD] = Field(
        None, ge=0.0, description='ic_phd: T_m, smallest mass of a found cluster [1]'
    )
    removal: Annotated[Literal['closest', 'every'] | None, _IC_PHD] = Field(
        None,
        description='ic_phd: whether the closest or every measurement near a found target is '
        'removed',
    )
    # Not marked, as T_z is also the length by which found targets are scored.
    removal_distance: float | None = Field(
        None,
        gt=0.0,
        description='ic_phd: T_z, largest distance of a removed measurement from a found target '
        '[m]',
    )
    kmeans_iterations: Annotated[int | None, _IC_PHD] = Field(
        None, ge=1, le=1000, description='ic_phd: largest number of K-means iterations [1]'
    )
    pose_error: Annotated[float | None, _CHECKED] = Field(
        None,
        ge=0.0,
        description='pmb: standard deviation of the robot position error on each axis; default: '
        'as the robot reports [m]',
    )
    use_detection_covariances: Annotated[bool | None, _CHECKED] = Field(
        None, description='pmb: whether covariances of detections replace that of the sensor'
    )
    pmb: Annotated[PmbSettings, _PMB_ONLY] = Field(
        default_factory=PmbSettings, description='Settings that only pmb uses'
    )

    @field_validator('preset', mode='before')
    @classmethod
    def _gone(cls, value: Any) -> Any:
        if value == 'recommended':
            raise ValueError("'recommended' was removed, use method: pmb")
        return value

    def resolved(self) -> FilterSettings:
        """Return a copy in which the values of the method or preset replace None."""
        filled = {'ic_phd': PRESETS[self.preset], 'pmb': _PMB}.get(self.method, {})
        values = {name: value for name, value in filled.items() if getattr(self, name) is None}
        return self.model_copy(update=values)


# Upper bound: a found target must not remove the detections of half the environment.
LARGEST_REMOVAL = 0.5


def unsuitable_lengths(settings: FilterSettings, bounds: FloatArray) -> str:
    """Return a warning if the lengths of a preset do not suit the bounds (d, 2), else ''."""
    distance = settings.resolved().removal_distance
    side = float((bounds[:, 1] - bounds[:, 0]).min())
    if settings.method != 'ic_phd' or distance is None or distance <= LARGEST_REMOVAL * side:
        return ''
    return (
        f'filter.removal_distance: T_z is {distance:g} m, in an environment of {side:g} m: targets '
        f'will be missed, as the lengths of {settings.preset} suit larger environments; set '
        'found_radius, removal_distance and jitter_deviation, or method: pmb'
    )


def unused_settings(settings: FilterSettings) -> str:
    """Return a warning if settings of another method are given, else ''."""
    method, unused = settings.method, dict[str, list[str]]()
    for name, info in FilterSettings.model_fields.items():
        for mark in info.metadata:
            if not isinstance(mark, _Only) or mark.method == method:
                continue
            given = getattr(settings, name) != info.get_default(call_default_factory=True)
            if given and not (mark.plugins and method not in FILTERS.built_in):
                unused.setdefault(mark.method, []).append(name)
    return '\n'.join(
        f'filter: {", ".join(names)}: only for method {other}; {method} does not use them'
        for other, names in unused.items()
    )
