"""K-means presets: a found target is of the robot whose measurement completed it."""

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

BOUNDS = np.array([[0.0, 60.0]] * 2)
POSES = {'a': Pose([10.0, 10.0, 0.0]), 'b': Pose([50.0, 50.0, 0.0])}
NEAR = {'a': np.array([[12.0, 13.0]]), 'b': np.array([[48.0, 46.0]])}
# T_r is two deviations of the range where it is not given.
PRECISE = NoiseSettings(range=0.1, bearing=0.01)
COARSE = NoiseSettings(range=2.0, bearing=0.05)
SKEWED = NoiseSettings(range=0.1, bearing=0.4)


def sensor(noise):
    return SensorSettings(
        detection=DetectionSettings(kind='exponential', probability=0.95, size=[20.0, 20.0]),
        noise=noise,
    ).build('any', 2)


def make(**settings):
    return SearchFilter(
        FilterSettings(extraction='kmeans', removal='closest', removal_distance=5.0, **settings),
        BOUNDS,
        np.random.default_rng(1),
    )


def step(search, number, seen, noises):
    """Let both robots measure; those in `seen` detect the target that is near them."""
    measurements = []
    for name, pose in POSES.items():
        device = sensor(noises[name])
        values = device.measurement.measure(NEAR[name], pose)
        values = values if name in seen else values[:0]
        index = number + (100 if name == 'a' else 200)
        measurements.append(AgentMeasurement(name, pose, device, values, None, index))
    return search.step(measurements, 1, float(number))


@pytest.mark.parametrize('name', ['a', 'b'])
def test_the_target_is_of_the_robot_that_measured_it(name):
    """Both robots measure at each step, and one of them sees a target."""
    search = make()
    noises = {'a': PRECISE, 'b': PRECISE}
    for number in range(6):
        step(search, number, {name}, noises)
        if search.found_targets:
            break
    (found,) = search.found_targets
    assert np.linalg.norm(found.position - NEAR[name][0]) < 0.5
    assert found.robot == name
    assert found.measurement == number + (100 if name == 'a' else 200)


def test_the_radius_is_that_of_its_sensor():
    """What a knows is wider than its T_r of 0.2 m; that b's would be 4 m makes no difference."""
    search = make()
    for number in range(4):
        result = step(search, number, {'a'}, {'a': SKEWED, 'b': COARSE})
    assert 0.2 < min(cluster.radius for cluster in result.clusters) < 4.0
    assert search.found_targets == []
    # The same cloud measured by a robot with that T_r is found.
    search = make(found_radius=4.0)
    for number in range(4):
        step(search, number, {'a'}, {'a': SKEWED, 'b': COARSE})
    assert [target.robot for target in search.found_targets] == ['a']


def test_a_saved_state_knows_who_measured(tmp_path):
    """What a measured before the state was saved is still its own when it is found afterwards."""
    noises = {'a': PRECISE, 'b': PRECISE}
    search = make(found_radius=0.06)
    step(search, 0, {'a'}, noises)
    assert search.found_targets == []
    search.save(tmp_path / 'state')
    loaded = SearchFilter.load(tmp_path / 'state')
    assert loaded._credits == search._credits
    assert {credit.robot for credit in loaded._credits} == {'a'}
    for one in (search, loaded):
        for number in range(1, 12):
            step(one, number, {'a'}, noises)
    found = [[(t.robot, t.measurement) for t in one.found_targets] for one in (search, loaded)]
    assert found[0] == found[1]
    assert [robot for robot, _ in found[0]] == ['a']
