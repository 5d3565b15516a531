"""Settings of sensors, filter and environment: checked models for files, parameters and code."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from maasi_filter.models.detection import (
    BoxDetection,
    DetectionModel,
    ExponentialDetection,
    GaussianDetection,
)
from maasi_filter.models.measurement import RangeBearing, RangeBearingElevation
from maasi_filter.models.sensor import Sensor
from maasi_filter.pmb.settings import PmbSettings

FloatArray = NDArray[np.float64]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Settings(BaseModel):
    """Base of all settings: unknown keys are refused, and so is what is not finite."""

    model_config = ConfigDict(
        extra='forbid', populate_by_name=True, validate_assignment=True, allow_inf_nan=False
    )


class DetectionSettings(Settings):
    """Probability of detection pi(x, q)."""

    kind: Literal['exponential', 'gaussian', 'box'] = Field(
        default='exponential',
        description='Form of pi: G exp(-|zeta|/2), G exp(-|zeta|^2/2), or G inside a box',
    )
    probability: float = Field(
        default=0.98, ge=0.0, le=1.0, description='G, the largest probability of detection [1]'
    )
    size: list[Positive] = Field(
        default=[25.0, 25.0, 25.0],
        min_length=2,
        max_length=3,
        description='F, size of the field of view on each map axis, exponential or gaussian [m]',
    )
    lower: list[Finite] = Field(
        default=[-0.2, -0.2],
        min_length=2,
        max_length=3,
        description='Lower corner of a box as offset from the robot [m]',
    )
    upper: list[Finite] = Field(
        default=[0.2, 0.2],
        min_length=2,
        max_length=3,
        description='Upper corner of a box as offset from the robot [m]',
    )
    frame: Literal['robot', 'world'] = Field(
        default='robot',
        description='Whether a box turns with the robot or stays aligned with the map',
    )
    edge: float = Field(
        default=0.0,
        ge=0.0,
        description='Half width of a ramp across the faces of a box; 0 is hard [m]',
    )

    @model_validator(mode='after')
    def _box(self) -> DetectionSettings:
        if len(self.lower) != len(self.upper):
            raise ValueError('lower, upper: allowed are lists of the same length')
        if any(low >= high for low, high in zip(self.lower, self.upper)):
            raise ValueError(
                f'lower, upper: got {self.lower}, {self.upper}, allowed is lower below upper'
            )
        return self

    def build(self) -> DetectionModel:
        """Return the model."""
        if self.kind == 'box':
            return BoxDetection(self.lower, self.upper, self.probability, self.frame, self.edge)
        model = ExponentialDetection if self.kind == 'exponential' else GaussianDetection
        return model(self.probability, self.size)


class NoiseSettings(Settings):
    """Noise of a measurement; nothing about the meaning of the numbers is left to guess."""

    range: float = Field(
        default=1.5, gt=0.0, description='Noise of the range [m, or m^2 as variance]'
    )
    bearing: float = Field(
        default=0.175,
        gt=0.0,
        description='Noise of the bearing [unit of `angles`, squared as variance]',
    )
    elevation: float = Field(
        default=0.295,
        ge=0.0,
        description='Noise of the elevation, 3D only [unit of `angles`, or squared]',
    )
    as_: Literal['deviation', 'variance'] = Field(
        default='deviation',
        alias='as',
        description='Whether the numbers are standard deviations or variances',
    )
    angles: Literal['radians', 'degrees'] = Field(
        default='radians', description='Unit of the angles'
    )

    def deviations(self, dimension: int) -> FloatArray:
        """Return the standard deviations, (d,), in metres and radians."""
        values = np.array([self.range, self.bearing, self.elevation][:dimension])
        if not (values > 0.0).all():
            raise ValueError('elevation: got 0, allowed in 3D are numbers above 0')
        if self.as_ == 'variance':
            values = np.sqrt(values)
        if self.angles == 'degrees':
            values[1:] *= math.pi / 180.0
        return values

    def covariance(self, dimension: int) -> FloatArray:
        """Return R, (d, d), in metres and radians, squared."""
        return np.diag(self.deviations(dimension) ** 2)


class SensorSettings(Settings):
    """A sensor of range and angles."""

    detection: DetectionSettings = Field(
        default_factory=DetectionSettings, description='Probability of detection'
    )
    noise: NoiseSettings = Field(
        default_factory=NoiseSettings, description='Noise of a measurement'
    )
    clutter: float = Field(
        default=0.0,
        ge=0.0,
        description='Intensity of false detections [1/(m rad) in 2D, 1/(m rad^2) in 3D]',
    )
    period: float = Field(default=0.0, ge=0.0, description='Time between possible measurements [s]')

    def build(self, name: str, dimension: int) -> Sensor:
        """Return the sensor of robot `name` for a problem of `dimension` 2 or 3.

        Raises
        ------
        ValueError
            If the dimension is not 2 or 3.
        """
        if dimension not in (2, 3):
            raise ValueError(f'dimension: got {dimension}, allowed are 2 and 3')
        return Sensor(
            name=name,
            detection=self.detection.build(),
            measurement=RangeBearing() if dimension == 2 else RangeBearingElevation(),
            covariance=self.noise.covariance(dimension),
            clutter=self.clutter,
            period=self.period,
        )


class Obstacle(Settings):
    """A cylinder (2D: a disc) or, with three coordinates, a sphere to keep away from."""

    centre: list[Finite] = Field(min_length=2, max_length=3, description='Centre [m, map]')
    radius: float = Field(gt=0.0, description='Radius [m]')


class EnvironmentSettings(Settings):
    """Where the targets are."""

    bounds: list[Annotated[list[Finite], Field(min_length=2, max_length=2)]] = Field(
        min_length=2, max_length=3, description='Lower and upper bound on each map axis [m]'
    )
    obstacles: list[Obstacle] = Field(default_factory=list, description='Obstacles')

    @model_validator(mode='after')
    def _ordered(self) -> EnvironmentSettings:
        for axis, pair in enumerate(self.bounds):
            if not pair[0] < pair[1]:
                raise ValueError(
                    f'bounds[{axis}]: got {pair}, allowed is [lower, upper] with lower < upper'
                )
        return self

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.bounds)

    def array(self) -> FloatArray:
        """Return the bounds, (d, 2)."""
        return np.array(self.bounds, dtype=float)


Preset = Literal['recommended', 'paper_000', 'paper_001', 'paper_002', 'paper_003']


# What the papers leave open is the same for all four.
_PAPER: dict[str, Any] = {
    'particles': 10000,
    'particles_minimum': 500,
    'particles_per_target': 1000,
    'survival_probability': 1.0,
    'births': 'measurement',
    'birth_particles': 500,
    'birth_prior': 'constant',
    'expected_targets': 12.0,
    'birth_targets': 1.0,
    'corrector': 'running',
    'resampling': 'multinomial',
    'jitter_differential': 0.3,
    'jitter_deviation': 0.1,
    'extraction': 'kmeans',
    'found_radius': 1.1,
    'found_radius_kind': 'rms',
    'found_mass': 0.5,
    'removal': 'closest',
    'removal_distance': 5.0,
    'refine_found': False,
    'pose_error': 0.0,
    'use_detection_covariances': False,
    'kmeans_iterations': 20,
}

# What each preset fills in; `docs/filter_presets.md` says where the numbers are from.
PRESETS: dict[str, dict[str, Any]] = {
    'recommended': {
        'particles': 10000,
        'particles_minimum': 1000,
        'particles_per_target': 2000,
        'survival_probability': 1.0,
        'births': 'measurement',
        'birth_particles': 500,
        'birth_prior': 'unexplored',
        'expected_targets': 12.0,
        'birth_targets': 0.0,
        'corrector': 'running',
        'resampling': 'systematic',
        'jitter_differential': 0.3,
        'extraction': 'measurement',
        'found_radius_kind': 'rms',
        'found_mass': 0.5,
        'removal': 'soft',
        'refine_found': True,
        'use_detection_covariances': True,
        'kmeans_iterations': 20,
    },
    'paper_000': _PAPER,
    'paper_001': {**_PAPER, 'particles': 5000, 'particles_per_target': 500},
    'paper_002': {**_PAPER, 'found_radius': 1.2},
    'paper_003': {
        **_PAPER,
        'births': 'gaussian',
        'birth_particles': 2000,
        'removal': 'every',
        'removal_distance': 4.0,
        'found_radius': 0.5,
    },
}


class FilterSettings(Settings):
    """Numbers of the search filter. What is left None takes the value of the preset.

    Lengths that the `recommended` preset leaves None too are derived at each step from the noise
    of the measuring sensor and from the environment, so that one preset serves a cube of 260 m
    and a floor of 2.7 m. `docs/filter_presets.md` has the presets side by side.
    """

    method: Literal['ic_phd', 'pmb'] = Field(
        default='ic_phd', description='Particle PHD filter, or Poisson multi-Bernoulli filter'
    )
    preset: Preset = Field(default='recommended', description='Where values left None come from')
    particles: int = Field(
        default=10000,
        ge=1,
        le=5_000_000,
        description='Largest number of particles after resampling [1]',
    )
    particles_minimum: int | None = Field(
        default=None,
        ge=0,
        description='Smallest number of particles after resampling, if any mass [1]',
    )
    particles_per_target: int | None = Field(
        default=None, ge=1, description='Particles for each expected target, within the bounds [1]'
    )
    survival_probability: float | None = Field(
        default=None,
        ge=0.0,
        le=1.0,
        description='p_s, that a target still exists after one step [1]',
    )
    births: Literal['measurement', 'uniform', 'gaussian'] | None = Field(
        default=None,
        description='Where births are drawn: at each measurement, anywhere, or as in 003',
    )
    birth_particles: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        description='Particles of a birth (measurement: for each) [1]',
    )
    birth_prior: Literal['unexplored', 'constant'] | None = Field(
        default=None, description='Whether births at measurements have intensity N0/V e(x) or N0/V'
    )
    expected_targets: float | None = Field(
        default=None, gt=0.0, description='N0, targets expected in all before the search [1]'
    )
    birth_targets: float | None = Field(
        default=None,
        ge=0.0,
        description='Y V, targets expected to appear at a batch (not at z) [1]',
    )
    corrector: Literal['running', 'predicted'] | None = Field(
        default=None,
        description='Divide by the running intensity (000, eq. 16) or predicted (002, eq. 9)',
    )
    resampling: Literal['systematic', 'stratified', 'multinomial'] | None = Field(
        default=None, description='Resampling scheme'
    )
    jitter_differential: float | None = Field(
        default=None,
        ge=0.0,
        le=2.0,
        description='Share of a difference of two particles in a jitter [1]',
    )
    jitter_deviation: float | None = Field(
        default=None,
        ge=0.0,
        description='Deviation of the Gaussian part of the jitter of duplicates [m]',
    )
    extraction: Literal['measurement', 'kmeans'] | None = Field(
        default=None, description='Clusters for marking: partition by measurement, or K-means'
    )
    found_radius: float | None = Field(
        default=None, gt=0.0, description='T_r, largest radius of a cluster that is found [m]'
    )
    found_radius_kind: Literal['rms', 'maximum'] | None = Field(
        default=None,
        description='Radius of a cluster: weighted root mean square, or farthest particle',
    )
    found_mass: float | None = Field(
        default=None, ge=0.0, description='T_m, smallest mass of a cluster that is found [1]'
    )
    removal: Literal['soft', 'closest', 'every', 'none'] | None = Field(
        default=None, description='What a found target does to measurements: soft gate, or removal'
    )
    removal_distance: float | None = Field(
        default=None, gt=0.0, description='T_z, largest distance of a removed measurement [m]'
    )
    refine_found: bool | None = Field(
        default=None, description='Whether found targets go on being refined by their measurements'
    )
    pose_error: float | None = Field(
        default=None, ge=0.0, description='Deviation of the error of a robot position, per axis [m]'
    )
    use_detection_covariances: bool | None = Field(
        default=None,
        description='Whether covariances of detections win over the covariance of the sensor',
    )
    exploration_spacing: float | None = Field(
        default=None, gt=0.0, description='Spacing of the exploration grid [m]'
    )
    kmeans_iterations: int | None = Field(
        default=None, ge=1, le=1000, description='Largest number of K-means iterations [1]'
    )
    pmb: PmbSettings = Field(
        default_factory=PmbSettings, description='Of the Poisson multi-Bernoulli filter'
    )
    threads: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description='Threads for large particle sets; results do not depend [1]',
    )

    def resolved(self) -> FilterSettings:
        """Return a copy in which the preset's values stand where nothing was given.

        Lengths that depend on the sensor or the environment may still be None.
        """
        values = {
            name: value
            for name, value in PRESETS[self.preset].items()
            if getattr(self, name) is None or name not in self.model_fields_set
        }
        return self.model_copy(update=values)
