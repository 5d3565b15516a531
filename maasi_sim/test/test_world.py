"""Bounds, targets, obstacles and noise streams."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.distance import pdist

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_sim.simulation.world import TargetSettings, World, noise_stream

FLOOR = {'bounds': [[-0.3, 2.4], [-0.3, 2.4]]}
CUBE = {'bounds': [[0, 260], [0, 260], [0, 260]]}


def world(environment, seed=1, **targets):
    return World.from_settings(
        EnvironmentSettings.model_validate(environment), TargetSettings(**targets), seed
    )


@pytest.mark.parametrize('environment', [FLOOR, CUBE])
@pytest.mark.parametrize('distribution', ['uniform', 'clustered'])
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_drawn_targets_keep_separation_and_margin(environment, distribution, seed):
    scale = np.ptp(environment['bounds'][0])
    separation, margin = 0.05 * scale, 0.04 * scale
    kept = {'separation': separation, 'margin': margin}
    built = world(environment, seed, count=12, distribution=distribution, **kept)
    assert built.targets.shape == (12, len(environment['bounds']))
    assert pdist(built.targets).min() >= separation
    assert (built.targets >= built.bounds[:, 0] + margin).all()
    assert (built.targets <= built.bounds[:, 1] - margin).all()


def test_clustered_targets_are_closer_than_uniform_ones():
    spread = [
        np.median(pdist(world(CUBE, seed, count=30, distribution=kind, clusters=1).targets))
        for kind in ('clustered', 'uniform')
        for seed in range(3)
    ]
    assert max(spread[:3]) < min(spread[3:])


def test_no_target_lies_in_an_obstacle():
    environment = FLOOR | {'obstacles': [{'centre': [1.0, 1.0], 'radius': 0.8}]}
    built = world(environment, count=40, margin=0.1)
    assert np.linalg.norm(built.targets - 1.0, axis=1).min() >= 0.9
    assert built.area.solid[:, 3].tolist() == [0.8]


def test_given_positions_are_taken():
    built = world(FLOOR, positions=[[0.5, 0.6], [1.0, 2.0]])
    assert_array_equal(built.targets, [[0.5, 0.6], [1.0, 2.0]])
    assert_array_equal(built.targets_3d_at(0), [[0.5, 0.6, 0.0], [1.0, 2.0, 0.0]])
    assert world(FLOOR, count=0).targets.shape == (0, 2)
    assert world(FLOOR, positions=[]).targets_3d_at(0).shape == (0, 3)


@pytest.mark.parametrize(
    ('targets', 'message'),
    [
        ({'positions': [[0.5, 0.6, 0.7]]}, r'targets.positions\[0\]: got 3 coordinates'),
        ({'positions': [[0.5, 0.6], [0.5]]}, r'targets.positions\[1\]: got 1 coordinates'),
        ({'positions': [[0.5, 2.6]]}, r'targets.positions\[0\]: got .* the bounds'),
        ({'count': 3, 'margin': 1.5}, 'targets.margin: got 1.5, allowed at most half'),
        ({'count': 30, 'separation': 1.0}, 'targets: got count 30 .* do not fit'),
    ],
)
def test_targets_that_do_not_fit_are_refused(targets, message):
    with pytest.raises(ValueError, match=message):
        world(FLOOR, **targets)


def test_noise_streams_are_keyed_by_each_part():
    one = (1, 'a', 2, 'x')
    for other in ((2, 'a', 2, 'x'), (1, 'b', 2, 'x'), (1, 'a', 3, 'x'), (1, 'a', 2, 'y')):
        draws = [noise_stream(*key).random(4) for key in (one, one, other)]
        assert_array_equal(draws[0], draws[1])
        assert not np.isclose(draws[0], draws[2]).any()
