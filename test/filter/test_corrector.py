"""The correctors of two robots against the equations, births included."""

from __future__ import annotations

import numpy as np
import pytest

from maasi_filter import (
    AgentMeasurement,
    DetectionSettings,
    FilterSettings,
    NoiseSettings,
    Pose,
    SearchFilter,
    SensorSettings,
)

SIDE = 40.0
BOUNDS = np.array([[0.0, SIDE]] * 2)
N0 = 12.0
TARGETS = np.array([[16.0, 20.0], [30.0, 24.0], [12.0, 8.0]])
# Which robot sees which target; the third is known already.
SEEN = {'one': [0, 2], 'two': [0, 1, 2]}
POSES = {'one': Pose([10.0, 14.0, 0.0]), 'two': Pose([24.0, 14.0, 0.0])}
SENSOR = SensorSettings(
    detection=DetectionSettings(kind='exponential', probability=0.9, size=[8.0, 8.0]),
    noise=NoiseSettings(range=1.5, bearing=0.12),
    clutter=1e-4,
).build('any', 2)


def known_cloud():
    generator = np.random.default_rng(5)
    return TARGETS[2] + generator.normal(0.0, 1.5, (3000, 2)), np.full(3000, 0.8 / 3000)


def detections(name):
    return SENSOR.measurement.measure(TARGETS[SEEN[name]], POSES[name])


def literal(corrector):
    """Return points and masses after (9) of 002 or (16) of 000, without what nobody detected.

    The constant intensity Y is summed over a fine grid. Its part Y prod(1 - pi) stays background:
    the filter has it in the intensity of births, not in particles.
    """
    cells = 800
    axis = (np.arange(cells) + 0.5) * SIDE / cells
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    cloud, weights = known_cloud()
    points = np.vstack([cloud, grid])
    predicted = np.concatenate([weights, np.full(len(grid), N0 / len(grid))])
    intensity = predicted.copy()
    background = np.concatenate([np.zeros(len(cloud)), np.full(len(grid), N0 / len(grid))])
    for name in ('one', 'two'):
        pose = POSES[name]
        probability = SENSOR.detection.probability(points, pose)
        factor = 1.0 - probability
        background *= 1.0 - probability
        values = detections(name)
        density = np.exp(SENSOR.measurement.log_density(values, points, pose, SENSOR.covariance))
        for row in density:
            psi = probability * row
            below = intensity if corrector == 'running' else predicted
            factor += psi / (SENSOR.clutter + float(psi @ below))
        intensity = intensity * factor
    return points, intensity - background


def mass_near(points, masses, target):
    return float(masses[np.linalg.norm(points - target, axis=1) < 6.0].sum())


@pytest.mark.parametrize('corrector', ['running', 'predicted'])
def test_two_robots_correct_as_printed(corrector):
    settings = FilterSettings(
        preset='paper_002',
        corrector=corrector,
        extraction='measurement',
        removal='none',
        found_mass=1e9,
        expected_targets=N0,
        particles=400_000,
        particles_per_target=20_000,
        birth_particles=20_000,
        jitter_deviation=0.01,
        jitter_differential=0.0,
    )
    search = SearchFilter(settings, BOUNDS, np.random.default_rng(0))
    search.restore_particles(*known_cloud())
    search.step(
        [AgentMeasurement(name, POSES[name], SENSOR, detections(name)) for name in POSES], 1, 0.0
    )
    points, masses = literal(corrector)
    assert search.expected_number == pytest.approx(float(masses.sum()), rel=0.03)
    for target in TARGETS:
        expected = mass_near(points, masses, target)
        assert mass_near(search.particles, search.weights, target) == pytest.approx(
            expected, rel=0.05
        )
