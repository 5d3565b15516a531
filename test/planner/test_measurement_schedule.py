"""The trigger (24), (33)."""

import numpy as np
import pytest
from planner_helpers import random_team

from maasi_filter.models.pose import Pose
from maasi_planner import MeasurementSchedule, planner_settings
from maasi_planner.measurement_schedule import expected_use


@pytest.mark.parametrize('kind', ['absolute', 'relative'])
def test_it_measures_at_waypoints_and_where_the_use_is_above_the_threshold(kind):
    rng = np.random.default_rng(0)
    team = random_team(rng, dimension=2, planning=1, waiting=0, kinds=('exponential',))
    view = team.robots[team.planning()[0]]
    sensor = view.sensor
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
    settings = planner_settings(measurement='event', trigger=kind, threshold=threshold, gamma=1.7)
    schedule = MeasurementSchedule(view.motion, sensor, 5, settings)
    schedule.turn(0, positions[0], None)
    schedule.predict(positions, np.zeros(40), *knowledge)
    least = threshold if kind == 'absolute' else 0.8 * np.mean(uses)
    assert min(uses) < least < max(uses)
    for number, (pose, use) in enumerate(zip(poses, uses)):
        schedule.update(5 * number, pose, True, *knowledge)
        assert schedule.due == (number == 0 or use > least)
        if schedule.due:
            schedule.begin()
