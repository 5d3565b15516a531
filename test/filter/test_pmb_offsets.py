"""Errors of robots' positions that last are estimated from found targets."""

import numpy as np
import pytest
from searches import CUBE, checked, cube_sensor

from maasi_filter import AgentMeasurement, FilterSettings, PmbFilter, Pose
from maasi_filter.pmb.offsets import Offsets
from maasi_filter.settings import OffsetSettings

TARGETS = np.array([[120.0, 130.0, 130.0], [150.0, 120.0, 125.0], [130.0, 150.0, 140.0]])
PLACES = {'a': np.array([125.0, 118.0, 128.0]), 'b': np.array([145.0, 140.0, 130.0])}


def scan(generator, robot, error, way=0.0):
    """Return a robot's scan of all targets; it believes to be `error` from where it is."""
    sensor = cube_sensor()
    true = PLACES[robot] + [way, 0.0, 0.0]
    noise = generator.multivariate_normal(np.zeros(3), sensor.covariance, len(TARGETS))
    values = sensor.measurement.measure(TARGETS, Pose(true)) + noise
    return AgentMeasurement(robot, Pose(true + error), sensor, values)


def new_filter(**offset):
    settings = FilterSettings(method='pmb', pmb={'offset': offset})
    return PmbFilter(settings, CUBE, np.random.default_rng(0))


def looked(search, errors, steps=12, seed=1):
    generator = np.random.default_rng(seed)
    for step in range(steps):
        scans = [scan(generator, robot, error) for robot, error in errors.items()]
        search.step(scans, 1, float(step))
    return search


def mean_error(search):
    """Return the mean difference (d,) of found targets from the nearest true one."""
    found = np.array([target.position for target in search.found_targets])
    assert len(found) == len(TARGETS)
    nearest = np.linalg.norm(found[:, None] - TARGETS, axis=2).argmin(axis=1)
    assert sorted(nearest.tolist()) == [0, 1, 2]
    return (found - TARGETS[nearest]).mean(axis=0)


def test_opposite_offsets_of_two_robots_cancel():
    error = np.array([1.2, -0.8, 0.6])
    search = looked(new_filter(deviation=1.0), {'a': error}, 6)
    looked(search, {'b': -error}, 6, seed=2)
    assert np.linalg.norm(mean_error(search)) < 0.5
    offsets = search._offsets
    assert offsets._rows('a', 'b') @ offsets.mean == pytest.approx(2.0 * error, abs=0.7)
    # The half of their difference is known, their mean is not.
    for target in search.found_targets:
        assert 0.4 < np.trace(offsets.covariance_of(target.id)) / 3.0 < 0.7


def test_what_one_robot_cannot_know_is_reported():
    search = looked(new_filter(deviation=1.0), {'a': np.array([1.0, 1.0, -1.0])})
    assert mean_error(search) == pytest.approx([1.0, 1.0, -1.0], abs=0.6)
    for target in search.found_targets:
        assert (np.diagonal(target.covariance) > 1.0).all()


def test_a_robot_that_drifted_is_located_by_what_it_found():
    generator = np.random.default_rng(2)
    search = looked(new_filter(drift=0.5), {'a': np.zeros(3)})
    drifted = np.array([4.0, -3.0, 0.0])
    for step in range(12, 24):
        search.step([scan(generator, 'a', drifted, way=40.0)], 1, float(step))
    assert np.linalg.norm(mean_error(search)) < 1.0
    assert search._offsets.mean[:3] == pytest.approx(drifted, abs=1.5)


def test_update_is_the_exact_one_of_two_robots_and_a_target_known_exactly():
    """Against the posterior of the difference of two normal errors, by hand."""
    offsets = Offsets(OffsetSettings(deviation=2.0), 3)
    search = looked(new_filter(), {'a': np.zeros(3)})
    # Without the setting errors count as independent.
    assert not search._offsets.active and search._offsets.keys == []
    generator = np.random.default_rng(3)
    offsets.localise(checked(scan(generator, 'a', np.zeros(3))), [], 1e-9, 1e-9)
    item = next(item for item in search.components if item.target is not None)
    offsets.find('a', item.target.id)
    assert offsets.covariance[:3, 3:] == pytest.approx(4.0 * np.eye(3))
    member = checked(scan(generator, 'b', np.zeros(3)))
    density, pose = item.density, member.pose
    jacobian = member.sensor.measurement.jacobian(density.mean[None], pose)[0]
    noise = jacobian @ density.covariance @ jacobian.T + member.sensor.covariance
    information = np.eye(3) / 8.0 + jacobian.T @ np.linalg.solve(noise, jacobian)
    offsets.localise(member, [item], 1e-9, 1e-9)
    rows = offsets._rows('b', item.target.id)
    # To first order of the measurement.
    assert rows @ offsets.covariance @ rows.T == pytest.approx(np.linalg.inv(information), rel=0.05)


def test_targets_that_are_withdrawn_are_marginalised():
    search = looked(new_filter(deviation=1.0), {'a': np.zeros(3), 'b': np.ones(3)})
    offsets = search._offsets
    part = offsets.covariance[:6, :6].copy()
    offsets._keep(['a', 'b'])
    assert offsets.keys == ['a', 'b']
    np.testing.assert_array_equal(offsets.covariance, part)


def test_what_a_robot_reports_of_its_error_is_not_counted_twice():
    offsets = Offsets(OffsetSettings(deviation=2.0), 3)
    measurement = scan(np.random.default_rng(0), 'a', np.zeros(3))
    measurement.position_covariance = 5.0 * np.eye(3)
    member = checked(measurement)
    assert member.pose_error == pytest.approx(np.sqrt(5.0))
    assert offsets.localise(member, [], 1e-9, 1e-9).pose_error == pytest.approx(1.0)
