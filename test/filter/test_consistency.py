"""Covariances of found targets are honest: NEES, and never better than Cramer and Rao allow."""

import numpy as np
import pytest
from scipy.stats import chi2
from searches import DEGREES, RADIANS, cube_sensor, follow_one_target

from maasi_filter import Pose
from maasi_filter.ic_phd.found_targets import bounded_below, missing_spread, refine
from maasi_filter.metrics import normalised_error
from maasi_filter.models.measurement_set import prepare_measurements

TARGETS = 200


@pytest.fixture(scope='module', params=['degrees', 'radians'])
def followed(request):
    """Return (errors and covariances at finding, and after more measurements) of many targets."""
    noise = DEGREES if request.param == 'degrees' else RADIANS
    runs = [follow_one_target(seed, noise) for seed in range(TARGETS)]
    assert all(run is not None for run in runs)
    return runs


def test_nees_is_within_its_chi_square_bounds(followed):
    """Never overconfident (chi-square, 600 degrees of freedom), at most a quarter too cautious.

    Over 1000 targets the mean NEES is 2.88 in degrees and 2.68 in radians; 3 would be exact.
    """
    total = sum(normalised_error(*states[1]) for states, _ in followed)
    assert 0.75 * 3 * TARGETS < total < chi2.ppf(0.995, 3 * TARGETS)


def test_a_target_just_found_claims_no_less_than_its_error(followed):
    """When found the covariance may be cautious, as marking prefers the narrow; never bold."""
    total = sum(normalised_error(*states[0]) for states, _ in followed)
    assert total < chi2.ppf(0.995, 3 * TARGETS)
    assert total > 0.6 * 3 * TARGETS


def test_nees_has_no_heavy_tail(followed):
    values = np.array([normalised_error(*states[1]) for states, _ in followed])
    assert (values > chi2.ppf(0.99, 3)).mean() <= 0.04
    assert np.median(values) == pytest.approx(chi2.ppf(0.5, 3), abs=0.6)


def test_one_target_is_found_once(followed):
    assert sum(number - 1 for _, number in followed) == 0


def test_more_measurements_make_errors_smaller(followed):
    before = np.array([states[0][0] for states, _ in followed])
    after = np.array([states[1][0] for states, _ in followed])
    assert (after**2).sum() < 0.5 * (before**2).sum()


def test_errors_of_the_position_that_the_robot_tells_of_do_not_make_it_bold():
    """Errors that are new each time average out, which the filter does not count on."""
    upper = chi2.ppf(0.995, 3 * 40)
    for told in (True, False):
        runs = [
            follow_one_target(seed, DEGREES, position_deviation=0.5, told=told)
            for seed in range(40)
        ]
        total = sum(normalised_error(*states[1]) for states, _ in runs)
        assert (total < upper) == told


@pytest.mark.parametrize(('noise', 'gain'), [(DEGREES, 1.0), (RADIANS, 2.0)])
def test_nees_of_targets_refined_from_nearby_is_within_its_chi_square_bounds(noise, gain):
    """Five detections each from within some metres, where no measurement is near linear.

    Errors become `gain` times smaller at least; those of narrow noise may be left as they are.
    """
    generator = np.random.default_rng(3)
    sensor = cube_sensor(noise)
    before = after = total = 0.0
    for _ in range(TARGETS):
        position = 130.0 + generator.normal(size=3)
        root = np.diag([0.8, 1.2, 1.8])
        covariance = root @ root.T
        target = position + root @ generator.normal(size=3)
        before += ((position - target) ** 2).sum()
        for _ in range(5):
            pose = Pose(target + generator.uniform(-5.0, 5.0, 3))
            z = sensor.measurement.measure(target[None], pose)
            z += generator.multivariate_normal(np.zeros(3), sensor.covariance)
            z[0, 0] = max(z[0, 0], 1e-6)
            seen = prepare_measurements(z, sensor.covariance[None], pose)
            position, covariance = refine(position, covariance, seen, 0, pose)
        total += normalised_error(position - target, covariance)
        after += ((position - target) ** 2).sum()
    lower, upper = chi2.ppf([0.005, 0.995], 3 * TARGETS)
    assert lower < total < upper
    assert after * gain**2 < before


def test_a_covariance_is_widened_to_the_bound_and_no_further():
    generator = np.random.default_rng(0)
    for _ in range(50):
        root = generator.normal(size=(3, 3))
        information = root @ root.T + 0.1 * np.eye(3)
        root = generator.normal(size=(3, 3)) * 10.0 ** generator.uniform(-3, 1)
        covariance = root @ root.T
        bounded = bounded_below(covariance, information)
        # Nowhere below the bound, nowhere below what it was.
        assert np.linalg.eigvalsh(bounded - np.linalg.inv(information))[0] > -1e-9
        assert np.linalg.eigvalsh(bounded - covariance)[0] > -1e-9
    wide = np.linalg.inv(information) * 1.5
    np.testing.assert_allclose(bounded_below(wide, information), wide, rtol=1e-9)
    np.testing.assert_allclose(
        bounded_below(np.zeros((3, 3)), information), np.linalg.inv(information), rtol=1e-9
    )


def test_missing_spread_is_a_root_of_what_lacks():
    information = np.diag([1.0, 4.0])
    covariances = np.array([[[2.0, 0.0], [0.0, 0.1]], [[2.0, 0.3], [0.3, 2.0]]])
    fill = missing_spread(covariances, np.array([information, information]), 1e-9 * np.eye(2))
    np.testing.assert_allclose(fill[0] @ fill[0].T, [[0.0, 0.0], [0.0, 0.15]], atol=1e-6)
    np.testing.assert_array_equal(fill[1], 0.0)
    assert missing_spread(covariances[1:], information[None], 1e-9 * np.eye(2)) is None
