"""The played ranging sensor."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from maasi_filter.models.pose import Pose
from maasi_filter.settings import SensorSettings
from maasi_sim.simulation.sensors import RangingSensor

POSE = Pose.from_yaw([100.0, 120.0, 80.0], 0.4)


def sensor(dimension=3, **changes):
    return SensorSettings.model_validate(changes).build('ranging', dimension)


def test_targets_are_detected_as_often_as_pi_says():
    generator = np.random.default_rng(1)
    targets = POSE.position + generator.uniform(-60, 60, (12, 3))
    played = RangingSensor(sensor(), targets, 1, 'drone')
    expected = played.sensor.detection.probability(targets, POSE).sum()
    counts = [len(played.measure(POSE, step)[0]) for step in range(1500)]
    assert_allclose(np.mean(counts), expected, rtol=0.05)


@pytest.mark.parametrize('dimension', [2, 3])
def test_noise_has_covariance_r(dimension):
    target = np.array([POSE.position + np.array([12.0, -9.0, 5.0])])
    played = RangingSensor(sensor(dimension), target, 1, 'drone')
    values = np.concatenate([played.measure(POSE, step)[0] for step in range(4000)])
    assert values.shape[1] == dimension
    errors = played.sensor.measurement.residual(
        values, played.sensor.measurement.measure(target[:, :dimension], POSE)
    )
    assert_allclose(errors.mean(axis=0), np.zeros(dimension), atol=0.06)
    assert_allclose(np.diagonal(np.cov(errors.T)), np.diagonal(played.sensor.covariance), rtol=0.1)


def test_sweeps_are_keyed_and_what_happens_to_one_target_leaves_the_others_alone():
    generator = np.random.default_rng(2)
    targets = POSE.position + generator.uniform(-30, 30, (6, 3))
    first = RangingSensor(sensor(), targets, 5, 'drone')
    assert_array_equal(first.measure(POSE, 9)[0], first.measure(POSE, 9)[0])
    far = targets.copy()
    far[0] += 1e5
    second = RangingSensor(sensor(), far, 5, 'drone')
    for step in range(30):
        kept = {tuple(row) for row in second.measure(POSE, step)[0]}
        assert kept <= {tuple(row) for row in first.measure(POSE, step)[0]}


def test_the_order_tells_nothing_and_values_stay_in_their_ranges():
    targets = POSE.position + np.array(
        [[10.0, 0, 0], [0, 20.0, 0], [-0.01, 0, 0], [-5.0, 1e-3, 4.0]]
    )
    detection = {'kind': 'box', 'probability': 1.0, 'lower': [-50] * 3, 'upper': [50] * 3}
    played = RangingSensor(sensor(detection=detection), targets, 1, 'drone')
    sweeps = [played.measure(POSE, step) for step in range(300)]
    places = [np.argsort(causes) for _, causes in sweeps]
    assert 60 < sum(order[0] < order[1] for order in places) < 240
    values = np.concatenate([values for values, _ in sweeps])
    assert (values[:, 0] > 0).all()
    assert (np.abs(values[:, 1:]).max(axis=0) <= [np.pi, np.pi / 2]).all()
    played.sensor.maximum_range = 15.0
    short = RangingSensor(played.sensor, targets, 1, 'drone')
    assert {cause for step in range(9) for cause in short.measure(POSE, step)[1]} == {0, 2, 3}
    empty = RangingSensor(sensor(), np.zeros((0, 3)), 1, 'drone')
    assert empty.measure(POSE, 0)[0].shape == (0, 3)


def test_clutter_comes_at_its_intensity_and_each_return_says_what_caused_it():
    targets = POSE.position + np.array([[10.0, 0.0, 0.0], [0.0, 20.0, 5.0], [-15.0, 8.0, -3.0]])
    bounds = np.array([[0.0, 100.0], [0.0, 0.0], [0.0, 0.0]])
    played = RangingSensor(sensor(clutter=0.002), targets, 3, 'drone', bounds)
    model, seen, clutter = played.sensor.measurement, 0, []
    for step in range(400):
        values, causes = played.measure(POSE, step)
        true = causes >= 0
        errors = model.residual(values[true], model.measure(targets[causes[true]], POSE))
        assert (np.abs(errors) < 6.0 * np.sqrt(np.diagonal(played.sensor.covariance))).all()
        seen += int(true.sum())
        clutter.append(values[~true])
    assert seen > 400
    assert_allclose(np.mean(list(map(len, clutter))), 0.002 * 100 * 2 * np.pi * np.pi, rtol=0.1)
    low, high = (end(np.concatenate(clutter), axis=0) for end in (np.min, np.max))
    assert (low > [0.0, -np.pi, -np.pi / 2]).all() and (high < [100.0, np.pi, np.pi / 2]).all()
