"""What a hill hides is neither searched nor missed."""

import numpy as np
import pytest

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.make_filter import make_filter
from maasi_filter.models.detection import BoxDetection, ExponentialDetection
from maasi_filter.models.line_of_sight import probability_in_sight
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import AgentMeasurement
from maasi_filter.settings import FilterSettings
from maasi_filter.unexplored_map import UnexploredMap

BEHIND = np.array([[30.0, 0.0]])


def ridge(tmp_path, height=20.0):
    """Return an area with a ridge along x = 0, 40 m wide at its foot."""
    x = np.arange(-50.0, 51.0, 2.0)
    row = ' '.join(f'{value:.3f}' for value in np.maximum(height * (1.0 - abs(x) / 20.0), 0.0))
    head = 'ncols 51\nnrows 51\nxllcenter -50\nyllcenter -50\ncellsize 2\n'
    (tmp_path / 'ridge.asc').write_text(head + '\n'.join([row] * 51))
    given = {'bounds': [[-50.0, 50.0]] * 2, 'terrain': str(tmp_path / 'ridge.asc')}
    return Area(EnvironmentSettings.model_validate(given | {'expected_targets': 3.0}))


def box(half=45.0, probability=0.9):
    return BoxDetection([-half, -half], [half, half], probability, 'world')


@pytest.mark.parametrize('detection', [box(), ExponentialDetection(0.9, [40.0, 40.0])])
def test_hidden_ground_stays_unseen(tmp_path, detection):
    area, pose = ridge(tmp_path), Pose.from_yaw([-30.0, 0.0, 15.0], 0.0)
    explored, flat = UnexploredMap(area), UnexploredMap(area.bounds)
    explored.update(detection, pose)
    flat.update(detection, pose)
    nodes = explored.nodes()
    visible = area.terrain.visible(pose.position, area.terrain.on_ground(nodes))
    assert 0.2 < visible.mean() < 0.8
    # The line of sight over the top, 20 m high, falls nowhere behind it.
    assert not visible[nodes[:, 0] > 0.0].any()
    seen, plain = explored.values.ravel(), flat.values.ravel()
    assert seen[visible] == pytest.approx(plain[visible], abs=1e-12)
    assert (seen[~visible] == 1.0).all()
    assert plain[~visible].min() < 0.9


def test_from_above_the_ridge_hides_nothing(tmp_path):
    area, pose = ridge(tmp_path), Pose.from_yaw([0.0, 0.0, 60.0], 0.0)
    explored, flat = UnexploredMap(area), UnexploredMap(area.bounds)
    explored.update(box(), pose)
    flat.update(box(), pose)
    assert explored.values == pytest.approx(flat.values, abs=1e-12)


def test_probabilities_of_hidden_positions(tmp_path):
    area, pose = ridge(tmp_path), Pose.from_yaw([-30.0, 0.0, 15.0], 0.0)
    positions = np.array([[-25.0, 3.0], [14.0, 0.0], [49.0, 49.0]])
    plain = probability_in_sight(box(), positions, pose, None)
    assert plain.tolist() == [0.9, 0.9, 0.0]
    assert probability_in_sight(box(), positions, pose, area.terrain).tolist() == [0.9, 0.0, 0.0]
    soft = probability_in_sight(box(), positions, pose, area.terrain, 0.5)
    assert soft.tolist() == [0.9, 0.45, 0.0]


def scans(area, positions, number):
    """Return the existence probability of a target behind the ridge after looks without it.

    The first look, from above it, detects it.
    """
    sensor = Sensor('one', box(), np.diag([0.5**2, 0.02**2]), clutter=1e-3)
    search = make_filter(FilterSettings(method='pmb'), area, np.random.default_rng(1))
    above = Pose.from_yaw([25.0, 5.0, 40.0], 0.0)
    known = []
    for index in range(1 + number):
        pose = above if index < 1 else Pose.from_yaw(positions, 0.0)
        values = sensor.measurement.measure(BEHIND, pose)[: 1 if index < 1 else 0]
        search.step([AgentMeasurement('one', pose, sensor, values, None, index)], 1, float(index))
        near = [
            item.existence
            for item in search.components
            if np.linalg.norm(item.density.mean - BEHIND[0]) < 5.0
        ]
        known.append(max(near, default=0.0))
    return known


def test_a_target_behind_a_hill_is_not_missed(tmp_path):
    place = [-10.0, 0.0, 14.0]
    flat = {'bounds': [[-50.0, 50.0]] * 2, 'expected_targets': 3.0}
    plain = scans(Area(EnvironmentSettings.model_validate(flat)), place, 6)
    hidden = scans(ridge(tmp_path), place, 6)
    assert hidden[0] == pytest.approx(plain[0], abs=0.05)
    assert plain[-1] < 0.05
    # Six looks that detect it with a twentieth of 0.9: odds times (1 - 0.045)^6.
    odds = hidden[0] / (1.0 - hidden[0]) * (1.0 - 0.045) ** 6
    assert hidden[-1] == pytest.approx(odds / (1.0 + odds), abs=0.02)


def test_the_other_filter_refuses_terrain(tmp_path):
    with pytest.raises(ValueError, match=r"^filter\.method: read 'ic_phd' with environment\.terr"):
        make_filter(FilterSettings(), ridge(tmp_path), np.random.default_rng(1))
