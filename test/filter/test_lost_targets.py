"""Targets that were detected and lost: they stay potential ones until they are found."""

import math

import numpy as np
import pytest
from searches import CUBE, cube_sensor

from maasi_filter import (
    AgentMeasurement,
    Exploration,
    ExponentialDetection,
    FilterSettings,
    Pose,
    RangeBearing,
    SearchFilter,
)
from maasi_filter.ic_phd.births import LEAST_UNEXPLORED
from maasi_filter.ic_phd.unconfirmed_targets import MOST_DETECTIONS, LostTargets
from maasi_filter.models.measurement_set import prepare_measurements

FLOOR = np.array([[0.0, 100.0]] * 2)
DETECTION = ExponentialDetection(0.9, [20.0, 20.0])
NOISE = np.diag([2.0, 0.02])
NOBODY = np.zeros((0, 2)), np.zeros((0, 2, 2))


def lost_targets():
    return LostTargets(2, 5.0 / 1e4, 0.01)


def see(lost, exploration, target, sensor):
    """Detect a target without noise; return the detection (2,)."""
    pose = Pose([*sensor, 0.0])
    values = RangeBearing().measure(np.array([target]), pose)
    seen = prepare_measurements(values, NOISE[None], pose)
    lost.add(seen, np.ones(1, bool), pose, DETECTION, 0.0)
    exploration.update(DETECTION, pose)
    return values[0]


def fly_by(exploration, places):
    for place in places:
        exploration.update(DETECTION, Pose([*place, 0.0]))


def test_mass_and_place_are_those_of_a_target_seen_there_and_missed_elsewhere():
    """By quadrature over a fine grid: e of the other measurements times the likelihood."""
    exploration = Exploration(FLOOR, 1.0)
    fly_by(exploration, [(60.0, 30.0), (70.0, 60.0)])
    others = exploration.copy()
    lost = lost_targets()
    pose = Pose([40.0, 30.0, 0.0])
    z = see(lost, exploration, [62.0, 40.0], pose.position[:2])
    found = np.array([[69.0, 35.0]])
    spread = np.array([[[1.0, 0.2], [0.2, 2.0]]])
    (cluster,) = lost.clusters(found, spread, exploration, 1.0)

    axis = np.arange(0.25, 100.0, 0.5)
    grid = np.stack(np.meshgrid(axis, axis, indexing='ij'), -1).reshape(-1, 2)
    model = RangeBearing()
    density = np.exp(model.log_density(z, grid, pose, NOISE)) * 0.25
    chance = float(DETECTION.probability(model.inverse(z[None], pose), pose)[0])
    born = 5.0 / 1e4 * chance * others.at(grid) * density
    jacobian = model.jacobian(found, pose)[0]
    innovation = NOISE + jacobian @ spread[0] @ jacobian.T
    gap = model.residual(z, model.measure(found, pose)[0])
    known = math.exp(-0.5 * gap @ np.linalg.solve(innovation, gap)) / math.sqrt(
        np.linalg.det(2.0 * math.pi * innovation)
    )
    known *= chance / (1.0 - chance)
    false = 5.0 / 1e4 * chance * density.sum() * LEAST_UNEXPLORED
    # What the detection's own measurement left unseen is taken at its centre.
    assert cluster.mass == pytest.approx(born.sum() / (born.sum() + known + false), rel=0.05)
    mean = born @ grid / born.sum()
    np.testing.assert_allclose(cluster.position, mean, atol=0.5)
    offset = grid - mean
    covariance = (born[:, None] * offset).T @ offset / born.sum()
    np.testing.assert_allclose(cluster.covariance, covariance, atol=0.15 * np.trace(covariance))


def test_what_found_targets_explain_is_forgotten():
    exploration = Exploration(FLOOR, 5.0)
    lost = lost_targets()
    for sensor in ((40.0, 30.0), (70.0, 40.0), (60.0, 60.0)):
        see(lost, exploration, [62.0, 40.0], sensor)
    (cluster,) = lost.clusters(*NOBODY, exploration, 1.0)
    assert cluster.mass == 1.0
    assert np.linalg.norm(cluster.position - [62.0, 40.0]) < 3.0
    found = np.array([[62.5, 40.0]]), 0.5 * np.eye(2)[None]
    fly_by(exploration, [(60.0, 40.0), (64.0, 40.0)])
    assert lost.clusters(*found, exploration, 1.0) == []
    assert len(lost) == 0


def test_second_of_two_targets_seen_at_once_is_not_explained_by_the_first():
    exploration = Exploration(FLOOR, 5.0)
    lost = lost_targets()
    pose = Pose([40.0, 30.0, 0.0])
    targets = np.array([[62.0, 40.0], [62.0, 44.0]])
    seen = prepare_measurements(RangeBearing().measure(targets, pose), np.stack([NOISE] * 2), pose)
    lost.add(seen, np.ones(2, bool), pose, DETECTION, 0.0)
    found = targets[:1], 0.1 * np.eye(2)[None]
    (cluster,) = lost.clusters(*found, exploration, 1.0)
    assert cluster.mass > 0.7
    assert abs(cluster.position[1] - 44.0) < abs(cluster.position[1] - 40.0)


def test_detection_that_nothing_comes_of_is_given_up():
    exploration = Exploration(FLOOR, 5.0)
    lost = lost_targets()
    see(lost, exploration, [62.0, 40.0], [40.0, 30.0])
    around = [(55.0 + 5.0 * i, 30.0 + 5.0 * j) for i in range(4) for j in range(5)]
    fly_by(exploration, around[::3])
    assert lost.clusters(*NOBODY, exploration, 1.0)[0].mass > 0.9
    for _ in range(2):
        fly_by(exploration, around)
    assert lost.clusters(*NOBODY, exploration, 1.0) == []
    assert len(lost) == 0


def test_a_target_that_the_intensity_lost_stays_a_potential_one_until_it_is_found():
    """Seen from afar, then missed until the particles have forgotten it."""
    search = SearchFilter(FilterSettings(), CUBE, np.random.default_rng(0))
    sensor = cube_sensor()
    target = np.array([[180.0, 130.0, 120.0]])

    def measure(step, position, sees):
        pose = Pose(position)
        values = sensor.measurement.measure(target, pose) if sees else np.zeros((0, 3))
        return search.step([AgentMeasurement('drone', pose, sensor, values, None, step)], 1, step)

    far = [[100.0 + 2.0 * step, 90.0, 100.0] for step in range(40)]
    measure(0, far[0], True)
    for step in range(1, 40):
        clusters = measure(step, far[step], False).clusters
        assert clusters
    assert search.expected_number < 0.1
    assert clusters[0].mass > 0.8
    assert np.linalg.norm(clusters[0].position - target[0]) < 3.0 * clusters[0].radius
    noise = np.random.default_rng(1)
    for step in range(40, 60):
        result = measure(step, target[0] + noise.uniform(-15.0, 15.0, 3), True)
    assert len(search.found_targets) == 1
    assert result.clusters == []


def test_detections_do_not_pile_up_while_there_are_potential_targets():
    search = SearchFilter(FilterSettings(), CUBE, np.random.default_rng(0))
    sensor = cube_sensor()
    noise = np.random.default_rng(1)
    targets = np.array([[130.0, 130.0, 100.0], [30.0, 30.0, 30.0]])
    far = sensor.measurement.measure(targets[1:], Pose([130.0, 130.0, 130.0]))
    for step in range(600):
        pose = Pose(targets[0] + noise.uniform(-20.0, 20.0, 3))
        values = sensor.measurement.measure(targets[:1], pose)
        # The other one is seen now and then, so that it is a potential target all the time.
        if step % 5 == 0:
            pose = Pose([130.0, 130.0, 130.0])
            values = far
        search.step([AgentMeasurement('drone', pose, sensor, values, None, step)], 1, step)
    assert len(search._lost) < 500


def test_where_too_many_detections_wait_the_oldest_are_forgotten():
    exploration = Exploration(FLOOR, 5.0)
    lost = lost_targets()
    places = np.random.default_rng(0).uniform(5.0, 95.0, (MOST_DETECTIONS + 40, 2))
    for place in places:
        pose = Pose([*(place - [3.0, 0.0]), 0.0])
        values = RangeBearing().measure(place[None], pose)
        seen = prepare_measurements(values, NOISE[None], pose)
        lost.add(seen, np.ones(1, bool), pose, DETECTION, 0.0)
    before = lost.arrays()
    assert len(lost.clusters(*NOBODY, exploration, 1.0)) > 10
    after = lost.arrays()
    assert len(after['lost_values']) == MOST_DETECTIONS
    np.testing.assert_array_equal(after['lost_values'], before['lost_values'][40:])
    np.testing.assert_array_equal(after['lost_positions'], before['lost_positions'][40:])


def test_of_a_scan_with_too_many_detections_some_are_looked_at():
    exploration = Exploration(FLOOR, 5.0)
    lost = lost_targets()
    pose = Pose([50.0, 50.0, 0.0])
    targets = np.random.default_rng(0).uniform(5.0, 95.0, (1000, 2))
    values = RangeBearing().measure(targets, pose)
    seen = prepare_measurements(values, np.stack([NOISE] * 1000), pose)
    lost.add(seen, np.ones(1000, bool), pose, DETECTION, 0.0)
    assert lost.clusters(*NOBODY, exploration, 1.0)
    assert len(lost.arrays()['lost_values']) <= MOST_DETECTIONS
