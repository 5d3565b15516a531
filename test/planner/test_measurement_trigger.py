"""The trigger (24), (33)."""

from __future__ import annotations

import numpy as np
import pytest
from planner_helpers import random_team

from maasi_filter.models.pose import Pose
from maasi_planner import MeasurementTrigger, PlannerSettings
from maasi_planner.measurement_trigger import expected_use


def situation(seed=0):
    rng = np.random.default_rng(seed)
    team = random_team(rng, dimension=2, planning=1, waiting=0, kinds=('exponential',))
    view = team.robots[team.planning()[0]]
    positions = np.linspace([0.1, 0.1, 0.0], [1.9, 1.7, 0.0], 40)
    return team, view, positions, np.zeros(40)


def test_left_side_is_the_formula():
    team, view, positions, _ = situation()
    for position in positions[::7]:
        pose = Pose.from_yaw(position, 0.0)
        expected = 1.7 * team.exploration.at(position)[0]
        for cluster in team.clusters:
            expected += view.sensor.detection.probability(cluster.position[None, :], pose)[0]
        use = expected_use(view.sensor, pose, team.clusters, team.exploration, 1.7)
        assert use == pytest.approx(expected, rel=1e-12)


def test_waypoint_always_measures_and_threshold_decides_after():
    team, view, positions, _ = situation()
    uses = [
        expected_use(view.sensor, Pose.from_yaw(p, 0.0), team.clusters, team.exploration, 1.0)
        for p in positions
    ]
    middle = float(np.median(uses))
    trigger = MeasurementTrigger(PlannerSettings(measurement='event', threshold=middle))
    for position, use in zip(positions, uses):
        pose = Pose.from_yaw(position, 0.0)
        arguments = (view.sensor, pose, team.clusters, team.exploration)
        assert trigger.measures('r', 0, *arguments)
        assert trigger.measures('r', 1, *arguments) == (use > middle)


def test_relative_compares_with_the_mean_along_the_way():
    team, view, positions, yaws = situation()
    trigger = MeasurementTrigger(
        PlannerSettings(measurement='event', trigger='relative', threshold=0.8)
    )
    trigger.begin('r', view.sensor, positions, yaws, 5, team.clusters, team.exploration)
    uses = [
        expected_use(view.sensor, Pose.from_yaw(p, 0.0), team.clusters, team.exploration, 1.0)
        for p in positions[::5]
    ]
    for position, use in zip(positions[::5], uses):
        pose = Pose.from_yaw(position, 0.0)
        measured = trigger.measures('r', 2, view.sensor, pose, team.clusters, team.exploration)
        assert measured == (use > 0.8 * np.mean(uses))
