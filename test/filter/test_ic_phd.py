"""The step of the PHD filter as its users call it: searches, order, threads, and bad input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from searches import CUBE, FLOOR, FLOOR_LENGTHS, cube_sensor, floor_sensor, observe

from maasi_filter import (
    AgentMeasurement,
    DetectionSettings,
    FilterSettings,
    IcPhdFilter,
    NoiseSettings,
    Pose,
    SensorSettings,
    make_filter,
    warm_up,
)


def cube_search(seed=0, **options):
    return IcPhdFilter(FilterSettings(**options), CUBE, np.random.default_rng(seed))


def drone(values, position=(100.0, 100.0, 100.0), name='drone', sensor=None, **options):
    return AgentMeasurement(
        name, Pose(np.array(position)), sensor or cube_sensor(), np.array(values), **options
    )


def visit(search, targets, poses, generator):
    """Step the filter through what robots see at rows of poses."""
    sensor = cube_sensor()
    for step, row in enumerate(poses):
        members = [
            drone(observe(generator, sensor, targets, Pose(p)), p, f'robot_{r}', sensor)
            for r, p in enumerate(row)
        ]
        search.step(members, 1, float(step))


def flight(generator, steps, robots=1):
    centres = np.cumsum(generator.normal(0.0, 12.0, (steps, robots, 3)), axis=0)
    return np.clip(130.0 + centres, 0.0, 260.0)


def test_threads_change_nothing():
    generator = np.random.default_rng(4)
    targets = generator.uniform(80.0, 180.0, (4, 3))
    poses = flight(generator, 6)
    outcome = []
    for threads in (1, 4):
        search = cube_search(3, threads=threads, particles=150_000, particles_per_target=150_000)
        visit(search, targets, poses, np.random.default_rng(0))
        assert len(search.particles) > 70_000
        outcome.append(search)
    np.testing.assert_array_equal(outcome[0].particles, outcome[1].particles)
    np.testing.assert_array_equal(outcome[0].weights, outcome[1].weights)


def test_births_of_a_robot_count_what_the_robots_before_it_missed():
    sensor, here, values = cube_sensor(), [100.0] * 3, [[20.0, 0.3, 0.1]]
    # So much that the mass of births is in proportion to their intensity.
    sensor.clutter = 1.0
    own, other = drone(values, here, 'b', sensor), drone(np.empty((0, 3)), here, 'a', sensor)
    alone, second = (cube_search().step(members, 1, 0.0) for members in ([own], [other, own]))
    place = sensor.measurement.inverse(values, Pose(here))
    missed = 1.0 - sensor.detection.probability(place, Pose(here))[0]
    assert second.expected_number == pytest.approx(missed * alone.expected_number, rel=0.05)


def test_a_first_detection_is_a_cluster_of_mass_one_that_only_survival_changes_unmeasured():
    search = cube_search(survival_probability=0.9)
    result = search.step([drone([[20.0, 0.3, 0.1]])], 1, 0.0)
    assert result.newly_found == []
    (cluster,) = result.clusters
    assert cluster.mass == pytest.approx(1.0, abs=0.05)
    expected = cube_sensor().measurement.inverse([[20.0, 0.3, 0.1]], Pose([100.0] * 3))[0]
    np.testing.assert_allclose(cluster.position, expected, atol=0.5)
    weights = search.weights
    result = search.step([], 3, 1.0)
    np.testing.assert_allclose(search.weights, weights * 0.9**3)
    assert result.expected_number == pytest.approx(weights.sum() * 0.9**3)


@pytest.mark.parametrize('method', ['ic_phd', 'pmb'])
def test_detections_that_nothing_explains_are_counted(method):
    sensor = cube_sensor()
    sensor.maximum_range = 250.0
    values = [[260.0, 0.3, 0.1], [200.0, np.pi, 0.0], [20.0, 0.0, 0.0]]
    search = make_filter(FilterSettings(method=method), CUBE, np.random.default_rng(0))
    result = search.step([drone(values, sensor=sensor)], 1, 0.0)
    assert result.dropped == {'range': 1, 'outside': 1}
    assert result.expected_number == pytest.approx(1.0, abs=0.1)
    search = make_filter(FilterSettings(method=method), FLOOR, np.random.default_rng(0))
    member = drone([[0.6, 0.0], [0.1, 0.0]], [1.0, 1.0, 1.0], sensor=floor_sensor())
    assert search.step([member], 1, 0.0).dropped == {'unseen': 1}


def test_a_target_right_below_the_robot_is_found():
    generator = np.random.default_rng(0)
    search = IcPhdFilter(FilterSettings(), FLOOR, np.random.default_rng(1))
    for step in range(5):
        values = np.array([[0.016 * generator.standard_normal(), 3.0]])
        search.step([drone(values, [1.0, 1.0, 1.0], sensor=floor_sensor())], 1, step)
    assert len(search.found_targets) == 1
    np.testing.assert_allclose(search.found_targets[0].position, [1.0, 1.0], atol=0.02)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 100_000),
    st.sampled_from(['measurement', 'uniform', 'gaussian']),
    st.sampled_from([2, 3]),
)
def test_whatever_is_measured_the_expected_number_stays_sound(seed, births, dimension):
    generator = np.random.default_rng(seed)
    bounds = np.array([[0.0, 10.0]] * dimension)
    kind = str(generator.choice(['exponential', 'gaussian', 'box']))
    sensor = SensorSettings(
        detection=DetectionSettings(kind=kind, size=[3.0] * dimension),
        noise=NoiseSettings(range=0.2, bearing=0.1, elevation=0.1),
        clutter=float(generator.choice([0.0, 0.01])),
    ).build('any', dimension)
    search = IcPhdFilter(
        FilterSettings(births=births, particles=300, birth_particles=100, found_radius=0.5),
        bounds,
        generator,
    )
    total = 0
    for step in range(6):
        values = generator.normal(0.0, 4.0, (generator.integers(0, 4), dimension))
        total += len(values)
        pose = Pose.from_yaw(generator.uniform(-2.0, 12.0, 3), generator.normal())
        result = search.step([AgentMeasurement('any', pose, sensor, values)], 1, step)
        assert np.isfinite(result.expected_number)
        assert 0.0 <= result.expected_number <= total + 6.0 + 1e-9
        assert ((search.particles >= 0.0) & (search.particles <= 10.0)).all()
        assert np.isfinite(search.weights).all() and (search.weights >= 0.0).all()
        for cluster in result.clusters:
            assert np.isfinite(cluster.position).all()
            assert np.isfinite(cluster.covariance).all()
            assert cluster.mass > 0.0


def test_warm_up_leaves_nothing_to_compile():
    from maasi_filter.ic_phd import births, clusters, corrector

    warm_up()
    kernels = [
        value
        for module in (births, clusters, corrector)
        for value in vars(module).values()
        if hasattr(value, 'signatures')
    ]
    before = [len(kernel.signatures) for kernel in kernels]
    generator = np.random.default_rng(0)
    targets = generator.uniform(100.0, 160.0, (3, 3))
    visit(cube_search(), targets, flight(generator, 10, robots=2), generator)
    search = IcPhdFilter(FilterSettings(**FLOOR_LENGTHS), FLOOR, generator)
    for step in range(10):
        search.step([drone([[0.1, 0.3]], [1.0, 1.0, 1.0], sensor=floor_sensor())], 1, step)
    assert search.found_targets
    assert [len(kernel.signatures) for kernel in kernels] == before
    assert sum(before) >= 6


def test_the_target_is_of_the_robot_that_measured_it():
    """Both robots measure at each step; one of them sees the target."""
    near, far = [110.0] * 3, [150.0] * 3
    values = cube_sensor().measurement.measure([[114.0, 115.0, 112.0]], Pose(near))
    search = cube_search()
    for step in range(12):
        seen = drone(values, near, 'a', index=100 + step)
        search.step([seen, drone(values[:0], far, 'b', index=200 + step)], 1, float(step))
    (found,) = search.found_targets
    assert found.robot == 'a'
    assert 100 <= found.measurement < 112
