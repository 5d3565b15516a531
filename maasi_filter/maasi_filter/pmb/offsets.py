"""Errors of the robots' positions that last, a constant offset and drift, as a state.

A robot reports q + b. The errors b of the robots, and for each found target the error a that its
position inherited from the robot that found it, have one joint normal density: a equals b when the
target is found; later b drifts with the robot's way. A detection of a found target by a robot
measures b - a, as in simultaneous localisation and mapping (Smith, Self and Cheeseman 1990).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.models.pose import Pose
from maasi_filter.pmb.association import associate
from maasi_filter.pmb.component import Component, moments
from maasi_filter.pmb.learnt import innovations, likely, odds_of_detection
from maasi_filter.settings import OffsetSettings

LEAST_PROBABILITY = 0.5  # associations below this probability are not considered
GATE = 25.0  # gate on the squared normalised innovation
LEAST_DIFFERENCE = 1e-3  # differences of two errors below this deviation are not estimated, metres


@dataclass(eq=False)
class Offsets:
    """Joint normal density of the errors of robots and of found targets."""

    settings: OffsetSettings
    dimension: int
    keys: list[str | int] = field(default_factory=list)  # Names of robots, and ids of found targets
    mean: FloatArray = field(default_factory=lambda: np.empty(0))  # (n d,): Metres
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 0)))  # (n d, n d)
    #: Reported position of each robot at its last scan, (3,), metres.
    last: dict[str, FloatArray] = field(default_factory=dict)
    #: Way of each robot on the level since its first scan, metres.
    way: dict[str, float] = field(default_factory=dict)

    @property
    def active(self) -> bool:
        """Whether the settings say that errors last."""
        return self.settings.deviation > 0.0 or self.settings.drift > 0.0

    def localise(
        self,
        member: CheckedMeasurement,
        components: Sequence[Component],
        clutter: FloatArray,
        unseen: float,
    ) -> CheckedMeasurement:
        """Return a robot's scan at its estimated pose, with components moved, if errors last."""
        if not self.active:
            return member
        found = {item.target.id for item in components if item.target is not None}
        self._keep([key for key in self.keys if isinstance(key, str) or key in found])
        robot = member.robot
        self._predict(robot, member.pose.position)
        before = self.mean.copy()
        lasting = self.settings.deviation**2 + self.settings.drift**2 * self.way[robot]
        error = math.sqrt(max(member.pose_error**2 - lasting, 0.0))
        pose = _moved(member.pose, self.mean[self._part(robot)])
        member = replace(member, pose=pose, pose_error=error)
        model = member.sensor.measurement
        jacobians = model.jacobian(model.inverse(member.values, pose), pose)
        other = clutter + unseen / np.maximum(np.abs(np.linalg.det(jacobians)), 1e-12)
        self._update(member, components, other)
        change = self.mean - before
        for item in components:
            # What is not found yet has the error of the robot that detected it.
            key = item.robot if item.target is None else item.target.id
            if key in self.keys:
                item.density.shift(-change[self._part(key)])
            item.stale = True
        rows = [self._rows(robot, key) for key in self.last if key != robot]
        apart = [np.trace(row @ self.covariance @ row.T) / self.dimension for row in rows]
        deviation = math.sqrt(float(np.mean(apart))) if apart else 0.0
        return replace(
            member,
            pose=_moved(pose, change[self._part(robot)]),
            pose_error=math.hypot(error, deviation),
        )

    def find(self, robot: str, target: int) -> None:
        """Let a target that a robot has just found inherit the robot's error."""
        if not self.active:
            return
        part = self._part(robot)
        self._append(target, self.mean[part], self.covariance[part], self.covariance[part, part])

    def covariance_of(self, target: int) -> FloatArray:
        """Return the covariance of the error of a found target, (d, d); 0 of one of others."""
        if target not in self.keys:
            return np.zeros((self.dimension, self.dimension))
        part = self._part(target)
        return self.covariance[part, part]

    def _keep(self, keys: list[str | int]) -> None:
        """Marginalise all errors but these."""
        index = np.array([i for key in keys for i in range(len(self.mean))[self._part(key)]], int)
        self.mean, self.covariance = self.mean[index], self.covariance[np.ix_(index, index)]
        self.keys = keys

    def _predict(self, robot: str, position: FloatArray) -> None:
        """Add a robot that is new; let the error of another one drift with its way."""
        d = self.dimension
        if robot not in self.keys:
            block = self.settings.deviation**2 * np.eye(d)
            self._append(robot, np.zeros(d), np.zeros((d, len(self.mean))), block)
            self.last[robot], self.way[robot] = position, 0.0
        step = position[:2] - self.last[robot][:2]
        way = math.sqrt(float(step @ step))
        self.last[robot] = position
        self.way[robot] += way
        # Heights do not drift: they are measured against the ground.
        level = self._part(robot).start + np.arange(2)
        self.covariance[level, level] += self.settings.drift**2 * way

    def _update(
        self, member: CheckedMeasurement, components: Sequence[Component], other: FloatArray
    ) -> None:
        """Kalman update with the detections that found targets most probably caused."""
        d = self.dimension
        items = likely(components)
        found = [item.target.id if item.target is not None else '' for item in items]
        rows = [self._rows(member.robot, target) for target in found]
        apart = [row @ self.covariance @ row.T for row in rows]
        most = max(map(np.trace, apart), default=0.0)
        if not len(member.values) or most < LEAST_DIFFERENCE**2:
            return
        means, covariances, _ = moments(items)
        errors, jacobians, totals, squares = innovations(member, means, covariances + apart)
        # r L / (1 - r p_D) with a normal density.
        peaks = np.sqrt(np.linalg.det(2.0 * math.pi * totals))
        odds = np.exp(-0.5 * squares) / peaks * odds_of_detection(member, items, means)[:, None]
        odds[squares > GATE] = 0.0
        caused = np.argwhere(associate(odds, other).caused > LEAST_PROBABILITY).tolist()
        used = [(i, j) for i, j in caused if apart[i].any()]
        if not used:
            return
        error = np.concatenate([errors[i, j] for i, j in used])
        design = np.concatenate([jacobians[i] @ rows[i] for i, _ in used])
        total = design @ self.covariance @ design.T
        for k, (i, j) in enumerate(used):
            total[k * d : k * d + d, k * d : k * d + d] = totals[i, j]
        gain = np.linalg.solve(total, design @ self.covariance).T
        self.mean = self.mean + gain @ error
        covariance = self.covariance - gain @ design @ self.covariance
        self.covariance = 0.5 * (covariance + covariance.T)

    def _rows(self, one: str | int, other: str | int) -> FloatArray:
        """Return the (d, n d) matrix of one error minus another one; 0 if that is not known."""
        rows = np.zeros((self.dimension, len(self.mean)))
        if other in self.keys:
            rows[:, self._part(one)] += np.eye(self.dimension)
            rows[:, self._part(other)] -= np.eye(self.dimension)
        return rows

    def _part(self, key: str | int) -> slice:
        first = self.dimension * self.keys.index(key)
        return slice(first, first + self.dimension)

    def _append(
        self, key: str | int, mean: FloatArray, cross: FloatArray, block: FloatArray
    ) -> None:
        self.keys.append(key)
        self.mean = np.concatenate([self.mean, mean])
        self.covariance = np.block([[self.covariance, cross.T], [cross, block]])


def _moved(pose: Pose, way: FloatArray) -> Pose:
    """Return a pose without the error `way` (d,) of its position."""
    position = pose.position.copy()
    position[: len(way)] -= way
    return Pose(position, pose.orientation)
