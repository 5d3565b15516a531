"""Compiles the kernels of the filter before their first use."""

from __future__ import annotations

import numpy as np

from maasi_filter.make_filter import make_filter
from maasi_filter.models.detection import PARAMETERS, detection_probability
from maasi_filter.models.pose import Pose
from maasi_filter.records import AgentMeasurement
from maasi_filter.settings import (
    DetectionSettings,
    FilterSettings,
    NoiseSettings,
    SensorSettings,
)


def warm_up() -> None:
    """Compile, or load from the cache, every kernel that a step uses.

    A node calls this before it reports ready, so that no step waits for a compiler.
    """
    for dimension in (2, 3):
        bounds = np.array([[0.0, 10.0]] * dimension)
        for detection in (
            DetectionSettings(kind='exponential', size=[5.0] * dimension),
            DetectionSettings(kind='box', lower=[-5.0, -5.0], upper=[5.0, 5.0]),
        ):
            noise = NoiseSettings(range=0.5, bearing=0.1, elevation=0.1)
            sensor = SensorSettings(detection=detection, noise=noise).build('warm_up', dimension)
            ic_phd = FilterSettings(particles=500, birth_particles=50, particles_minimum=50)
            for settings in (ic_phd, FilterSettings(method='pmb')):
                search = make_filter(settings, bounds, np.random.default_rng(0))
                for step in range(6):
                    position = np.array([3.0 + 0.2 * step, 3.0, 3.0])
                    pose = Pose.from_yaw(position, 0.1)
                    targets = np.array([[5.0, 5.0, 5.0], [2.0, 4.0, 2.0]])[:, :dimension]
                    values = sensor.measurement.measure(targets, pose)
                    if step == 3:
                        values = values[:0]
                    search.step(
                        [AgentMeasurement('warm_up', pose, sensor, values, None, step)], 1, step
                    )
                search.exploration.at(np.full((1, 3), 3.0))
    origin = np.zeros(3)
    detection_probability(0, np.zeros(PARAMETERS), origin, origin, 0.0)
