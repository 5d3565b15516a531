"""What is true apart from what is believed: sensors, odometry, targets that walk."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from maasi_filter.geometry.area import Area
from maasi_filter.models.pose import Pose
from maasi_filter.settings import SensorSettings
from maasi_planner.motion import RobotState
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.scenario.schema import SimulatedSettings
from maasi_sim.search import search
from maasi_sim.simulation.odometry import OdometryModel, OdometrySettings
from maasi_sim.simulation.robots import Simulation
from maasi_sim.simulation.sensors import RangingSensor
from maasi_sim.simulation.world import World

CUBE = np.array([[0.0, 260.0]] * 3)
POSE = Pose.from_yaw([100.0, 120.0, 80.0], 0.4)


def true_sensor(**values):
    return SimulatedSettings(**values).sensor(SensorSettings(), 'drone', CUBE)


def test_what_is_true_is_what_is_believed_unless_it_is_given():
    believed, same = SensorSettings().build('drone', 3), true_sensor()
    true = true_sensor(noise_factor=1.5, probability_factor=0.7)
    assert_array_equal(same.covariance, believed.covariance)
    assert_allclose(true.covariance, 2.25 * believed.covariance)
    assert same.clutter == believed.clutter
    place = POSE.position[None] + 5.0
    probability = believed.detection.probability(place, POSE)
    assert_array_equal(same.detection.probability(place, POSE), probability)
    assert_allclose(true.detection.probability(place, POSE), 0.7 * probability)
    given = true_sensor(noise={'range': 0.3, 'bearing': 0.1, 'elevation': 0.2})
    assert_allclose(np.diagonal(given.covariance), [0.09, 0.01, 0.04])
    assert true_sensor(probability_factor=50.0).detection.gain == 1.0
    # Clutter is sampled at the configured rate.
    cluttered = true_sensor(clutter_per_scan=2.5)
    played = RangingSensor(cluttered, np.zeros((0, 3)), 3, 'drone', CUBE)
    counts = [len(played.measure(POSE, step)[0]) for step in range(2000)]
    assert_allclose(np.mean(counts), 2.5, atol=0.12)
    played.sensor = true_sensor(clutter_per_scan=2.5, clutter_in='area')
    scans = [played.measure(POSE, step)[0] for step in range(2000)]
    positions = played.sensor.measurement.inverse(np.concatenate(scans), POSE)
    assert_allclose(len(positions) / 2000, 2.5, atol=0.12)
    # Uniform: a mean of 5,000 within four standard errors of the centre.
    side = CUBE[:, 1] - CUBE[:, 0]
    error = 4.0 * side / np.sqrt(12.0 * len(positions))
    assert (np.abs(positions.mean(axis=0) - CUBE.mean(axis=1)) < error).all()


def test_odometry_reports_other_errors_than_it_has():
    true = OdometrySettings(position_noise=0.5, position_drift=0.1)
    reported = OdometrySettings(position_noise=0.01, heading_noise=0.0)
    start = Pose.from_yaw([10.0, 10.0, 5.0], 0.0)
    errors = []
    for seed in range(300):
        model = OdometryModel(true, start, seed, 'drone', reported)
        reading = model.step(RobotState(Pose([26.0, 10.0, 5.0])), 1)
        errors.append(reading.pose.position - [16.0, 0.0, 0.0])
    assert_allclose(np.std(errors, axis=0), [0.64, 0.64, 0.5], rtol=0.15)
    assert_allclose(np.diagonal(reading.covariance)[:3], 1e-4, rtol=1e-6)


def test_constant_offset_has_its_length_and_is_reported():
    settings = OdometrySettings(position_noise=0.0, heading_noise=0.0, position_offset=2.0)
    start = Pose.from_yaw([10.0, 10.0, 5.0], 0.0)
    directions = []
    for seed in range(20):
        model = OdometryModel(settings, start, seed, 'drone')
        first = model.step(RobotState(start), 1).pose.position
        last = model.step(RobotState(Pose([50.0, 10.0, 5.0])), 2)
        assert_allclose(np.linalg.norm(first), 2.0)
        assert_allclose(last.pose.position - [40.0, 0.0, 0.0], first, atol=1e-12)
        assert_allclose(np.diagonal(last.covariance)[:3], 4.0 / 3.0)
        directions.append(first / 2.0)
    assert np.linalg.norm(np.mean(directions, axis=0)) < 0.5


def test_targets_walk_reproducibly_at_the_configured_speed_and_stay_inside():
    inner = np.random.default_rng(0).uniform(100.0, 160.0, (400, 3))
    first, again = (World(Area(CUBE), inner, walk=0.5, seed=4).targets_at(100) for _ in range(2))
    assert_allclose(np.std(first - inner), 5.0, rtol=0.05)
    assert_array_equal(again, first)
    small = World(Area([[0.0, 3.0]] * 3), np.full((50, 3), 1.5), walk=0.5, seed=4)
    places = small.targets_at(200)
    assert ((places >= 0.0) & (places <= 3.0)).all()


def test_a_scenario_plays_it_in_the_simulation_that_nodes_use_and_in_the_search():
    true = {'noise_factor': 2.0, 'odometry': {'position_offset': 3.0}}
    changes = {('robots', 'drone', 'simulated'): true, ('targets', 'walk'): 0.3}
    changed = load_scenario('ranging_drone_3d', {f'--set {k}': (k, v) for k, v in changes.items()})
    simulation = Simulation(changed, 1)
    believed = changed.robots['drone'].sensor.build('drone', 3)
    body = simulation.robots['drone']
    assert_allclose(body.ranging.sensor.covariance, 4.0 * believed.covariance)
    assert np.linalg.norm(body.odometry.pose.position) > 2.5
    assert simulation.world.walk == pytest.approx(0.3 * changed.step**0.5)
    # Targets are counted where they are in the end.
    result = search(changed, 1, 5)
    assert_array_equal(result.truth, changed.world(1).targets_at(result.steps - 1))
