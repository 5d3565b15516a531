"""Times of measurements: periodic, or by expected information (000, (24), (33))."""

from collections.abc import Sequence

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.models.sensor import Sensor
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner.motion import MotionModel
from maasi_planner.objective.sight import probability_over
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
        chances = probability_over(exploration.area, sensor.detection, centres, pose)
        use += float(sum(chances.tolist()))
    return use


class MeasurementSchedule:
    """Measurement times of one robot: at waypoints and, if of use, at each period between them.

    due: whether the robot measures as soon as it can; number: of measurements so far.
    """

    def __init__(
        self, motion: MotionModel, sensor: Sensor, period: int, settings: PlannerSettings
    ) -> None:
        self._motion, self._sensor, self._period = motion, sensor, period
        self._settings = settings
        self.due = False
        self.number = 0
        # First step of the periods, and step of the last decision.
        self._since, self._turned_at = 0, -1
        # Passed waypoint until the closest point, and the squared distance.
        self._passed: FloatArray | None = None
        self._nearest = 0.0
        self._mean = 0.0  # use along the predicted trajectory

    def phase(self, step: int) -> int:
        """Return the steps to the next possible measurement."""
        return (self._since - step) % self._period

    def is_of_use(
        self, pose: Pose, clusters: Sequence[Cluster], exploration: UnexploredMap
    ) -> bool:
        """Return whether to measure at a pose between waypoints."""
        settings = self._settings
        if settings.measurement == 'periodic':
            return True
        use = expected_use(self._sensor, pose, clusters, exploration, settings.gamma)
        relative = settings.trigger == 'relative'
        return use > settings.threshold * (self._mean if relative else 1.0)

    def turn(self, step: int, position: FloatArray, passed: FloatArray | None) -> None:
        """Begin a path; passed: the waypoint passed without a stop, if any."""
        # The first of two waypoints passed in a row is measured now.
        self.due = self.due or self._passed is not None
        self._passed, self._turned_at = passed, step
        if passed is None:
            self._since = step
        else:
            self._nearest = self._motion.squared_distance(position, passed)

    def predict(
        self,
        positions: FloatArray,
        yaws: FloatArray,
        clusters: Sequence[Cluster],
        exploration: UnexploredMap,
    ) -> None:
        """Evaluate a predicted trajectory, (n, 3) and (n,), for the trigger `relative`."""
        settings = self._settings
        if settings.measurement == 'periodic' or settings.trigger == 'absolute':
            return
        path = (np.asarray(values, dtype=float)[:: self._period] for values in (positions, yaws))
        uses = [
            expected_use(self._sensor, pose, clusters, exploration, settings.gamma)
            for pose in map(Pose.from_yaw, *path)
        ]
        self._mean = sum(uses) / len(uses)

    def update(
        self,
        step: int,
        pose: Pose,
        underway: bool,
        clusters: Sequence[Cluster],
        exploration: UnexploredMap,
    ) -> None:
        """Update with a pose; underway: whether the robot measures between waypoints."""
        if self._passed is not None and step != self._turned_at:
            distance = self._motion.squared_distance(pose.position, self._passed)
            if distance >= self._nearest:
                self._passed, self._since = None, step
            self._nearest = distance
        gone = step - self._since
        # At 0 the robot is at its waypoint, or at the closest point.
        if gone == 0:
            self.due = True
        elif underway and gone % self._period == 0 and not self.due:
            self.due = self.is_of_use(pose, clusters, exploration)

    def begin(self) -> int:
        """Begin a due measurement, and return its index."""
        self.due = False
        self.number += 1
        return self.number - 1

    def restart(self, step: int) -> None:
        """Begin the periods at a step."""
        self._since = self._turned_at = step

    def cancel(self) -> None:
        """Note that the robot has no path."""
        self._passed, self.due = None, False

    def begin_again(self) -> None:
        """Begin a new search; measurement indices continue."""
        self._mean = 0.0
