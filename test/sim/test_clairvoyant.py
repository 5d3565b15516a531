"""Tests of the reference that knows the true targets."""

from __future__ import annotations

import numpy as np
import pytest
from clairvoyant import Clairvoyant, _expected_end, _Robots, clairvoyant

from maasi_filter.models.detection import BoxDetection
from maasi_planner.settings import PlannerSettings
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.search import search


def one_robot(probability):
    """Return a robot at the origin that moves 1 m each tick and sees 0.5 m far."""
    kind, parameters = BoxDetection([-0.5, -0.5], [0.5, 0.5], probability).kernel()
    return _Robots(
        remaining_path=np.zeros((1, 1, 3)),
        free=np.zeros(1, np.int64),
        speed=np.ones(1),
        pause=np.zeros(1),
        period=np.ones(1, np.int64),
        kind=np.array([kind], np.int64),
        parameters=parameters[None],
        yaw=np.zeros(1),
    )


def test_expected_end_of_a_sure_sensor():
    """Each target needs two detections: one more for what was not seen before."""
    targets = np.array([[3.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
    stops = np.zeros((1, 3))
    routes = np.array([[0, 1, -1]])
    robot = one_robot(1.0)
    # It stands at 3 m after the third step, and measures there until the target is found.
    # The cost is the time to find all plus the mean time to find, both without the last tick.
    seen = _expected_end(robot, routes, targets, np.ones(2, bool), 2, stops)
    assert stops[0] == pytest.approx([3.0, 0.0, 0.0])
    assert seen == pytest.approx(5.0 + 0.5 * (2.0 + 5.0))
    unseen = _expected_end(robot, routes, targets, np.zeros(2, bool), 2, stops)
    assert unseen == pytest.approx(7.0 + 0.5 * (3.0 + 7.0))


@pytest.mark.parametrize('name', ['ranging_drone_3d', 'mambo'])
def test_it_finds_all_sooner_than_the_planner(name):
    scenario = load_scenario(name)
    # Knowing the targets helps on average; on one map luck may weigh more.
    seeds = (20_000, 20_003)
    results = [search(scenario, seed, planner=clairvoyant) for seed in seeds]
    assert all(result.complete for result in results)
    ours = sum(search(scenario, seed).steps for seed in seeds)
    assert sum(result.steps for result in results) < 0.9 * ours


def test_it_ends_when_nothing_is_missing():
    planner = Clairvoyant(PlannerSettings(), lambda: np.zeros((0, 3)))
    assert planner.finished(None) == 'all targets are found'
