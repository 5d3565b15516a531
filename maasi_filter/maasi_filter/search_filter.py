"""Interface of the search filters, and what all filters share."""

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, TypeAdapter
from typing_extensions import Self

from maasi_filter.arrays import FloatArray
from maasi_filter.found_targets import Change, FoundTargets, merge, restore
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.measurement_check import check_shared
from maasi_filter.records import AgentMeasurement, Cluster, FilterResult, FoundTarget
from maasi_filter.reports import (
    CONFIRMED,
    REJECTED,
    SEARCHED,
    SIGHTING,
    WITHDRAWN,
    Report,
    believed,
    log_odds,
    seen_by_others,
    sighting_of,
)
from maasi_filter.settings import FilterSettings
from maasi_filter.state_file import SavedGenerator, write_state
from maasi_filter.unexplored_map import UnexploredMap

# Saved attributes of every filter with their types; e is saved, too.
_SAVED: dict[str, Any] = {
    'settings': FilterSettings,
    'environment': EnvironmentSettings,
    'generator': SavedGenerator,
    'clusters': list[Cluster],
}
# Of these, files of earlier versions have none.
_SAVED_LISTS: dict[str, Any] = {'reports': list[Report], '_rejected': list[FoundTarget]}


class SearchFilter(ABC):
    """A filter that finds targets from the detections of several robots.

    A subclass implements `step`, updates `clusters` and `exploration`, and adds found targets to
    `register()`. If it stores found targets elsewhere, it overrides `found_targets`, `register` and
    `adopt`.

    Attributes
    ----------
    settings : FilterSettings
        Settings of the filter.
    area : Area
        Search area.
    bounds : (d, 2) array
        Bounding box of the area, metres.
    dimension : int
        2 or 3.
    exploration : UnexploredMap
        e, updated with every measurement.
    clusters : list of Cluster
        Potential targets, heaviest first.
    Settings : type or None
        Model of a plugin's own settings, of which `settings.settings` is an instance.
    own : BaseModel or None
        That instance.
    """

    Settings: ClassVar[type[BaseModel] | None] = None
    #: Types of further saved attributes of a subclass.
    saved: ClassVar[dict[str, Any]] = {'_found': FoundTargets}

    def __init__(
        self, settings: FilterSettings, area: Area | ArrayLike, generator: np.random.Generator
    ) -> None:
        self.settings = settings
        self.exploration = UnexploredMap(area, settings.exploration_spacing)
        self.area = self.exploration.area
        self.environment = self.area.settings
        self.bounds = self.area.bounds
        self.dimension = self.exploration.dimension
        self.generator = generator
        self.clusters: list[Cluster] = []
        self._found = FoundTargets()
        #: Statements of persons that were used, in order.
        self.reports: list[Report] = []
        self._rejected: list[FoundTarget] = []

    @property
    def own(self) -> Any:
        """The plugin's own settings."""
        return self.settings.settings

    def adopt_area(self, area: Area) -> None:
        """Change keep-outs or obstacles: `area` has the same bounds."""
        self.exploration.adopt_area(area)
        self.area, self.environment = self.exploration.area, area.settings

    @property
    def found_targets(self) -> list[FoundTarget]:
        """Targets found so far, in the order of being found."""
        return self._found.targets

    @property
    def particles(self) -> FloatArray:
        """Particles of targets that are not found yet, (n, d), metres; empty if there are none."""
        return np.empty((0, self.dimension))

    @property
    def weights(self) -> FloatArray:
        """Weights of the particles, (n,), which sum to `expected_number`."""
        return np.empty(0)

    @property
    def expected_number(self) -> float:
        """Expected number of detected targets that are not found yet."""
        return float(sum(cluster.mass for cluster in self.clusters))

    @abstractmethod
    def step(
        self, measurements: Sequence[AgentMeasurement], steps: int, time: float
    ) -> FilterResult:
        """Process the measurements of a step: predict, correct and mark found targets.

        Parameters
        ----------
        measurements : sequence of AgentMeasurement
            Measurements M_k of several robots in any order; may be empty.
        steps : int
            Control steps after the previous batch, at least 0; pmb ignores it for static targets.
        time : float
            Time of newly found targets, seconds.

        Returns
        -------
        FilterResult
            Clusters, new targets and warnings.

        Raises
        ------
        ValueError
            If a number is not finite, a covariance is not positive definite, shapes or dimensions
            do not fit, or a robot appears twice. The filter is then unchanged.
        """

    def register(self) -> FoundTargets:
        """Return the found targets with the ids given so far."""
        return self._found

    def adopt(self, change: Change) -> None:
        """Update the state with new, changed or withdrawn found targets."""
        self._found = change.found

    def own_found_targets(self) -> list[FoundTarget]:
        """Return the targets that this filter found itself."""
        return [target for target in self.found_targets if not target.origin]

    def merge(self, others: Mapping[str, Sequence[FoundTarget]]) -> bool:
        """Merge all found targets of the filters of other robots; return whether anything changed.

        Parameters
        ----------
        others : mapping
            For each robot all targets that its filter found itself.

        Raises
        ------
        ValueError
            If a number is not finite, or dimensions do not fit. The filter is then unchanged.
        """
        for robot, targets in others.items():
            check_shared(robot, targets, self.dimension)
        change = merge(self.register(), others)
        self.adopt(change)
        return bool(change)

    def keep_found(self, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Add targets found before this filter existed; return new ones. ValueError as `merge`."""
        check_shared('kept', targets, self.dimension)
        change = restore(self.register(), targets)
        self.adopt(change)
        return change.changed

    @property
    def rejected(self) -> list[FoundTarget]:
        """Found targets that persons rejected, and that can be confirmed again."""
        return self._rejected

    def reviewable(self) -> list[int]:
        """Return the ids of targets that a person can confirm or reject."""
        return [item.id for item in (*self.own_found_targets(), *self.rejected)]

    def use(self, report: Report, time: float, batch: int = 0) -> Report:
        """Use a checked statement of a person after a batch; return it as recorded.

        Found targets may be withdrawn or restored, `clusters` are updated.
        """
        report = replace(report, id=len(self.reports) + 1, time=time, batch=batch)
        if report.target:
            report = replace(report, position=self._position_of(report.target))
        self.reports.append(report)
        if report.kind in (CONFIRMED, REJECTED):
            self.review(report.target, self.statements(report.target))
        self.exploration.use(report)
        self.area = self.exploration.area
        if report.kind == SEARCHED:
            self.thin(report)
        return report

    def _position_of(self, number: int) -> list[float]:
        known = {item.id: item for item in (*self.found_targets, *self.rejected)}
        return [float(value) for value in known[number].position]

    def statements(self, number: int) -> float:
        """Return the log odds of all reviews of a target."""
        reviews = [item for item in self.reports if item.target == number]
        return math.fsum(map(log_odds, reviews))

    def review(self, number: int, statements: float) -> None:
        """Withdraw or restore a found target, given the log odds of all its reviews.

        This filter counts a found target as certain.
        """
        rejects = believed(1.0, statements) < WITHDRAWN
        found = self._found.targets
        source, sink = (found, self._rejected) if rejects else (self._rejected, found)
        for item in [item for item in source if item.id == number]:
            source.remove(item)
            sink.append(item)
            sink.sort(key=lambda target: target.id)

    def thin(self, report: Report) -> None:
        """Reduce the masses of targets that others would have found; e is reduced already."""
        for item in self.clusters:
            seen = seen_by_others(report.shape, report.weight, item.position[None, :])
            item.mass *= 1.0 - float(seen[0])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the whole state, with the random generator, atomically to one file."""
        write_state(path, self.state())

    def state(self) -> dict[str, dict[str, Any]]:
        """Return the whole state, with the random generator, by the name of the method."""
        names = (*_SAVED, *_SAVED_LISTS, *self.saved)
        state = {name: getattr(self, name) for name in names}
        return {self.settings.method: {**state, 'exploration': self.exploration.values}}

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> Self:
        """Return a saved filter, which continues bit for bit."""
        kinds = {**_SAVED, **cls.saved}
        state = {name: TypeAdapter(kinds[name]).validate_python(saved[name]) for name in kinds}
        lists = {
            name: TypeAdapter(kind).validate_python(saved.get(name, []))
            for name, kind in _SAVED_LISTS.items()
        }
        sightings = [sighting_of(item) for item in lists['reports'] if item.kind == SIGHTING]
        area = Area(state['environment'])
        area = area.with_sightings(sightings) if sightings else area
        search = cls(state['settings'], area, state['generator'])
        search.reports, search._rejected = lists['reports'], lists['_rejected']
        search.exploration.values[...] = saved['exploration']
        for name in ('clusters', *cls.saved):
            setattr(search, name, state[name])
        return search
