"""Scans of up to 1,000 detections: their time is bounded, and what is left out is said."""

import numpy as np
import pytest
from searches import PLANE, cube_sensor, measured, plane_sensor, play, same

from maasi_filter import AgentMeasurement, FilterSettings, Pose
from maasi_filter.make_filter import make_filter, warm_up
from maasi_filter.measurement_check import MOST_VALUES
from maasi_filter.pmb.association import MANY_PAIRS, associate, associate_pairs
from maasi_filter.pmb.component import gap, merge, moments
from maasi_filter.pmb.filter import MOST_POTENTIAL

SIZES = (1, 37, 300, MOST_VALUES)
KINDS = ('clutter', 'equal', 'around one', 'near', 'targets')


def scans_of(kind, number, dimension, generator, resolution=1.0):
    """Return two scans of a sensor that stands in the middle."""
    sensor = plane_sensor(range_noise=1.0, bearing=0.03) if dimension == 2 else cube_sensor()
    sensor.resolution = resolution
    pose = Pose([50.0, 50.0, 50.0])
    targets = generator.uniform(0.0, 100.0, (number, dimension))
    scans = []
    for step in range(2):
        low, high = [0.1, -3.0, -1.4][:dimension], [70.0, 3.0, 1.4][:dimension]
        values = generator.uniform(low, high, (number, dimension))
        if kind == 'equal':
            values[:] = values[0]
        elif kind == 'near':
            values[:, 0] *= 0.1
        elif kind != 'clutter':
            shown = targets if kind == 'targets' else np.repeat(targets[:1], number, axis=0)
            noise = generator.multivariate_normal(np.zeros(dimension), sensor.covariance, number)
            values = sensor.measurement.measure(shown, pose) + noise
            values[:, 0] = np.abs(values[:, 0])
        scans.append(AgentMeasurement('robot', pose, sensor, values, None, step))
    return scans


@pytest.fixture(scope='module', autouse=True)
def _compiled():
    warm_up()


@pytest.mark.parametrize('method', ['pmb', 'ic_phd'])
@pytest.mark.parametrize('dimension', [2, 3])
def test_a_scan_of_up_to_a_thousand_detections_is_processed(method, dimension):
    generator = np.random.default_rng(dimension)
    bounds = np.array([[0.0, 100.0]] * dimension)
    for number in SIZES:
        for kind in KINDS if number > 1 else KINDS[:1]:
            # The first size also without a resolution: nothing is merged before.
            resolution = 0.0 if kind == 'around one' else 1.0
            search = make_filter(FilterSettings(method=method), bounds, np.random.default_rng(0))
            for step, scan in enumerate(scans_of(kind, number, dimension, generator, resolution)):
                result = search.step([scan], 1, float(step))
                assert np.isfinite(result.expected_number), (number, kind, step)
                assert np.isfinite(search.particles).all()


@pytest.mark.parametrize('method', ['pmb', 'ic_phd'])
def test_larger_scans_and_numbers_that_are_none_are_refused(method):
    settings = FilterSettings(method=method)
    search, untouched = (
        play(
            make_filter(settings, PLANE, np.random.default_rng(0)),
            scans_of('targets', 5, 2, np.random.default_rng(1)),
        )
        for _ in range(2)
    )
    values = np.ones((MOST_VALUES + 1, 2))
    text = f'robot: values: got {MOST_VALUES + 1}, allowed are {MOST_VALUES}'
    with pytest.raises(ValueError, match=text):
        search.step([measured(plane_sensor(), (1.0, 1.0), values)], 1, 9.0)
    values = np.ones((MOST_VALUES, 2))
    values[777, 1] = np.nan
    with pytest.raises(ValueError, match='allowed are finite'):
        search.step([measured(plane_sensor(), (1.0, 1.0), values)], 1, 9.0)
    same(search, untouched)


def test_pairs_give_what_all_give():
    """Marginals of pairs are those of the whole table, also where the table is large."""
    generator = np.random.default_rng(4)
    for n, m, share in ((1, 1, 1.0), (6, 9, 0.5), (60, 40, 0.05), (250, 200, 0.01)):
        odds = generator.exponential(5.0, (n, m)) * (generator.random((n, m)) < share)
        other = generator.uniform(0.5, 2.0, m)
        psi = odds / other
        component, detection = np.nonzero(psi)
        pairs = associate_pairs(psi[component, detection], component, detection, (n, m))
        whole = associate(odds, other)
        assert (n * m > MANY_PAIRS) == (n == 250)
        for one, two in zip(pairs, whole):
            np.testing.assert_allclose(one, two, atol=1e-6)
        total = whole.missed + whole.caused.sum(axis=1)
        np.testing.assert_allclose(total, 1.0, atol=1e-9)


def test_potential_targets_that_are_left_out_are_named():
    generator = np.random.default_rng(5)
    settings = FilterSettings(method='pmb', pmb={'particles': 100})
    bounds = np.array([[0.0, 1000.0]] * 2)
    search = make_filter(settings, bounds, np.random.default_rng(0))
    sensor = plane_sensor(range_noise=0.5, bearing=0.01)
    warnings = {}
    for step in range(2):
        values = generator.uniform([1.0, -3.0], [70.0, 3.0], (MOST_VALUES, 2))
        pose = Pose([300.0 + 400.0 * step, 500.0, 0.0])
        result = search.step([AgentMeasurement('robot', pose, sensor, values)], 1, float(step))
        warnings |= result.misfits
    assert len(search.potential) <= MOST_POTENTIAL
    assert f'allowed are {MOST_POTENTIAL}' in warnings['potential targets']


def test_merging_is_that_of_all_pairs():
    """The heavier of two components of one position takes the existence of the other."""
    generator = np.random.default_rng(6)
    search = make_filter(FilterSettings(method='pmb'), PLANE, generator)
    for step, scan in enumerate(scans_of('near', 40, 2, generator, 0.0)):
        search.step([scan], 1, float(step))
    items = list(search.potential)
    before = [item.existence for item in items]
    _, _, radii = moments(items)
    merged = merge(list(items))
    assert sum(item.existence for item in merged) == pytest.approx(sum(before))
    assert np.isfinite(radii).all()
    for i, one in enumerate(merged):
        for other in merged[:i]:
            apart = gap(one, other) >= 6.0
            assert apart or one.scan == other.scan or one.existence + other.existence > 1.0
