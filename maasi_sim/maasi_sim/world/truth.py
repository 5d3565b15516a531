"""True parameters of a simulated robot, where they differ from those that the suite assumes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maasi_filter.models.sensor import Sensor
from maasi_filter.settings import NoiseSettings, SensorSettings, Settings
from maasi_sim.world.odometry import OdometrySettings

Array = NDArray[np.float64]


class SimulatedSettings(Settings):
    """True parameters of a robot, where they differ from its other settings.

    The sensor's part is for ranging sensors; a camera has its own true settings.
    """

    noise: NoiseSettings | None = Field(
        default=None, description="True noise of its sensor; none: the sensor's"
    )
    noise_factor: float = Field(
        default=1.0, gt=0.0, le=1000.0, description='Factor on the true deviations [1]'
    )
    probability_factor: float = Field(
        default=1.0,
        ge=0.0,
        le=100.0,
        description='Factor on the true probability of detection, which is at most 1 [1]',
    )
    clutter_per_scan: float | None = Field(
        default=None,
        ge=0.0,
        le=1e4,
        description='True mean number of false detections in a scan; none: as in the sensor [1]',
    )
    odometry: OdometrySettings | None = Field(
        default=None,
        description='True noise, drift and offset of its odometry, while the covariance it reports '
        'is that of `odometry`; none: they are the same',
    )

    def sensor(self, believed: SensorSettings, name: str, bounds: Array) -> Sensor:
        """Return the true ranging sensor.

        Parameters
        ----------
        believed : SensorSettings
            As the filter has it.
        bounds : (d, 2) array
            Of the environment, metres: false detections lie within its diagonal.
        """
        dimension = len(bounds)
        noise = self.noise or believed.noise
        detection = believed.detection.model_copy(
            update={
                'probability': min(believed.detection.probability * self.probability_factor, 1.0)
            }
        )
        true = believed.model_copy(update={'noise': noise, 'detection': detection})
        sensor = true.build(name, dimension)
        sensor.covariance = sensor.covariance * self.noise_factor**2
        if self.clutter_per_scan is not None:
            size = bounds[:, 1] - bounds[:, 0]
            reach = min(math.sqrt(float((size * size).sum())), sensor.maximum_range)
            space = reach * 2.0 * math.pi * (math.pi if dimension == 3 else 1.0)
            sensor.clutter = self.clutter_per_scan / space
        return sensor
