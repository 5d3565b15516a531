"""A search filter, for nodes, planners and searches in one process; what all filters share."""

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, TypeAdapter
from typing_extensions import Self

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.vector_math import squared_distance
from maasi_filter.measurement_check import check_taken
from maasi_filter.records import AgentMeasurement, Cluster, FilterResult, FoundTarget
from maasi_filter.settings import FilterSettings
from maasi_filter.state_file import SavedGenerator, write_state
from maasi_filter.unexplored_map import UnexploredMap

SAME_TARGET = 16.0  # gate on the squared normalised distance of two estimates of the same target


def distance(position: FloatArray, covariance: FloatArray, target: FoundTarget) -> float:
    """Return the squared normalised distance between an estimate and a found target."""
    return squared_distance(position - target.position, covariance + target.covariance)


def nearest(target: FoundTarget, estimates: Sequence[tuple[FloatArray, FloatArray]]) -> int:
    """Return the index of the nearest estimate, position and covariance, within the gate, or -1."""
    apart = [distance(*estimate, target) for estimate in estimates]
    best = int(np.argmin(apart)) if apart else -1
    return best if apart and apart[best] < SAME_TARGET else -1


@dataclass
class FoundTargets:
    """Found targets of a filter: its own, and those of the filters of other robots."""

    targets: list[FoundTarget] = field(default_factory=list)  # In the order of being found
    last_id: int = 0  # Largest id given so far

    def next_id(self) -> int:
        """Return the id of the next found target."""
        self.last_id += 1
        return self.last_id

    def take_over(self, robot: str, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Merge targets found by another filter; return those that are new or changed."""
        added, changed = [], []
        for target in targets:
            known = [(item.robot, item.origin) == (robot, target.id) for item in self.targets]
            estimates = [(item.position, item.covariance) for item in self.targets]
            f = known.index(True) if any(known) else nearest(target, estimates)
            old = self.targets[f] if f >= 0 else None
            # A target kept from before a restart has its robot, but not its id there.
            theirs = any(known) or (old is not None and (old.robot, old.origin) == (robot, 0))
            if old is not None and not theirs and (old.time, old.robot) <= (target.time, robot):
                continue  # another one found it first
            number = self.next_id() if old is None else old.id
            new = replace(target, id=number, robot=robot, origin=target.id)
            if old is None:
                self.targets.append(new)
                added.append(new)
            elif not (
                (new.origin, new.robot) == (old.origin, old.robot)
                and np.array_equal(new.position, old.position)
                and np.array_equal(new.covariance, old.covariance)
            ):
                self.targets[f] = new
                changed.append(new)
        return added + changed

    def withdraw(self, robot: str, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Remove the targets of another filter that it has no longer; return them."""
        theirs = {target.id for target in targets}
        gone = [t for t in self.targets if t.origin and t.robot == robot and t.origin not in theirs]
        ids = {target.id for target in gone}
        self.targets[:] = [target for target in self.targets if target.id not in ids]
        return gone

    def keep(self, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Add targets that were found before a restart; return the new ones."""
        own = {target.id: target for target in self.targets}
        kept = {target.id for target in targets}
        since = [target for target in self.targets if target.id not in kept]
        new: list[FoundTarget] = []
        for target in targets:
            rivals = [own[target.id]] if target.id in own else since
            apart = [distance(target.position, target.covariance, known) for known in rivals]
            if min(apart, default=np.inf) < SAME_TARGET:
                continue
            added = replace(target, id=self.next_id() if target.id in own else target.id)
            self.last_id = max(self.last_id, added.id)
            self.targets.append(added)
            new.append(added)
        return new


# What of every filter is saved, with its type, beside e.
_SAVED: dict[str, Any] = {
    'settings': FilterSettings,
    'environment': EnvironmentSettings,
    'generator': SavedGenerator,
    'clusters': list[Cluster],
}


class SearchFilter(ABC):
    """A filter that finds targets from the detections of several robots.

    A subclass has `step`; it keeps `clusters` and `exploration`, and adds to `register()` what it
    finds. One that stores its found targets elsewhere overrides `found_targets`, `register`,
    `place` and `remove`.

    Attributes
    ----------
    settings : FilterSettings
        As given.
    area : Area
        Where targets may be.
    bounds : (d, 2) array
        Around the area, metres.
    dimension : int
        2 or 3.
    exploration : UnexploredMap
        e, updated with every measurement.
    clusters : list of Cluster
        Potential targets that are not found, heaviest first.
    Settings : type or None
        Model of the filter's own settings; with it, `settings.settings` is an instance.
    own : BaseModel or None
        That instance.
    """

    Settings: ClassVar[type[BaseModel] | None] = None
    #: Types of what is saved of one method only, by attribute.
    saved: ClassVar[dict[str, Any]] = {'_found': FoundTargets}

    def __init__(
        self, settings: FilterSettings, area: Area | ArrayLike, generator: np.random.Generator
    ) -> None:
        self.settings = settings
        self.exploration = UnexploredMap(area, settings.exploration_spacing)
        self.take_area(self.exploration.area)
        self.bounds = self.area.bounds
        self.dimension = self.exploration.dimension
        self.generator = generator
        self.clusters: list[Cluster] = []
        self._found = FoundTargets()

    @property
    def own(self) -> Any:
        """The filter's own settings."""
        return self.settings.settings

    def take_area(self, area: Area) -> None:
        """Take another area within the same bounds, as with other keep-outs."""
        self.area, self.environment = area, area.settings
        self.exploration.take_area(area)

    @property
    def found_targets(self) -> list[FoundTarget]:
        """Targets found so far, in the order of being found."""
        return self._found.targets

    @property
    def particles(self) -> FloatArray:
        """Of targets that are not found yet, (n, d), metres; empty: the filter has none."""
        return np.empty((0, self.dimension))

    @property
    def weights(self) -> FloatArray:
        """Of the particles, (n,); they sum to `expected_number`."""
        return np.empty(0)

    @property
    def expected_number(self) -> float:
        """Expected number of targets that are not found yet, of those that were detected."""
        return float(sum(cluster.mass for cluster in self.clusters))

    @abstractmethod
    def step(
        self, measurements: Sequence[AgentMeasurement], steps: int, time: float
    ) -> FilterResult:
        """Predict over `steps` control steps, correct with every robot of M_k, and mark.

        Parameters
        ----------
        measurements : sequence of AgentMeasurement
            M_k, in any order; they are processed in the order of the robots' names. May be empty.
        steps : int
            Control steps since the last batch, from 0; irrelevant for pmb and static targets.
        time : float
            Time of newly found targets, seconds.

        Raises
        ------
        ValueError
            If anything is not finite, a covariance is not positive definite, shapes or dimensions
            do not fit, or a robot appears twice. The filter is then unchanged.
        """

    def register(self) -> FoundTargets:
        """Return the found targets with the ids given so far."""
        return self._found

    def place(self, found: FoundTargets, changed: Sequence[FoundTarget]) -> None:  # noqa: B027
        """Take found targets into the state, of which some are new or changed."""

    def remove(self, found: FoundTargets, withdrawn: Sequence[FoundTarget]) -> None:  # noqa: B027
        """Take found targets into the state without those that their filter has withdrawn."""

    def own_found_targets(self) -> list[FoundTarget]:
        """Return the found targets that this filter found itself."""
        return [target for target in self.found_targets if not target.origin]

    def take_over(self, robot: str, targets: Sequence[FoundTarget]) -> bool:
        """Merge targets found by the filter of another robot; return whether anything changed.

        A target that two robots found belongs to the robot that found it first (ties: first by
        name), and follows the estimate of that robot (002, section 4). Call it before `step`, with
        all targets that the filter of `robot` found itself.

        Raises
        ------
        ValueError
            If a number is not finite, or dimensions do not fit. The filter is then unchanged.
        """
        check_taken(robot, targets, self.dimension)
        found = self.register()
        taken = found.take_over(robot, targets)
        self.place(found, taken)
        return bool(taken)

    def withdraw(self, robot: str, targets: Sequence[FoundTarget]) -> bool:
        """Remove found targets that the filter of another robot has withdrawn; return whether any.

        Call it with the same targets as `take_over`, after that of all other robots: what one of
        them leaves out may belong to another.
        """
        found = self.register()
        gone = found.withdraw(robot, targets)
        self.remove(found, gone)
        return bool(gone)

    def keep_found(self, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Add targets found before this filter was created; return those that are new.

        They keep their ids, except that an id in use is replaced by the next free one. ValueError
        as of `take_over`.
        """
        check_taken('kept', targets, self.dimension)
        found = self.register()
        added = found.keep(targets)
        self.place(found, added)
        return added

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the whole state, random generator included, to one file.

        The file is replaced atomically: a crash leaves the old one or the new one.
        """
        write_state(path, self.state())

    def state(self) -> dict[str, dict[str, Any]]:
        """Return the whole state, random generator included, by the name of the method."""
        state = {name: getattr(self, name) for name in (*_SAVED, *self.saved)}
        return {self.settings.method: {**state, 'exploration': self.exploration.values}}

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> Self:
        """Return a saved filter; it continues bit for bit as the saved one would have."""
        kinds = {**_SAVED, **cls.saved}
        state = {name: TypeAdapter(kinds[name]).validate_python(saved[name]) for name in kinds}
        search = cls(state['settings'], Area(state['environment']), state['generator'])
        search.exploration.values[...] = saved['exploration']
        for name in ('clusters', *cls.saved):
            setattr(search, name, state[name])
        return search
