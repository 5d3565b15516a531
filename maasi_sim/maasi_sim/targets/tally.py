"""What the filters have found, update by update, and the record of a search for targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.records import FoundTarget, Label
from maasi_sim.run.run_record import RunRecord
from maasi_sim.run.topics import seconds
from maasi_sim.scenario.schema import Scenario
from maasi_sim.targets.scoring import Scores, score, scoring_radius
from maasi_sim.world.world import World


@dataclass(frozen=True)
class FoundCount:
    """Measurements and found targets of all robots so far, after a filter update."""

    time: float
    step: int
    measurements: int
    found: int
    true_found: int


@dataclass
class Update:
    """An update of a filter, in a namespace, with the found targets published with it."""

    namespace: str
    message: Any
    arrays: list[Any]


@dataclass
class TargetRecord(RunRecord):
    """The record of a search for targets.

    Attributes
    ----------
    truth : (n, d) array
        True targets [m].
    found : list of FoundTarget
        At the end.
    progress : list of FoundCount
        After each filter update.
    measurements : dict
        Number by robot.
    decisions : int
        Waypoints chosen, of all robots.
    waypoints : dict
        By robot: chosen ones in order, (n, 3) [m].
    measured_from : dict
        By robot: poses at which it measured, in order.
    explored, expected_number : float
        Share of the environment, and targets believed not yet found, at the end.
    """

    truth: FloatArray
    found: list[FoundTarget] = field(default_factory=list)
    progress: list[FoundCount] = field(default_factory=list)
    measurements: dict[str, int] = field(default_factory=dict)
    decisions: int = 0
    waypoints: dict[str, FloatArray] = field(default_factory=dict)
    measured_from: dict[str, list[Pose]] = field(default_factory=dict)
    explored: float = 0.0
    expected_number: float = 0.0

    def scores(self) -> Scores:
        """Return the scores at the end."""
        radius = scoring_radius(self.scenario, self.truth)
        return score(self.found, self.truth, radius, self.scenario.scoring.order)


def numbered(found: Sequence[Sequence[FoundTarget]]) -> list[FoundTarget]:
    """Return the found targets of several filters as one list, numbered in the order of time."""
    if len(found) == 1:
        return list(found[0])
    every = sorted(chain(*found), key=lambda item: (item.time, item.robot, item.id))
    return [replace(item, id=number) for number, item in enumerate(every, start=1)]


class Tally:
    """Counts what the filters have found, update by update."""

    def __init__(self, scenario: Scenario, world: World, begin: float) -> None:
        self.scenario = scenario
        self.world = world
        self.truth = np.asarray(world.targets, dtype=float)
        self.begin = begin
        self.radius = scoring_radius(scenario, self.truth)
        self.measurements = dict.fromkeys(scenario.names(), 0)
        self.progress: list[FoundCount] = []
        self.completed: FoundCount | None = None
        self.expected_number = 0.0
        self._shared = len(scenario.namespaces()) > 1
        # By namespace of the filter.
        self._found: dict[str, dict[int, FoundTarget]] = {
            name: {} for name in scenario.namespaces()
        }
        self._expected: dict[str, float] = {}
        self._last_scores: Scores | None = None
        self._counted: set[tuple[str, str, int]] = set()

    @property
    def found(self) -> list[FoundTarget]:
        """Targets found so far."""
        return numbered([[of[key] for key in sorted(of)] for of in self._found.values()])

    def take(self, update: Update) -> bool:
        """Count an update; return whether the number of found targets has changed."""
        message = update.message
        before = self._found[update.namespace]
        changed = bool(update.arrays)
        for array in update.arrays:
            before = {int(item.id): self._target(item) for item in self._own(update, array.targets)}
        for item in self._own(update, message.newly_found):
            if int(item.id) not in before:
                before[int(item.id)] = self._target(item)
                changed = True
        self._found[update.namespace] = before
        for member in message.members:
            # A restarted filter republishes its last update; ignore duplicates.
            key = (update.namespace, member.robot, int(member.measurement))
            if key not in self._counted:
                self._counted.add(key)
                self.measurements[member.robot] = self.measurements.get(member.robot, 0) + 1
        # All filters estimate the same targets.
        self._expected[update.namespace] = float(message.expected_number)
        self.expected_number = max(self._expected.values())
        if self.world.walk > 0.0:
            self.truth = self.world.targets_at(int(message.step))
            changed = True
        if changed or self._last_scores is None:
            order = self.scenario.scoring.order
            self._last_scores = score(self.found, self.truth, self.radius, order)
        now = FoundCount(
            seconds(message.header.stamp) - self.begin,
            int(message.step),
            sum(self.measurements.values()),
            sum(len(found) for found in self._found.values()),
            self._last_scores.match.true_found,
        )
        news = not self.progress or self.progress[-1].found != now.found
        self.progress.append(now)
        if (
            self.completed is None
            and len(self.truth)
            and self._last_scores.complete
            and self.scenario.stop == 'all_found'
        ):
            self.completed = now
        return news

    def _own(self, update: Update, targets: Any) -> list[Any]:
        """Return the targets that the filter found itself."""
        if not self._shared:
            return list(targets)
        return [item for item in targets if item.robot == update.namespace]

    def _target(self, item: Any) -> FoundTarget:
        size = self.scenario.dimension
        return FoundTarget(
            int(item.id),
            np.array([item.position.x, item.position.y, item.position.z])[:size],
            np.array(item.covariance, dtype=float).reshape(3, 3)[:size, :size],
            item.robot,
            int(item.measurement),
            seconds(item.stamp) - self.begin,
            label=Label(item.class_id, item.score, item.identity),
        )
