"""The trigger (24), (33)."""

import numpy as np
import pytest
from planner_helpers import random_team

from maasi_filter.models.pose import Pose
from maasi_planner import MeasurementTrigger, PlannerSettings
from maasi_planner.measurement_trigger import expected_use


@pytest.mark.parametrize('kind', ['absolute', 'relative'])
def test_it_measures_at_waypoints_and_where_the_use_is_above_the_threshold(kind):
    rng = np.random.default_rng(0)
    team = random_team(rng, dimension=2, planning=1, waiting=0, kinds=('exponential',))
    sensor = team.robots[team.planning()[0]].sensor
    positions = np.linspace([0.1, 0.1, 0.0], [1.9, 1.7, 0.0], 40)
    poses = [Pose.from_yaw(position, 0.0) for position in positions[::5]]
    knowledge = team.clusters, team.exploration
    uses = []
    for pose in poses:
        expected = 1.7 * team.exploration.at(pose.position)[0]
        for cluster in team.clusters:
            expected += sensor.detection.probability(cluster.position[None, :], pose)[0]
        uses.append(expected_use(sensor, pose, *knowledge, 1.7))
        assert uses[-1] == pytest.approx(expected, rel=1e-12)

    # Relative to the mean along the way.
    threshold = float(np.median(uses)) if kind == 'absolute' else 0.8
    settings = PlannerSettings(measurement='event', trigger=kind, threshold=threshold, gamma=1.7)
    trigger = MeasurementTrigger(settings)
    trigger.begin('r', sensor, positions, np.zeros(40), 5, *knowledge)
    least = threshold if kind == 'absolute' else 0.8 * np.mean(uses)
    assert min(uses) < least < max(uses)
    for pose, use in zip(poses, uses):
        assert trigger.measures('r', 0, sensor, pose, *knowledge)
        assert trigger.measures('r', 1, sensor, pose, *knowledge) == (use > least)
