"""Measurement trigger: periodic, or by expected information (000, (24), (33))."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.settings import PlannerSettings


def expected_use(
    sensor: Sensor,
    pose: Pose,
    clusters: Sequence[Cluster],
    exploration: UnexploredMap,
    gamma: float,
) -> float:
    """Return the left side of 000, eq. (24) and (33): the sum of pi at centres plus gamma e."""
    use = gamma * float(exploration.at(pose.position)[0])
    if clusters:
        centres = np.stack([cluster.position for cluster in clusters])
        use += float(sum(sensor.detection.probability(centres, pose).tolist()))
    return use


class MeasurementTrigger:
    """Decides at each possible measurement of a robot whether it measures.

    A robot always measures at its decision (index 0). `relative` compares with the mean of the same
    quantity along the predicted trajectory, evaluated at the decision.
    """

    def __init__(self, settings: PlannerSettings) -> None:
        self.settings = settings
        self._means: dict[str, float] = {}

    def begin(
        self,
        robot: str,
        sensor: Sensor,
        positions: ArrayLike,
        yaws: ArrayLike,
        period_steps: int,
        clusters: Sequence[Cluster],
        exploration: UnexploredMap,
    ) -> None:
        """Store a new trajectory; call at each decision of the robot."""
        if self.settings.measurement == 'periodic' or self.settings.trigger == 'absolute':
            return
        ways = (np.asarray(values, dtype=float)[::period_steps] for values in (positions, yaws))
        poses, gamma = map(Pose.from_yaw, *ways), self.settings.gamma
        uses = [expected_use(sensor, pose, clusters, exploration, gamma) for pose in poses]
        self._means[robot] = sum(uses) / len(uses)

    def measures(
        self,
        robot: str,
        index: int,
        sensor: Sensor,
        pose: Pose,
        clusters: Sequence[Cluster],
        exploration: UnexploredMap,
    ) -> bool:
        """Return whether the robot measures now."""
        settings = self.settings
        if settings.measurement == 'periodic' or index == 0:
            return True
        use = expected_use(sensor, pose, clusters, exploration, settings.gamma)
        threshold = settings.threshold
        if settings.trigger == 'relative':
            threshold *= self._means.get(robot, 0.0)
        return use > threshold
