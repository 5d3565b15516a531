"""What the filters have found, update by update, with scores; the record of a search."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.metrics import Gospa, Match, gospa, match_targets
from maasi_filter.models.pose import Pose
from maasi_filter.records import FoundTarget, Label
from maasi_sim.run.mission import Observer, RunRecord
from maasi_sim.run.topics import seconds
from maasi_sim.scenario.schema import Scenario
from maasi_sim.simulation.world import World


def scoring_radius(scenario: Scenario, truth: FloatArray) -> float:
    """Return the distance within which a found target is true [m]; true positions (n, d) [m].

    The scenario's, or three times T_z, at most half the smallest distance between two targets, so
    that none can be matched with its neighbour.
    """
    if scenario.scoring.radius is not None:
        return scenario.scoring.radius
    radius = 3.0 * scenario.removal_distance()
    if len(truth) > 1:
        # Deferred: it is the slowest import of a run.
        from scipy.spatial.distance import pdist

        nearest = float(pdist(truth).min())
        if nearest == 0.0:
            raise ValueError('truth: got two targets at the same place, allowed are different ones')
        radius = min(radius, 0.5 * nearest)
    return radius


@dataclass(frozen=True)
class Scores:
    """Found targets against the truth: one-to-one pairs, and GOSPA.

    `radius` is the distance within which a found target is true, and c of GOSPA [m]; `order` its p.
    """

    radius: float
    order: float
    match: Match
    gospa: Gospa

    @property
    def complete(self) -> bool:
        """Whether every true target is found."""
        return self.match.missed == 0


def score(
    found: Sequence[FoundTarget] | FloatArray, truth: ArrayLike, radius: float, order: float = 2.0
) -> Scores:
    """Return the scores of found targets, or of places (n, d), against true ones (m, d) [m]."""
    if not isinstance(found, np.ndarray):
        found = np.array([getattr(item, 'position', item) for item in found])
    return Scores(
        radius,
        order,
        match_targets(found, truth, radius),
        gospa(found, truth, cutoff=radius, power=order),
    )


@dataclass(frozen=True)
class FoundCount:
    """Measurements and found targets of all robots so far, after a filter update."""

    time: float  #: [s]
    #: k.
    step: int
    measurements: int
    found: int
    true_found: int


def numbered(found: Sequence[Sequence[FoundTarget]]) -> list[FoundTarget]:
    """Return the found targets of several filters as one list, numbered in the order of time."""
    if len(found) == 1:
        return list(found[0])
    every = sorted(chain(*found), key=lambda item: (item.time, item.robot, item.id))
    return [replace(item, id=number) for number, item in enumerate(every, start=1)]


def found_target(item: Any, begin: float, dimension: int = 3) -> FoundTarget:
    """Return the found target of a message, with its time since `begin` [s]."""
    position = np.array([item.position.x, item.position.y, item.position.z])
    covariance = np.array(item.covariance, dtype=float).reshape(3, 3)
    return FoundTarget(
        int(item.id),
        position[:dimension],
        covariance[:dimension, :dimension],
        item.robot,
        int(item.measurement),
        seconds(item.stamp) - begin,
        label=Label(item.class_id, item.score, item.identity),
    )


class Tally:
    """Counts what the filters have found, update by update."""

    def __init__(self, scenario: Scenario, world: World, run: Observer) -> None:
        self.scenario, self.world = scenario, world
        self.truth = np.asarray(world.targets, dtype=float)
        self.measurements = dict.fromkeys(scenario.names(), 0)
        self.progress: list[FoundCount] = []
        self.completed: FoundCount | None = None
        self._run = run
        self._radius = scoring_radius(scenario, self.truth)
        # By namespace of the filter.
        self._found: dict[str, dict[int, FoundTarget]] = {
            name: {} for name in scenario.namespaces()
        }
        self._scores: Scores | None = None
        self._counted: set[tuple[str, str, int]] = set()

    @property
    def found(self) -> list[FoundTarget]:
        """Targets found so far."""
        return numbered([[of[key] for key in sorted(of)] for of in self._found.values()])

    def scores(self) -> Scores:
        """Return the scores so far."""
        return score(self.found, self.truth, self._radius, self.scenario.scoring.order)

    def take(self, space: str, message: Any, every: Any) -> bool:
        """Count an update of a filter; return whether the number of found targets has changed.

        `every` is the message with all its found targets, None if they have not changed.
        """
        before = self._found[space] if every is None else self._own(space, every.targets)
        new = self._own(space, message.newly_found)
        changed = every is not None or not new.keys() <= before.keys()
        self._found[space] = {**new, **before}
        for member in message.members:
            # A restarted filter republishes its last update; ignore duplicates.
            key = (space, member.robot, int(member.measurement))
            if key not in self._counted:
                self._counted.add(key)
                self.measurements[member.robot] = self.measurements.get(member.robot, 0) + 1
        if self.world.walk > 0.0:
            self.truth = self.world.targets_at(int(message.step))
            changed = True
        if changed or self._scores is None:
            self._scores = self.scores()
        now = FoundCount(
            self._run.time(message.header.stamp),
            int(message.step),
            sum(self.measurements.values()),
            sum(map(len, self._found.values())),
            self._scores.match.true_found,
        )
        news = not self.progress or self.progress[-1].found != now.found
        self.progress.append(now)
        complete = len(self.truth) and self._scores.complete and self.scenario.stop == 'all_found'
        if complete and self.completed is None:
            self.completed = now
        return news

    def _own(self, space: str, targets: Iterable[Any]) -> dict[int, FoundTarget]:
        """Return the targets that a filter found itself, not those that others told it."""
        begin, dimension = self._run.begin or 0.0, self.scenario.dimension
        return {
            int(item.id): found_target(item, begin, dimension)
            for item in targets
            if len(self._found) == 1 or item.robot == space
        }


@dataclass
class TargetRecord(RunRecord):
    """The record of a search for targets."""

    tally: Tally  #: at the end
    #: By robot, in order: chosen ones, (n, 3) [m], and poses at which it measured.
    waypoints: dict[str, FloatArray] = field(default_factory=dict)
    measured_from: dict[str, list[Pose]] = field(default_factory=dict)
