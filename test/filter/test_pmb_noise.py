"""What is learnt of noise and errors of positions, and the warning that they do not fit."""

import numpy as np
import pytest
from scipy.stats import chi2, norm
from searches import CUBE, DEGREES, RADIANS, checked, cube_sensor, observe

from maasi_filter import AgentMeasurement, FilterSettings, PmbFilter, Pose
from maasi_filter.pmb.learnt import BOUND, MOST_FACTOR, Learnt, excess, innovations

TARGET = np.array([[130.0, 130.0, 130.0]])
POSE = Pose([112.0, 120.0, 125.0])


def drawn(generator, factor, number):
    sensor = cube_sensor()
    noise = generator.multivariate_normal(np.zeros(3), factor * sensor.covariance, number)
    return sensor.measurement.measure(TARGET, POSE) + noise


def test_errors_of_the_position_that_are_told_are_no_noise():
    generator = np.random.default_rng(1)
    sensor = cube_sensor()
    squares = []
    for _ in range(2000):
        true = Pose(POSE.position + generator.normal(size=3))
        noise = generator.multivariate_normal(np.zeros(3), sensor.covariance)
        values = sensor.measurement.measure(TARGET, true) + noise
        told = AgentMeasurement('drone', POSE, sensor, values, position_covariance=np.eye(3))
        squares.append(innovations(checked(told), TARGET, np.zeros((1, 3, 3)))[3][0, 0] / 3.0)
    assert np.mean(squares) == pytest.approx(1.0, rel=0.1)


def test_the_belief_is_worth_some_detections_and_the_factor_is_bounded():
    learnt, other = Learnt(), Learnt()
    assert learnt.noise_factor() == 1.0
    for _ in range(2000):
        learnt.count_innovation(6.0, 3, 0.9)
    assert learnt.noise_factor() == pytest.approx(2.0, rel=0.01)
    other.count_innovation(1e9, 3, 1.0)
    assert other.noise_factor() == MOST_FACTOR


@pytest.mark.parametrize('factor', [0.45, 1.0, 2.25])
def test_a_filter_learns_the_noise_of_its_robot(factor):
    """Too little rather than too much, as targets are never known exactly."""
    generator = np.random.default_rng(2)
    search = PmbFilter(FilterSettings(method='pmb'), CUBE, np.random.default_rng(3))
    for step in range(120):
        values = drawn(generator, factor, 1)
        search.step([AgentMeasurement('drone', POSE, cube_sensor(), values)], 1, float(step))
    assert len(search.found_targets) == 1
    learnt = search._learnt['drone'].noise_factor()
    assert min(1.0, factor) - 0.15 < learnt < max(1.0, factor) + 0.3
    assert abs(learnt - factor) < 0.5 * abs(1.0 - factor) + 0.2


def searched(seed, scans=100, error=0.0, walk=0.0, noise=DEGREES):
    """Return a filter that saw one target from around it, and its last result; m, m/scan^0.5."""
    generator = np.random.default_rng(seed)
    sensor = cube_sensor(noise)
    search = PmbFilter(FilterSettings(method='pmb'), CUBE, np.random.default_rng(seed + 1))
    target = TARGET.copy()
    for step in range(scans):
        target += walk * generator.standard_normal(3)
        pose = Pose(TARGET[0] + generator.uniform(-15.0, 15.0, 3))
        values = observe(generator, sensor, target, pose)
        reported = Pose(pose.position + error * generator.standard_normal(3))
        result = search.step([AgentMeasurement('drone', reported, sensor, values)], 1, float(step))
    return search, result


@pytest.mark.parametrize('seed', range(3))
def test_errors_of_positions_that_nobody_tells_of_are_learnt(seed):
    search, result = searched(seed, error=3.0)
    assert len(search.found_targets) == 1
    target = search.found_targets[0]
    offset = target.position - TARGET[0]
    # Within the 0.999 quantile of chi-squared; without the learnt error it is above 100.
    assert offset @ np.linalg.solve(target.covariance, offset) < 16.3
    assert 'drone: detections of found targets are' in result.misfits['drone']


def test_a_scan_that_an_error_of_the_position_explains_does_not_tell_the_noise():
    search, _ = searched(0, scans=30)
    values = drawn(np.random.default_rng(1), 1.0, 1)
    member = checked(AgentMeasurement('drone', POSE, cube_sensor(), values))
    caused = np.array([[float(item.target is not None)] for item in search.components])
    for blurred in (True, False):
        learnt = Learnt()
        learnt.count_found(member, search.components, caused, blurred)
        assert learnt.fit[1] == 3.0
        assert learnt.detections == (0.0 if blurred else 1.0)


@pytest.mark.parametrize('noise', [DEGREES, RADIANS])
def test_what_is_as_believed_is_no_misfit_and_no_error(noise):
    for seed in range(5):
        search, result = searched(seed, noise=noise)
        assert len(search.found_targets) == 1
        assert not result.misfits
        assert search._learnt['drone'].errors.argmax() == 0


def test_a_target_that_walks_untold_does_not_fit():
    assert 'drone' in searched(0, walk=0.5)[1].misfits


@pytest.mark.parametrize('freedom', [12.0, 150.0])
def test_the_excess_of_a_sum_is_that_of_chi_squared(freedom):
    """Its tail beyond four deviations is that of a normal number, within a factor of two."""
    ratio = chi2.isf(norm.sf(BOUND), freedom) / freedom
    assert norm.sf(excess(ratio, freedom)) == pytest.approx(norm.sf(BOUND), rel=0.5)


def test_one_outlier_is_no_misfit_and_misfits_are_forgotten():
    learnt = Learnt()

    def counted(square, number):
        for _ in range(number):
            learnt.count_innovation(square, 3, 0.0)
        return bool(learnt.misfit('drone'))

    assert not counted(3.0, 30)
    assert not counted(1e6, 1)
    assert counted(30.0, 60)
    assert not counted(3.0, 200)
