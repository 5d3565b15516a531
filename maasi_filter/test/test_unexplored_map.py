"""The exploration function: grid, update, interpolation and what is expected unseen."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from maasi_filter import BoxDetection, ExponentialDetection, Pose, UnexploredMap
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.unexplored_map import CELLS, MOST_CELLS, default_spacing, spacing_for

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


def boxed(x, y, **zones):
    return Area(EnvironmentSettings.model_validate({'bounds': [[0.0, x], [0.0, y]], **zones}))


def square(low, high):
    return {'polygon': [[low, low], [high, low], [high, high], [low, high]]}


def test_updates_within_the_reach_are_those_of_all_nodes_to_the_bit():
    rng, seen = np.random.default_rng(1), 0
    for case in range(60):
        dimension = 2 + case % 2
        low = rng.uniform(-30.0, 10.0, dimension)
        bounds = np.stack([low, low + rng.uniform(5.0, 60.0, dimension)], axis=1)
        exploration = UnexploredMap(bounds, rng.uniform(0.6, 4.0))
        expected = exploration.copy()
        sides = int(rng.integers(2, 4)) if dimension == 3 else 2
        lower, upper = -rng.uniform(0.0, 6.0, sides), rng.uniform(0.1, 6.0, sides)
        frame, edge = ('robot', 'world')[int(rng.integers(2))], rng.choice([0.0, 0.7])
        box = BoxDetection(lower, upper, rng.uniform(0.3, 1.0), frame, edge)
        for _ in range(12):
            place = rng.uniform(bounds[:, 0] - 4.0, bounds[:, 1] + 4.0)
            pose = Pose.from_yaw([*place, 7.0][:3], rng.uniform(-3.0, 3.0))
            exploration.update(box, pose)
            missed = 1.0 - box.probability(expected.nodes(), pose)
            expected.values[...] *= missed.reshape(expected.values.shape)
        assert (exploration.values == expected.values).all()
        seen += bool((expected.values < 1.0).any())
    assert seen > 50


def test_the_spacing_follows_the_swath_up_to_a_limit_of_cells():
    rng = np.random.default_rng(2)
    for _ in range(200):
        dimension = int(rng.integers(2, 4))
        size, swath = 10.0 ** rng.uniform(0.0, 5.0, dimension), 10.0 ** rng.uniform(-1.0, 2.0)
        bounds = np.stack([np.zeros(dimension), size], axis=1)
        spacing, coarse = spacing_for(bounds, swath)
        usual = default_spacing(bounds)
        assert spacing <= usual and coarse == (spacing > swath)
        assert size.prod() / spacing**dimension <= max(
            MOST_CELLS, CELLS[dimension] ** dimension
        ) * (1.0 + 1e-9)
        if usual <= swath / 3.0:
            assert spacing == usual
        elif size.prod() / (swath / 3.0) ** dimension <= MOST_CELLS:
            assert spacing == pytest.approx(swath / 3.0)
    assert spacing_for(BOUNDS, np.inf) == (default_spacing(BOUNDS), False)


def test_a_lane_through_a_large_area_counts_as_explored():
    """1,600 m with a swath of 16 m: with cells of 30 m nothing would be."""
    bounds = np.array([[0.0, 1600.0]] * 2)
    exploration = UnexploredMap(bounds, spacing_for(bounds, 16.0)[0])
    box = BoxDetection([-8.0, -8.0], [8.0, 8.0], 1.0)
    for y in (200.0, 411.0, 633.0, 1003.0, 1405.0):
        for x in np.arange(0.0, 1601.0, 4.0):
            exploration.update(box, Pose([x, y, 30.0]))
    assert exploration.explored_fraction() == pytest.approx(5 * 16.0 / 1600.0, rel=0.1)


def test_closed_ground_is_not_explored_ground():
    zones = [{'centre': [30.0, 20.0], 'radius': 9.0}, square(50.0, 60.0)]
    exploration = UnexploredMap(boxed(60.0, 60.0, keep_outs=zones[1:]), 0.5)
    assert exploration.explored_fraction() == exploration.closed_share() == 0.0
    values, whole = exploration.values, exploration.ground.sum()
    assert whole == pytest.approx(3500.0, rel=0.01)
    values[:, :41] = 0.0
    before = exploration.explored_fraction()
    assert before == pytest.approx(1200.0 / 3500.0, rel=0.02)
    exploration.adopt_area(boxed(60.0, 60.0, keep_outs=zones))
    hidden = 0.5 * np.pi * 81.0 / 3500.0
    # Half of the zone is explored; the other half is unseen below it.
    assert exploration.explored_fraction() == before
    assert exploration.closed_share() == pytest.approx(hidden, rel=0.05)
    volumes = exploration.cell_volumes()
    assert volumes[60, 40] == 0.0
    assert volumes.sum() == pytest.approx((1.0 - 2.0 * hidden) * 3500.0, rel=0.01)
    # All that is open gets explored.
    values[volumes > 0.0] = 0.0
    assert exploration.explored_fraction() == pytest.approx(1.0 - hidden, abs=0.005)
    exploration.adopt_area(boxed(60.0, 60.0, keep_outs=zones[1:]))
    assert exploration.explored_fraction() == pytest.approx(1.0 - hidden, abs=0.005)
    assert exploration.closed_share() == 0.0 and exploration.ground.sum() == whole
    # What was closed at the start counts from when it is opened.
    exploration.adopt_area(boxed(60.0, 60.0))
    assert exploration.ground.sum() == pytest.approx(3600.0, rel=0.002)
    left = hidden * 3500.0 + 100.0
    assert exploration.explored_fraction() == pytest.approx(1.0 - left / 3600.0, abs=0.005)
    copied = exploration.copy()
    assert copied.explored_fraction() == exploration.explored_fraction()


def test_closed_ground_with_a_prior_holds_its_share_of_the_targets():
    """Zones that come and go at random: shares of closed and open ground add up."""
    rng = np.random.default_rng(3)
    for _ in range(8):
        low = rng.uniform(0.0, 30.0)
        likely = square(low, low + rng.uniform(5.0, 30.0)) | {'weight': 5.0}
        prior = {'polygons': [likely], 'floor': float(rng.uniform(0.0, 0.5))}
        kept = [{'centre': rng.uniform(0.0, 60.0, 2).tolist(), 'radius': 8.0}]
        exploration = UnexploredMap(boxed(60.0, 60.0, prior=prior, keep_outs=kept), 0.75)
        ground = exploration.ground.copy()
        exploration.values[...] = rng.uniform(size=exploration.values.shape)
        unseen = (ground * exploration.values).sum() / ground.sum()
        for _ in range(4):
            zone = {'centre': rng.uniform(0.0, 60.0, 2).tolist(), 'radius': rng.uniform(2.0, 15.0)}
            exploration.adopt_area(boxed(60.0, 60.0, prior=prior, keep_outs=[*kept, zone]))
            assert exploration.explored_fraction() == pytest.approx(1.0 - unseen, abs=1e-12)
            away = np.hypot(*(np.array(exploration.nodes()) - zone['centre']).T)
            below = (away < zone['radius']).reshape(ground.shape)
            closed = (ground * exploration.values)[below].sum() / ground.sum()
            assert exploration.closed_share() == pytest.approx(closed, abs=0.01)
            inner = (away < zone['radius'] - 1.5).reshape(ground.shape)
            assert (exploration.cell_volumes()[inner] == 0.0).all()
        exploration.adopt_area(boxed(60.0, 60.0, prior=prior, keep_outs=kept))
        assert exploration.closed_share() == 0.0
        assert (exploration.ground == ground).all()


def test_a_fine_map_is_shown_in_blocks():
    exploration = UnexploredMap([[0.0, 200.0], [0.0, 100.0]], 0.25)
    exploration.values[:400] = 0.0
    lower, step, shown = exploration.shown()
    assert max(shown.shape) <= 300 and step == pytest.approx(3 * exploration.step)
    assert lower == pytest.approx(exploration.step)
    assert shown.mean() == pytest.approx(exploration.values.mean(), abs=0.01)
    assert shown[0, 0] == 0.0 and shown[-1, -1] == 1.0
    small = UnexploredMap([[0.0, 20.0], [0.0, 10.0]], 0.5)
    assert (small.shown()[2] == small.unseen()).all() and (small.shown()[1] == small.step).all()


def test_a_measurement_on_a_million_cells_changes_only_what_it_sees():
    area = boxed(6000.0, 6000.0)
    exploration = UnexploredMap(area, spacing_for(area.bounds, 16.0)[0])
    assert exploration.values.size > MOST_CELLS
    box = BoxDetection([-8.0, -8.0], [8.0, 8.0], 0.8)
    exploration.update(box, Pose([10.0, 10.0, 0.0]))
    for _ in range(1000):
        exploration.update(box, Pose([3000.0, 3000.0, 0.0]))
    seen = exploration.values < 1.0
    assert 0 < seen.sum() < 200
    assert 0.0 < exploration.explored_fraction() < 1e-4
    assert exploration.closed_share() == 0.0
