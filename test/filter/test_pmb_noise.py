"""The factor of a robot's noise is learnt from the innovations of found targets."""

import numpy as np
import pytest
from searches import CUBE, cube_sensor

from maasi_filter import AgentMeasurement, FilterSettings, PmbFilter, Pose
from maasi_filter.measurement_check import check_measurements
from maasi_filter.pmb.noise_scale import MOST_FACTOR, NoiseScale, innovations

TARGET = np.array([[130.0, 130.0, 130.0]])
POSE = Pose([112.0, 120.0, 125.0])


def checked(values, **changes):
    measurement = AgentMeasurement('drone', POSE, cube_sensor(), values, **changes)
    settings = FilterSettings(method='pmb').resolved()
    return check_measurements([measurement], 1, 0.0, settings, 3)[0]


def drawn(generator, factor, number):
    sensor = cube_sensor()
    noise = generator.multivariate_normal(np.zeros(3), factor * sensor.covariance, number)
    return sensor.measurement.measure(TARGET, POSE) + noise


@pytest.mark.parametrize('factor', [0.5, 1.0, 2.25])
def test_the_innovation_of_a_target_known_exactly_tells_the_factor(factor):
    member = checked(drawn(np.random.default_rng(0), factor, 4000))
    squares = innovations(member, TARGET, np.zeros((1, 3, 3))).squares / 3.0
    assert np.mean(squares) == pytest.approx(factor, rel=0.05)


def test_errors_of_the_position_that_are_told_are_no_noise():
    generator = np.random.default_rng(1)
    sensor = cube_sensor()
    squares = []
    for _ in range(2000):
        true = Pose(POSE.position + generator.normal(size=3))
        noise = generator.multivariate_normal(np.zeros(3), sensor.covariance)
        values = sensor.measurement.measure(TARGET, true) + noise
        member = checked(values, position_covariance=np.eye(3))
        squares.append(innovations(member, TARGET, np.zeros((1, 3, 3))).squares[0, 0] / 3.0)
    assert np.mean(squares) == pytest.approx(1.0, rel=0.1)


def test_the_belief_is_worth_some_detections_and_the_factor_is_bounded():
    scale = NoiseScale()
    assert scale.factor('drone') == 1.0
    for _ in range(2000):
        scale.count('drone', 0.9, 2.0)
    assert scale.factor('drone') == pytest.approx(2.0, rel=0.01)
    assert scale.factor('other') == 1.0
    scale.count('other', 1.0, 1e9)
    assert scale.factor('other') == MOST_FACTOR


@pytest.mark.parametrize('factor', [0.45, 1.0, 2.25])
def test_a_filter_learns_the_noise_of_its_robot(factor):
    """Too little rather than too much, as targets are never known exactly."""
    generator = np.random.default_rng(2)
    search = PmbFilter(FilterSettings(method='pmb'), CUBE, np.random.default_rng(3))
    for step in range(120):
        values = drawn(generator, factor, 1)
        search.step([AgentMeasurement('drone', POSE, cube_sensor(), values)], 1, float(step))
    assert len(search.found_targets) == 1
    learnt = search._noise.factor('drone')
    assert min(1.0, factor) - 0.15 < learnt < max(1.0, factor) + 0.3
    assert abs(learnt - factor) < 0.5 * abs(1.0 - factor) + 0.2
