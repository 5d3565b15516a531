"""What holds of the multi-Bernoulli filter whatever it measures; its state; its consistency."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from searches import (
    CUBE,
    PLANE,
    checked,
    cube_sensor,
    measured,
    observe,
    plane_filter,
    plane_sensor,
    play,
    same,
    wander,
)
from shapely import wkt

from maasi_filter import AgentMeasurement, FilterSettings, Pose, wrap_angle
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.vector_math import squared_distance
from maasi_filter.make_filter import make_filter
from maasi_filter.metrics import match_targets
from maasi_filter.pmb.density import NO_PRIOR
from maasi_filter.pmb.filter import PmbFilter
from maasi_filter.pmb.scan import make_scan
from maasi_filter.records import Label


def scans(seed, number=25, clutter=1.0, order=None):
    """Return scans on the plane of four targets, with clutter; two robots in turn."""
    generator = np.random.default_rng([seed, 3])
    sensor = plane_sensor(probability=0.9, range_noise=1.0, bearing=0.03)
    targets = generator.uniform(20.0, 80.0, (4, 2))
    out = []
    for step in range(number):
        position = generator.uniform(5.0, 95.0, 2)
        pose = Pose([*position, 0.0])
        values = observe(generator, sensor, targets, pose)
        false = generator.uniform([0.0, -np.pi], [100.0, np.pi], (generator.poisson(clutter), 2))
        values = np.concatenate([values, false])
        if order is not None:
            values = values[order.permutation(len(values))]
        robot = 'ab'[step % 2]
        out.append(AgentMeasurement(robot, pose, sensor, values, None, step))
    return out


@pytest.mark.parametrize('method', ['pmb', 'ic_phd'])
def test_order_of_detections_and_of_robots_does_not_matter(method):
    settings = FilterSettings(method=method)
    one, other = (make_filter(settings, PLANE, np.random.default_rng(0)) for _ in range(2))
    play(one, scans(1))
    play(other, scans(1, order=np.random.default_rng(5)))
    same(one, other)
    first, second = scans(2, number=2)
    one.step([first, second], 1, 99.0)
    other.step([second, first], 1, 99.0)
    same(one, other)


@pytest.mark.parametrize('seed', range(6))
def test_numbers_are_finite_and_not_negative(seed):
    generator = np.random.default_rng(seed)
    search = plane_filter(seed=seed, particles=100, expected_targets=10.0 ** (seed - 3))
    noise = 10.0 ** generator.uniform(-3.0, 1.5)
    sensor = plane_sensor(probability=1.0, range_noise=noise, bearing=min(noise / 30.0, 3.0))
    for step in range(30):
        count = generator.integers(0, 6)
        values = generator.uniform([0.0, -4.0], [150.0, 4.0], (count, 2))
        if step % 3 == 0:
            values = np.repeat(values, 2, axis=0)
        result = search.step(
            [measured(sensor, generator.uniform(0.0, 100.0, 2), values, step)], 1, step
        )
        assert result.expected_number >= 0.0
        assert 0.0 <= search.exploration.values.min() <= search.exploration.values.max() <= 1.0
        for item in search.components:
            assert 0.0 <= item.existence <= 1.0
            assert np.isfinite(item.density.particles).all()
            assert (item.density.weights >= 0.0).all()
            assert item.density.weights.sum() == pytest.approx(1.0)
            assert np.linalg.eigvalsh(item.density.covariance).min() > 0.0
        weights = search.weights
        assert weights.sum() == pytest.approx(result.expected_number)
        assert len(search.particles) == len(weights)


WRONG = [
    ({'values': np.array([[np.nan, 0.0]])}, 'values: got .* allowed are finite'),
    ({'values': np.zeros((1, 3))}, r'values: got shape \(1, 3\)'),
    ({'covariances': np.zeros((2, 2, 2))}, 'covariances: got shape'),
    ({'covariances': -np.ones((1, 2, 2))}, 'allowed is a symmetric positive definite'),
    ({'position_covariance': -np.eye(3)}, 'position_covariance: got'),
    ({'position_covariance': np.eye(2)}, 'position_covariance: got'),
    ({'position_covariance': np.full((3, 3), np.nan)}, 'position_covariance: got'),
    ({'sensor': cube_sensor()}, 'sensor: got 3 dimensions'),
    ({'labels': [Label()] * 2}, 'labels: got 2, allowed are 1, or none'),
]


@pytest.mark.parametrize('method', ['pmb', 'ic_phd'])
def test_bad_measurements_are_refused_and_change_nothing(method):
    settings = FilterSettings(method=method, use_detection_covariances=True)
    search, untouched = (
        play(make_filter(settings, PLANE, np.random.default_rng(0)), scans(3, number=5))
        for _ in range(2)
    )
    good = measured(plane_sensor(), (1.0, 1.0), [[10.0, 0.0]])
    for change, text in WRONG:
        with pytest.raises(ValueError, match=text):
            search.step([good, replace(good, robot='b', **change)], 1, 9.0)
    for steps, time in ((-1, 0.0), (0.5, 0.0), (True, 0.0), (1, np.inf)):
        with pytest.raises(ValueError, match=r'steps|time'):
            search.step([], steps, time)
    with pytest.raises(ValueError, match='each robot once'):
        search.step([good, good], 1, 9.0)
    same(search, untouched)


def cube_search(seed, number, clutter):
    """Search targets drawn from the prior; return filter, targets and (r, is a target) of steps."""
    generator = np.random.default_rng([seed, 9])
    sensor = cube_sensor()
    sensor.clutter = clutter / sensor.measurement_space(CUBE)
    targets = generator.uniform(0.0, 260.0, (generator.poisson(12.0), 3))
    search = PmbFilter(FilterSettings(method='pmb'), CUBE, np.random.default_rng([seed, 10]))
    pairs = []
    for step, position in enumerate(wander(generator, number)):
        values = observe(generator, sensor, targets, Pose(position))
        low, high = [0.0, -np.pi, -np.pi / 2], [260.0 * 3.0**0.5, np.pi, np.pi / 2]
        false = generator.uniform(low, high, (generator.poisson(clutter), 3))
        values = np.concatenate([values, false])
        values[:, 1] = wrap_angle(values[:, 1])
        search.step([AgentMeasurement('drone', Pose(position), sensor, values)], 1, float(step))
        if step % 5 == 4:
            pairs += judged(search, targets)
    return search, targets, pairs


def judged(search, targets):
    """Return r of each component, and whether it is a target that no more certain one is."""
    left = list(range(len(targets)))
    out = []
    for item in sorted(search.components, key=lambda item: -item.existence):
        distances = [
            squared_distance(item.density.mean - targets[t], item.density.covariance) for t in left
        ]
        is_target = bool(distances) and min(distances) < 25.0
        if is_target:
            left.pop(int(np.argmin(distances)))
        out.append((item.existence, is_target))
    return out


def test_covariances_and_existence_are_as_they_say():
    normalised, errors, pairs = [], [], []
    for seed in range(20_000, 20_040):
        search, targets, found = cube_search(seed, 60, 0.5)
        pairs += found
        positions = np.array([target.position for target in search.found_targets]).reshape(-1, 3)
        match = match_targets(positions, targets, 5.0)
        errors.append(match.false_found)
        normalised += [
            squared_distance(positions[i] - targets[j], search.found_targets[i].covariance)
            for i, j in match.pairs
        ]
    assert len(normalised) > 300
    assert 2.5 < np.mean(normalised) < 3.5
    assert sum(errors) <= 1
    existence, true = np.array(pairs, float).T
    # Of all components with r near 0.7, 70 % are targets; steps of one search are correlated.
    for low, high in ((0.0, 0.05), (0.1, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 0.95), (0.99, 1.0)):
        inside = (existence >= low) & (existence < high)
        assert inside.sum() > 100
        assert true[inside].mean() == pytest.approx(existence[inside].mean(), abs=0.08), low


@pytest.mark.parametrize('seed', range(8))
def test_births_and_factors_see_the_same_prior_at_borders(seed):
    """Where targets may be and what is unexplored, for a detection that lies across a border."""
    rng = np.random.default_rng(seed)
    corners = np.array([[0, 0], [90, 10], [70, 90], [10, 80]]) + rng.uniform(-9.0, 9.0, (4, 2))
    zone = {'centre': rng.uniform(30.0, 60.0, 2).tolist(), 'radius': 15.0}
    environment = EnvironmentSettings.model_validate(
        {'area': wkt.dumps(shapely.Polygon(corners)), 'keep_outs': [zone]}
    )
    search = PmbFilter(FilterSettings(method='pmb'), environment, rng)
    exploration, sensor = search.exploration, plane_sensor(range_noise=3.0)
    exploration.update(sensor.detection, Pose([*rng.uniform(0.0, 80.0, 2), 0.0]))
    border = exploration.area.region.boundary.interpolate(rng.random(), normalized=True)
    target, bearing = np.array([[border.x, border.y]]), rng.uniform(-3.0, 3.0)
    pose = Pose([*(target[0] + 20.0 * np.array([np.cos(bearing), np.sin(bearing)])), 0.0])
    member = checked(measured(sensor, pose.position[:2], sensor.measurement.measure(target, pose)))
    scan = make_scan(member, 1.0, exploration, search.settings.resolved(), rng)
    prior = exploration.kernel()[0], exploration.area.cells
    ((_, born),) = scan.born(np.ones(1, bool), prior, search._frame)
    known = scan.volume[0] > 0.0
    draws, expected = scan.draws[0, known], scan.weights[0, known] / scan.volume[0, known]
    factors = born.log_at(draws) - replace(born, prior=NO_PRIOR).log_at(draws)
    np.testing.assert_allclose(np.exp(factors), expected, rtol=1e-9)
    assert 0.1 < (expected > 0.0).mean() < 0.9
