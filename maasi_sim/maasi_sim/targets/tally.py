"""Counts what the filters have found, update by update."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_filter.models.label import UNLABELLED, Label
from maasi_sim.run.topics import seconds
from maasi_sim.scenario.schema import Scenario
from maasi_sim.targets.scoring import Scores, score, scoring_radius
from maasi_sim.world.world import World

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """A target that the team has found; covariance (d, d) [m^2], label as in the filter."""

    id: int
    position: FloatArray
    covariance: FloatArray
    agent: str
    measurement: int
    time: float
    label: Label = UNLABELLED


@dataclass(frozen=True)
class Progress:
    """State of a run after a filter update."""

    time: float
    step: int
    batch: int
    measurements: int
    found: int
    true_found: int


@dataclass
class Update:
    """An update of a filter, in a namespace, with the found targets published with it."""

    namespace: str
    message: Any
    arrays: list[Any]


class Tally:
    """Counts what the filters have found, update by update."""

    def __init__(self, scenario: Scenario, world: World, begin: float) -> None:
        self.scenario = scenario
        self.world = world
        self.truth = np.asarray(world.targets, dtype=float)
        self.begin = begin
        self.radius = scoring_radius(scenario, self.truth)
        self.measurements = dict.fromkeys(scenario.names(), 0)
        self.progress: list[Progress] = []
        self.completed: Progress | None = None
        self.expected_number = 0.0
        self._shared = len(scenario.namespaces()) > 1
        # By namespace of the filter.
        self._found: dict[str, dict[int, Found]] = {name: {} for name in scenario.namespaces()}
        self._expected: dict[str, float] = {}
        self._last_scores: Scores | None = None
        self._counted: set[tuple[str, str, int]] = set()

    @property
    def found(self) -> list[Found]:
        """Targets found so far; those of several filters are numbered in their order."""
        if not self._shared:
            (found,) = self._found.values()
            return [found[key] for key in sorted(found)]
        every = [item for found in self._found.values() for item in found.values()]
        every.sort(key=lambda item: (item.time, item.agent, item.id))
        return [replace(item, id=number) for number, item in enumerate(every, start=1)]

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
            self._last_scores = self._scores()
        now = Progress(
            seconds(message.header.stamp) - self.begin,
            int(message.step),
            int(message.batch_id),
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

    def _scores(self) -> Scores:
        positions = [item.position for item in self.found]
        return score(positions, self.truth, self.radius, self.scenario.scoring.order)

    def _target(self, item: Any) -> Found:
        size = self.scenario.dimension
        return Found(
            int(item.id),
            np.array([item.position.x, item.position.y, item.position.z])[:size],
            np.array(item.covariance, dtype=float).reshape(3, 3)[:size, :size],
            item.robot,
            int(item.measurement),
            seconds(item.stamp) - self.begin,
            Label(item.class_id, item.score, item.identity),
        )
