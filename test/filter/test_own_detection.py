"""Detection models of a user's own: the same numbers as those of the suite, everywhere."""

import math
import pickle
from functools import cache

import numpy as np
import pytest
from numba import njit
from pydantic import BaseModel

from maasi_filter.make_filter import load_filter, make_filter
from maasi_filter.models import detection
from maasi_filter.models.detection import ExponentialDetection
from maasi_filter.models.own_detection import OwnDetection
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import AgentMeasurement
from maasi_filter.settings import FilterSettings
from maasi_filter.state_file import StateFileError
from maasi_filter.unexplored_map import UnexploredMap

BOUNDS = {2: [[0.0, 10.0], [0.0, 10.0]], 3: [[0.0, 10.0]] * 3}


class Width(BaseModel):
    width: float = 2.0


@njit(error_model='numpy')
def exponential(forward, left, up, values):
    return math.exp(-0.5 * math.sqrt(forward**2 + left**2 + up**2) / values[0])


class Compiled(OwnDetection):
    Settings = Width
    compiled = exponential

    def reach(self):
        return 100.0

    def values(self):
        return [self.own.width]


class Looked(OwnDetection):
    Settings = Width

    def reach(self):
        return 20.0

    def evaluate(self, forward, left, up):
        return np.exp(-0.5 * np.sqrt(forward**2 + left**2 + up**2) / self.own.width)


class Ahead(OwnDetection):
    def reach(self):
        return 4.0

    def evaluate(self, forward, left, up):
        return np.clip(forward, 0.0, 1.0) * (np.abs(left) < 1.0)


@pytest.mark.parametrize('dimension', [2, 3])
@pytest.mark.parametrize(('kind', 'error'), [(Compiled, 1e-12), (Looked, 0.02)])
def test_probabilities_are_those_of_the_same_model_of_the_suite(kind, error, dimension):
    places = np.random.default_rng(1).uniform(0.0, 10.0, (500, dimension))
    pose = Pose.from_yaw([4.0, 5.0, 6.0], 0.7)
    own = kind(Width(width=3.0), 0.9, dimension)
    suite = ExponentialDetection(0.9, [3.0] * dimension)
    assert own.probability(places, pose) == pytest.approx(
        suite.probability(places, pose), abs=error
    )
    explored = []
    for model in (own, suite):
        exploration = UnexploredMap(BOUNDS[dimension])
        exploration.update(model, pose)
        explored.append(exploration.values)
    assert explored[0] == pytest.approx(explored[1], abs=error)


def test_offsets_are_in_the_axes_of_the_robot_and_end_at_the_reach():
    model = Ahead(dimension=2)
    pose = Pose.from_yaw([1.0, 1.0, 0.0], math.pi / 2)
    places = [[1.0, 3.0], [1.0, -1.0], [3.0, 1.0], [1.0, 4.9], [1.0, 5.1]]
    assert model.probability(places, pose).tolist() == pytest.approx([1.0, 0.0, 0.0, 1.0, 0.0])


def test_it_survives_another_process():
    place, pose = [[2.0, 3.0]], Pose.from_yaw([0.0, 0.0, 0.0], 0.0)
    model = Compiled(Width(width=5.0), 0.5, 2)
    copy = pickle.loads(pickle.dumps(model))
    assert copy.probability(place, pose) == model.probability(place, pose)


def step(search, sensor, number):
    """Let a robot see a target at (3, 4) once more."""
    pose = Pose.from_yaw([2.0 + 0.1 * number, 2.0, 0.0], 0.3)
    offset = np.array([3.0, 4.0]) - pose.position[:2]
    value = [math.hypot(*offset), math.atan2(offset[1], offset[0])]
    return search.step([AgentMeasurement('a', pose, sensor, np.array([value]))], 1, float(number))


@pytest.mark.parametrize('method', ['pmb', 'ic_phd'])
def test_a_saved_filter_goes_on_in_another_process(method, monkeypatch, tmp_path):
    """Addresses of functions hold in one process only: they are looked up again."""
    settings = FilterSettings(method=method, found_radius=1e-6)
    search = make_filter(settings, BOUNDS[2], np.random.default_rng(1))
    sensor = Sensor('a', Compiled(Width(width=4.0), 0.9, 2), np.diag([0.01, 0.01]))
    for number in range(3):
        step(search, sensor, number)
    search.save(tmp_path / 'state')
    wanted = step(search, sensor, 3).clusters
    # As in another process, where the function is elsewhere.
    before = sensor.detection.kernel()[1][detection.VALUES]
    monkeypatch.setattr(detection, '_known', {})
    monkeypatch.setattr(detection, '_entries', cache(detection._entries.__wrapped__))
    if method == 'pmb':
        with pytest.raises(StateFileError, match='make the sensors'):
            load_filter(tmp_path / 'state')
    again = Sensor('a', Compiled(Width(width=4.0), 0.9, 2), np.diag([0.01, 0.01]))
    assert again.detection.kernel()[1][detection.VALUES] != before
    found = step(load_filter(tmp_path / 'state'), again, 3).clusters
    assert [item.mass for item in found] == [item.mass for item in wanted]
