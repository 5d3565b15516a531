"""A filter of your own: detections count for the nearest candidate, and enough of them find it."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import Field

from maasi_filter import Cluster, FilterResult, FoundTarget, SearchFilter
from maasi_filter.arrays import FloatArray
from maasi_filter.measurement_check import FOUND, check_measurements, count_dropped, within_range
from maasi_filter.settings import Settings


@dataclass
class Candidate:
    position: FloatArray  # [m]
    covariance: FloatArray  # [m^2]
    score: float  # detections, less the probability of each one that was missed


class HitCounter(SearchFilter):
    class Settings(Settings):
        gate: float = Field(1.0, gt=0.0, description='Largest distance of a detection [m]')
        hits: float = Field(4.0, ge=1.0, description='Score at which a candidate is found [1]')

    saved: ClassVar = {**SearchFilter.saved, 'candidates': list[Candidate]}

    def __init__(self, settings, area, generator):
        super().__init__(settings, area, generator)
        self.candidates = []

    def step(self, measurements, steps, time):
        result = FilterResult()
        members = check_measurements(measurements, steps, time, self.settings, self.dimension)
        for member in members:  # robots by name
            member = within_range(member, result.dropped)
            self.count(member, result.dropped)
            found = self.register()
            for item in [item for item in self.candidates if item.score >= self.own.hits]:
                origin, number = (member.robot, member.index, time), found.next_id()
                target = FoundTarget(number, item.position, item.covariance, *origin)
                found.targets.append(target)
                result.newly_found.append(target)
            self.candidates = [item for item in self.candidates if 0 < item.score < self.own.hits]
            self.exploration.update(member.sensor.detection, member.pose)
        # What the planner looks at: the candidates, the most certain first.
        self.clusters = []
        for item in sorted(self.candidates, key=lambda item: -item.score):
            radius, mass = math.sqrt(np.trace(item.covariance)), item.score / self.own.hits
            self.clusters.append(Cluster(item.position, item.covariance, radius, mass))
        result.clusters, result.expected_number = list(self.clusters), self.expected_number
        result.found_changed = bool(result.newly_found)
        return result

    def count(self, member, dropped):
        """Add the detections of one robot to the nearest candidates, or begin new ones."""
        sensor, pose, missed = member.sensor, member.pose, list(self.candidates)
        positions = sensor.measurement.inverse(member.values, pose)
        slopes = np.linalg.pinv(sensor.measurement.jacobian(positions, pose))
        floor = 1e-6 * np.eye(self.dimension)  # a detection at the robot itself has no slopes
        spreads = slopes @ member.covariances @ slopes.transpose(0, 2, 1) + floor  # [m^2]
        for position, spread in zip(positions, spreads):
            if self.nearest(self.found_targets, position):
                count_dropped(dropped, FOUND, 1)
            elif item := self.nearest(self.candidates, position):
                # The update of a Kalman filter.
                gain = item.covariance @ np.linalg.inv(item.covariance + spread)
                item.position = item.position + gain @ (position - item.position)
                item.covariance = item.covariance - gain @ item.covariance
                item.score += 1.0
                missed = [other for other in missed if other is not item]
            else:
                self.candidates.append(Candidate(position, spread, 1.0))
        for item in missed:
            item.score -= float(sensor.detection.probability([item.position], pose)[0])

    def nearest(self, items, position):
        """Return the nearest candidate or found target within the gate, or None."""
        apart = [float(np.linalg.norm(item.position - position)) for item in items]
        best = int(np.argmin(apart)) if apart else -1
        return items[best] if apart and apart[best] <= self.own.gate else None
