"""A robot's sensor: probability of detection and measurement noise."""

import math
from dataclasses import dataclass, field

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.models.detection import BoxDetection, DetectionModel
from maasi_filter.models.measurement import RangeAndAngles

# Lower bound of the expected false detections in a scan: without it, a few stray particles
# suffice to explain a false detection as a target.
LEAST_PER_SCAN = 0.05
LEAST_INTENSITY = 1e-12  # of false detections next to the sensor


def is_covariance(covariance: FloatArray) -> bool:
    """Return whether a finite square matrix is symmetric and positive definite up to rounding."""
    variances = np.diagonal(covariance)
    if not (np.isfinite(covariance).all() and (variances > 0.0).all()):
        return False
    scale = np.sqrt(variances)
    correlation = covariance / np.outer(scale, scale)
    if np.abs(correlation - correlation.T).max() > 1e-6:
        return False
    return bool(np.linalg.eigvalsh(correlation)[0] > 1e-10)


@dataclass
class Sensor:
    """Sensor of a robot, which measures range and angles.

    Parameters
    ----------
    name : str
        Name for messages.
    detection : DetectionModel
        Probability of detection pi(x, q).
    covariance : (d, d) array
        R, covariance of a measurement; m and rad, squared. d is 2 or 3.
    clutter : float
        Intensity of false detections, per unit of measurement space (m rad in 2D, m rad^2 in 3D).
    period : float
        Seconds from one possible measurement to the next; 0: every step.
    maximum_range : float
        Range beyond which detections are dropped and counted, metres.
    resolution : float
        Detections of one scan closer than this count as one, in deviations of the noise.

    Attributes
    ----------
    measurement : RangeAndAngles
        g(x, q), of the dimension of `covariance`.

    Raises
    ------
    ValueError
        If a number is not finite or the covariance is not positive definite.
    """

    name: str
    detection: DetectionModel
    covariance: FloatArray
    clutter: float = 0.0
    period: float = 0.0
    maximum_range: float = field(default=math.inf)
    resolution: float = 1.0
    clutter_in: str = 'measurements'
    measurement: RangeAndAngles = field(init=False)

    def __post_init__(self) -> None:
        self.covariance = np.array(self.covariance, dtype=float)
        if self.covariance.shape not in ((2, 2), (3, 3)):
            raise ValueError(
                f'{self.name}: covariance: got shape {self.covariance.shape}, allowed are (2, 2) '
                'and (3, 3)'
            )
        self.measurement = RangeAndAngles(len(self.covariance))
        if not is_covariance(self.covariance):
            raise ValueError(
                f'{self.name}: covariance: got {self.covariance.tolist()}, allowed is a symmetric '
                'positive definite matrix of finite numbers'
            )
        for name in ('clutter', 'period', 'resolution'):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(
                    f'{self.name}: {name}: got {value}, allowed are finite numbers from 0'
                )
        if not self.maximum_range > 0.0:
            raise ValueError(
                f'{self.name}: maximum_range: got {self.maximum_range}, allowed are numbers above 0'
            )

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.measurement.dimension

    def clutter_space(self, bounds: FloatArray) -> float:
        """Return the volume in which false detections are uniform, in the unit of `clutter`."""
        if self.clutter_in == 'area':
            return float(np.prod(bounds[:, 1] - bounds[:, 0]))
        return self.measurement_space(bounds)

    def clutter_at(self, values: FloatArray, per_scan: float, bounds: FloatArray) -> FloatArray:
        """Return the intensity of false detections at measured values (m, d), (m,).

        It is per unit of measurement space: of positions uniform in the area, |dx/dz| as many.
        """
        intensity = np.full(len(values), per_scan / self.clutter_space(bounds))
        if self.clutter_in == 'area':
            intensity *= np.abs(values[:, 0]) ** (self.dimension - 1)
            if self.dimension == 3:
                intensity *= np.cos(values[:, 2])
        return np.maximum(intensity, LEAST_INTENSITY)

    def measurement_space(self, bounds: FloatArray) -> float:
        """Return the volume of measurement space up to the largest range [m rad, in 3D m rad^2]."""
        size = bounds[:, 1] - bounds[:, 0]
        reach = min(self.maximum_range, math.sqrt(float((size * size).sum())))
        if isinstance(self.detection, BoxDetection):
            corner = np.maximum(np.abs(self.detection.lower), np.abs(self.detection.upper))
            corner = corner[: len(bounds)] + self.detection.edge
            # A box with two axes does not limit the height.
            if len(corner) == len(bounds):
                reach = min(reach, math.sqrt(float((corner * corner).sum())))
        return reach * 2.0 * math.pi * (math.pi if len(bounds) == 3 else 1.0)
