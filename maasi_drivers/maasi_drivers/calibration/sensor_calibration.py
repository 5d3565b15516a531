"""Estimation of a sensor's noise R from observations of one target (paper 000, section 5.2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor

LEAST_OBSERVATIONS = 10  # smallest number of observations for a covariance
# Detections farther from the target than this multiple of the median are other objects.
_FAR = 8.0
# Below this all detections are equal up to rounding [m].
_ROUNDING = 1e-9
_ROUNDS = 3


@dataclass(frozen=True)
class Observation:
    """Detections of a sensor at one instant: values (m, d) [m, rad], and its pose in the map."""

    pose: Pose
    values: FloatArray


@dataclass(frozen=True)
class SensorNoise:
    """A sensor's noise and its observations."""

    covariance: FloatArray  # R, (d, d): of the errors of range [m] and angles [rad]
    bias: FloatArray  # (d,): their mean
    target: FloatArray  # (d,): as given, or the mean of the detections [m, map]
    ranges: tuple[float, float]  # smallest and largest used range [m]
    used: int  # number of observations for R
    near: int  # skipped because the target was too close for a bearing
    others: int  # detections of other objects
    inside: int  # observations with the target in the field of view
    missed: int  # of those, the ones without a detection

    @property
    def deviations(self) -> FloatArray:
        """Square roots of the diagonal of R, shape (d,)."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def probability(self) -> float:
        """Detected share of the observations with the target in the field of view."""
        return 1.0 - self.missed / self.inside if self.inside else float('nan')


def sensor_noise(
    observations: Sequence[Observation],
    sensor: Sensor,
    target: ArrayLike | None = None,
    least_range: float = 0.05,
) -> SensorNoise:
    """Estimate a sensor's noise from observations of a target (d,) [m, map].

    The detection closest to the target counts, unless it is eight times as far from it as the
    median.
    """
    model = sensor.measurement
    seen = [model.inverse(observation.values, observation.pose) for observation in observations]
    if target is not None:
        position = np.asarray(target, dtype=float)
        if position.shape != (model.dimension,) or not np.isfinite(position).all():
            raise ValueError(
                f'target: got {position.tolist()}, allowed are {model.dimension} finite numbers [m]'
            )
    else:
        every = np.concatenate([np.zeros((0, model.dimension)), *seen])
        if not len(every):
            raise ValueError(f'target: detected 0 times, allowed is at least {LEAST_OBSERVATIONS}')
        position = np.median(every, axis=0)
    nearest: list[int | None] = []
    # Without a given target: from the median to the mean of close detections.
    for _ in range(1 if target is not None else _ROUNDS):
        nearest = _nearest(seen, position)
        chosen = [spots[i] for spots, i in zip(seen, nearest) if i is not None]
        if target is None and chosen:
            position = np.mean(chosen, axis=0)
    errors, ranges, near, inside, missed = [], [], 0, 0, 0
    for observation, index in zip(observations, nearest):
        expected = model.measure(position[None, :], observation.pose)[0]
        if sensor.detection.probability(position[None, :], observation.pose)[0] > 0.0:
            inside += 1
            missed += index is None
        if index is None:
            continue
        if expected[0] < least_range:
            near += 1
            continue
        errors.append(model.residual(observation.values[index], expected))
        ranges.append(float(expected[0]))
    if len(errors) < LEAST_OBSERVATIONS:
        raise ValueError(
            f'target: detected {len(errors)} times at {least_range:g} m or more, allowed is at '
            f'least {LEAST_OBSERVATIONS}'
        )
    array = np.array(errors)
    return SensorNoise(
        covariance=np.atleast_2d(np.cov(array, rowvar=False)),
        bias=array.mean(axis=0),
        target=position,
        ranges=(min(ranges), max(ranges)),
        used=len(errors),
        near=near,
        others=sum(map(len, seen)) - sum(index is not None for index in nearest),
        inside=inside,
        missed=missed,
    )


def _nearest(seen: Sequence[FloatArray], position: FloatArray) -> list[int | None]:
    distances = [np.linalg.norm(spots - position, axis=1) for spots in seen]
    least = [float(item.min()) for item in distances if len(item)]
    limit = max(_FAR * float(np.median(least)), _ROUNDING) if least else 0.0
    return [
        int(np.argmin(item)) if len(item) and item.min() <= limit else None for item in distances
    ]
