"""The exploration function: grid, update, interpolation and what is expected unseen."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from maasi_filter import ExponentialDetection, Pose, UnexploredMap

BOUNDS = np.array([[0.0, 100.0], [-20.0, 50.0], [0.0, 30.0]])
MODEL = ExponentialDetection(0.98, [25.0, 25.0, 25.0])


def test_nodes_stand_on_both_bounds():
    exploration = UnexploredMap(BOUNDS, 12.0)
    for axis, bounds in zip(exploration.axes(), BOUNDS):
        assert axis[0] == bounds[0]
        assert axis[-1] == pytest.approx(bounds[1])
        assert np.diff(axis).max() <= 12.0 + 1e-9
    assert exploration.values.shape == (10, 7, 4)
    assert (exploration.values == 1.0).all()
    assert exploration.cell_volumes().sum() == pytest.approx(100.0 * 70.0 * 30.0)


def test_update_is_equation_20_at_every_node():
    exploration = UnexploredMap(BOUNDS, 12.0)
    poses = [Pose([10.0, 10.0, 10.0]), Pose([90.0, 0.0, 5.0])]
    expected = np.ones(len(exploration.nodes()))
    for pose in poses:
        exploration.update(MODEL, pose)
        expected *= 1.0 - MODEL.probability(exploration.nodes(), pose)
    np.testing.assert_allclose(exploration.values.ravel(), expected, rtol=1e-12)


@pytest.mark.parametrize('dimension', [2, 3])
def test_interpolation_is_multilinear_and_clamped(dimension):
    generator = np.random.default_rng(0)
    exploration = UnexploredMap(BOUNDS[:dimension], 9.0)
    exploration.values[...] = generator.random(exploration.values.shape)
    reference = RegularGridInterpolator(exploration.axes(), exploration.values)
    positions = generator.uniform(-50.0, 150.0, (300, dimension))
    inside = np.clip(positions, BOUNDS[:dimension, 0], BOUNDS[:dimension, 1])
    np.testing.assert_allclose(exploration.at(positions), reference(inside), atol=1e-12)


def test_diffusion_spreads_a_peak_by_its_variance():
    exploration = UnexploredMap([[0.0, 100.0]] * 2, 1.0)
    exploration.values[...] = 0.0
    exploration.values[50, 50] = 1.0
    exploration.diffuse(4.0)
    squares = (exploration.axes()[0] - 50.0) ** 2
    assert squares @ exploration.values.sum(axis=1) == pytest.approx(4.0)
    assert exploration.values.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ('make', 'word'),
    [
        (lambda: UnexploredMap([[0.0, 1.0]], 0.1), 'bounds'),
        (lambda: UnexploredMap([[1.0, 0.0], [0.0, 1.0]], 0.1), 'bounds'),
        (lambda: UnexploredMap([[0.0, np.nan], [0.0, 1.0]], 0.1), 'bounds'),
        (lambda: UnexploredMap([[0.0, 1.0], [0.0, 1.0]], 0.0), 'spacing'),
        (lambda: UnexploredMap([[0.0, 1e6], [0.0, 1e6]], 0.1), 'nodes'),
        (lambda: UnexploredMap(BOUNDS, 12.0).at([[0.0, np.nan, 0.0]]), 'finite'),
    ],
)
def test_bad_grids_and_positions_are_refused(make, word):
    with pytest.raises(ValueError, match=word):
        make()
