"""The exact reference of the benchmarks against the mixture that is enumerated on a grid."""

import numpy as np
import pytest
from exact_pmbm import ExactPmbm
from exact_reference import Reference
from reference_quality import run_one
from searches import SIDE, cells, densities, observe, plane_sensor

from maasi_filter import Pose

PLACES = [(30.0, 30.0), (50.0, 70.0), (80.0, 20.0)]
CLUTTER = 2e-4


def density(reference):
    """Return the density of detected targets at the cells, without grids of the reference."""
    total = np.zeros(SIDE**2)
    for mixture in reference.groups:
        for weight, tracks in mixture:
            for track in tracks:
                logs = reference.log_missed(cells(), 1.0)
                reference.add_seen(logs, cells(), 1.0, track.seen)
                scale = track.existence * np.exp(-track.mass)
                total += weight * scale * np.exp(logs)
    return total


@pytest.mark.parametrize(
    'targets',
    [
        [[20.0, 30.0], [70.0, 60.0], [60.0, 20.0]],
        [[60.0, 45.0], [68.0, 50.0]],
        [[60.0, 45.0], [63.0, 48.0], [58.0, 50.0]],
    ],
)
def test_is_the_enumerated_mixture(targets):
    """Up to three scans of close and distant targets with misses and a false detection each."""
    sensor = plane_sensor(probability=0.8)
    for seed in range(2):
        generator = np.random.default_rng([seed, 8])
        exact = ExactPmbm(np.full(SIDE**2, 3.0 / SIDE**2))
        reference = Reference(sensor, float(SIDE), 3.0, CLUTTER)
        for place in PLACES:
            pose = Pose(np.array([*place, 0.0]))
            values = observe(generator, sensor, np.array(targets), pose)
            if len(values) < 3:
                false = [generator.uniform(20.0, 40.0), generator.uniform(-3.0, 3.0)]
                values = np.concatenate([values, [false]])
            exact.update(*densities(sensor, place, values), CLUTTER)
            reference.update(pose, values)
        expected, ours = exact.density(), density(reference)
        assert ours.sum() == pytest.approx(expected.sum(), rel=2e-3)
        np.testing.assert_allclose(ours, expected, atol=0.01 * expected.max())
        assert reference.lost == 0.0


def test_estimates_are_those_of_the_best_hypothesis_with_probabilities_of_all():
    sensor, targets = plane_sensor(range_noise=0.5, bearing=0.01), np.array([[60.0, 45.0]])
    reference = Reference(sensor, float(SIDE), 3.0, CLUTTER)
    for place in PLACES:
        pose = Pose(np.array([*place, 0.0]))
        reference.update(pose, sensor.measurement.measure(targets, pose))
    ((existence, mean, covariance, hits),) = reference.targets()
    assert existence > 0.99
    assert hits == 3
    np.testing.assert_allclose(mean, targets[0], atol=0.1)
    assert np.sqrt(np.trace(covariance)) < 0.5
    for _ in range(12):
        reference.update(Pose(np.array([60.0, 45.0, 0.0])), np.empty((0, 2)))
    assert sum(item[0] for item in reference.targets()) < existence


def test_scores_of_one_scene_are_those_of_filters_that_find_the_targets():
    runs = {method: run_one(('no clutter', method, 20_002)) for method in ('reference', 'pmb')}
    for run in runs.values():
        assert run['found'] == run['targets'] == 3
        assert run['false'] == 0
    exact, ours = runs['reference']['gospa'], runs['pmb']['gospa']
    assert ours == pytest.approx(exact, rel=0.2)
    expected, true, number = np.sum(runs['reference']['bins'], axis=1)
    assert true == pytest.approx(expected, abs=0.05 * number)
