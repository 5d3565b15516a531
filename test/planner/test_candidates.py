"""Candidate sets, and the parts that nothing can be seen of."""

from __future__ import annotations

import numpy as np
import pytest

from maasi_filter.models.detection import BoxDetection
from maasi_filter.models.sensor import Sensor
from maasi_planner import CandidateSet, CandidateSettings, Viewer, unseen_parts
from maasi_planner.candidates import Unseen

FLOOR = np.array([[-0.3, 2.4], [-0.3, 2.4]])
CUBE = np.array([[0.0, 260.0]] * 3)


def test_grid_of_the_papers():
    points = CandidateSet(
        CandidateSettings(grid=[3, 3, 3], spacing=80.0, corner=[10.0, 10.0, 10.0]), CUBE
    ).at([0.0, 0.0, 0.0])
    assert points.shape == (27, 3)
    assert points[0].tolist() == [10.0, 10.0, 10.0]
    assert points[-1].tolist() == [170.0, 170.0, 170.0]


def test_grid_is_centred_without_corner():
    points = CandidateSet(CandidateSettings(grid=[2, 3], spacing=[1.0, 0.5]), FLOOR, 1.0).at(
        [0, 0, 0]
    )
    assert points.mean(axis=0) == pytest.approx([1.05, 1.05, 1.0])
    assert sorted(set(np.round(points[:, 0], 6))) == [0.55, 1.55]


@pytest.mark.parametrize(('ring', 'number'), [(4, 4), (6, 6), (8, 8)])
def test_ring_around_the_robot(ring, number):
    candidates = CandidateSet(CandidateSettings(ring=ring, distance=12.0), CUBE)
    here = np.array([100.0, 50.0, 70.0])
    points = candidates.at(here)
    assert len(points) == number
    assert np.sqrt(((points - here) ** 2).sum(axis=1)) == pytest.approx(12.0)
    # In a corner what would lie outside is left out.
    assert len(candidates.at([1.0, 1.0, 1.0])) == {4: 2, 6: 3, 8: 3}[ring]


def test_list():
    points = CandidateSet(CandidateSettings(points=[[0.0, 1.0], [2.0, 0.5]]), FLOOR, 0.7).at(
        [0, 0, 0]
    )
    assert points.tolist() == [[0.0, 1.0, 0.7], [2.0, 0.5, 0.7]]


@pytest.mark.parametrize(
    ('settings', 'word'),
    [
        ({}, 'one'),
        ({'grid': [3, 3], 'ring': 4}, 'one'),
        ({'grid': [3, 3]}, 'spacing'),
        ({'grid': [0, 3], 'spacing': 1.0}, 'grid'),
        ({'grid': [3, 3], 'spacing': [1.0]}, 'spacing'),
        ({'grid': [3, 3], 'spacing': -1.0}, 'spacing'),
        ({'grid': [3, 3], 'spacing': 1.0, 'corner': [0.0, float('nan')]}, 'finite'),
        ({'ring': 5, 'distance': 1.0}, 'ring'),
        ({'ring': 4}, 'distance'),
        ({'points': []}, 'points'),
        ({'points': [[1.0]]}, 'points'),
        ({'gird': [3, 3]}, 'gird'),
    ],
)
def test_bad_settings_are_refused(settings, word):
    with pytest.raises(ValueError, match=word):
        CandidateSettings(**settings)


def test_impossible_grid_is_refused():
    with pytest.raises(ValueError, match='inside'):
        CandidateSet(CandidateSettings(grid=[9, 9], spacing=1.0, corner=[0.0, 0.0]), FLOOR)
    with pytest.raises(ValueError, match='grid'):
        CandidateSet(CandidateSettings(grid=[3, 3, 3], spacing=0.5), FLOOR)
    with pytest.raises(ValueError, match='ring'):
        CandidateSet(CandidateSettings(ring=6, distance=0.5), FLOOR)


def test_grids_of_the_paper_leave_parts_unseen():
    """000, section 5.2: 3 x 3 with spacing 0.6 from 0.1 sees 0.1 - 0.2 to 1.3 + 0.2 at most."""
    sensor = Sensor.ranging('m', BoxDetection([-0.2, -0.2], [0.2, 0.2]), np.diag([0.01, 0.01]))
    candidates = CandidateSet(
        CandidateSettings(grid=[3, 3], spacing=0.6, corner=[0.1, 0.1]), FLOOR, 1.0
    )
    start = np.array([1.9, 1.9, 1.0])
    unseen = unseen_parts(FLOOR, [Viewer(candidates.at(start), start, sensor, 0.05, 0.0)])
    assert 0.3 < unseen.fraction < 0.6
    assert 'can never be seen' in unseen.describe()
    text = unseen_parts(FLOOR, [Viewer(candidates.at(start), start, sensor, 0.05, 0.0)]).describe()
    assert text == unseen.describe()
    low, high = unseen.boxes[0][0]
    assert low == pytest.approx(-0.3, abs=0.03)
    assert high == pytest.approx(2.4, abs=0.03)


@pytest.mark.parametrize(
    ('share', 'text'),
    [(0.996, '100 %'), (0.25, '25 %'), (0.0316, '3.2 %'), (1e-5, 'less than 0.01 %')],
)
def test_shares_are_said_in_plain_numbers(share, text):
    unseen = Unseen(share, [np.array([[0.0, 1.0], [0.0, 1.0]])])
    assert unseen.describe().startswith(f'{text} of the environment can never be seen')
