"""Candidate sets, and the parts that nothing can be seen of."""

import numpy as np
import pytest

from maasi_filter.models.detection import BoxDetection, ExponentialDetection, GaussianDetection
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.unexplored_map import default_spacing
from maasi_planner import CandidateSet, CandidateSettings, Viewer, unseen_parts
from maasi_planner.candidates import map_spacing, swath_of
from maasi_sim.scenario.loading import load_scenario

FLOOR = np.array([[-0.3, 2.4], [-0.3, 2.4]])
CUBE = np.array([[0.0, 260.0]] * 3)
ORIGIN = np.zeros(3)


PAPER_GRID = {'grid': [3, 3, 3], 'spacing': 80.0, 'corner': [10.0, 10.0, 10.0]}
CENTRED = {'grid': [2, 3], 'spacing': [1.0, 0.5]}
ON_BOUNDS = {'points': [[-0.3, 1.0], [2.4 + 1e-12, 0.5]]}  # up to rounding


@pytest.mark.parametrize(
    ('settings', 'bounds', 'height', 'number', 'first', 'last'),
    [
        (PAPER_GRID, CUBE, 0.0, 27, [10.0] * 3, [170.0] * 3),
        (CENTRED, FLOOR, 1.0, 6, [0.55, 0.55, 1.0], [1.55, 1.55, 1.0]),
        (ON_BOUNDS, FLOOR, 0.7, 2, [-0.3, 1, 0.7], [2.4, 0.5, 0.7]),
    ],
)
def test_grids_and_lists(settings, bounds, height, number, first, last):
    points = CandidateSet(CandidateSettings(**settings), bounds, height).at(ORIGIN)
    assert points.shape == (number, 3)
    assert points[[0, -1]] == pytest.approx(np.array([first, last]))


@pytest.mark.parametrize(('ring', 'in_corner'), [(4, 2), (6, 3), (8, 3)])
def test_ring_around_the_robot(ring, in_corner):
    candidates = CandidateSet(CandidateSettings(ring=ring, distance=12.0), CUBE)
    here = np.array([100.0, 50.0, 70.0])
    points = candidates.at(here)
    assert len(points) == len(np.unique(points, axis=0)) == ring
    assert np.sqrt(((points - here) ** 2).sum(axis=1)) == pytest.approx(12.0)
    # In a corner what would lie outside is left out.
    assert len(candidates.at([1.0, 1.0, 1.0])) == in_corner


@pytest.mark.parametrize(
    ('settings', 'word'),
    [
        ({}, 'one'),
        ({'grid': [3, 3], 'ring': 4}, 'one'),
        ({'grid': [3, 3]}, 'spacing'),
        ({'grid': [3, 3], 'spacing': [1.0]}, 'spacing'),
        ({'grid': [3, 3], 'spacing': 1.0, 'corner': [0.0, float('nan')]}, 'finite'),
        ({'ring': 5, 'distance': 1.0}, 'ring'),
        ({'ring': 4}, 'distance'),
        # Not on this floor.
        ({'grid': [9, 9], 'spacing': 1.0, 'corner': [0.0, 0.0]}, 'inside'),
        ({'grid': [3, 3, 3], 'spacing': 0.5}, 'grid'),
        ({'ring': 6, 'distance': 0.5}, 'ring'),
    ],
)
def test_bad_settings_are_refused(settings, word):
    with pytest.raises(ValueError, match=word):
        CandidateSet(CandidateSettings(**settings), FLOOR)


def test_grids_of_the_paper_leave_parts_unseen():
    """000, section 5.2: 3 x 3 with spacing 0.6 from 0.1 sees 0.1 - 0.2 to 1.3 + 0.2 at most."""
    sensor = Sensor('m', BoxDetection([-0.2, -0.2], [0.2, 0.2]), np.diag([0.01, 0.01]))
    settings = CandidateSettings(grid=[3, 3], spacing=0.6, corner=[0.1, 0.1])
    start = np.array([1.9, 1.9, 1.0])
    viewer = Viewer(CandidateSet(settings, FLOOR, 1.0).at(start), start, sensor, 0.05, 0.0)
    unseen = unseen_parts(FLOOR, [viewer])
    assert 0.3 < unseen.fraction < 0.6
    assert 'can never be seen' in unseen.describe()
    assert unseen.boxes[0][0] == pytest.approx([-0.3, 2.4], abs=0.03)


@pytest.mark.parametrize(
    ('detection', 'swath'),
    [
        (BoxDetection([-8.0, -3.0], [8.0, 5.0]), 8.0),
        (ExponentialDetection(0.9, [10.0, 10.0]), 4.0 * np.log(2.0) * 10.0),
        (GaussianDetection(0.9, [10.0, 4.0]), 2.0 * np.sqrt(2.0 * np.log(2.0)) * 4.0),
    ],
)
def test_the_swath_is_as_wide_as_half_of_the_best_detection(detection, swath):
    sensor = Sensor('m', detection, np.diag([0.01, 0.01]))
    assert swath_of(sensor) == pytest.approx(swath)
    if not isinstance(detection, BoxDetection):
        edge = [[0.0, 0.5 * swath], [0.0, 0.0]]
        half, best = detection.probability(edge, Pose(ORIGIN))
        assert half == pytest.approx(0.5 * best)


def test_a_map_that_is_coarser_than_the_swath_is_warned_about():
    sensors = [
        Sensor('m', BoxDetection([-half] * 2, [half] * 2), np.diag([0.01, 0.01]))
        for half in (8.0, 30.0)
    ]
    for size, spacing in ((600.0, 16.0 / 3.0), (200.0, 200.0 / 54.0), (6000.0, 6.0)):
        assert map_spacing(np.array([[0.0, size]] * 2), sensors) == (pytest.approx(spacing), '')
    spacing, warning = map_spacing(np.array([[0.0, 1e5]] * 2), sensors)
    assert spacing == pytest.approx(100.0)
    assert 'cells of 100 m' in warning and 'a swath of only 16 m' in warning


@pytest.mark.parametrize(
    'name', ['drone_rov', 'field', 'field_batteries', 'mambo_turtlebot', 'ranging_pair_3d']
)
def test_maps_of_the_scenarios_are_as_fine_as_before(name):
    scenario = load_scenario(name)
    bounds = scenario.environment.array()
    sensors = [
        robot.sensor.build(key, scenario.dimension) for key, robot in scenario.robots.items()
    ]
    assert map_spacing(bounds, sensors) == (default_spacing(bounds), '')
