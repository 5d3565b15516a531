"""A search filter, for nodes, planners and searches in one process; what all filters share."""

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, TypeAdapter
from typing_extensions import Self

from maasi_filter.arrays import FloatArray
from maasi_filter.found_targets import Change, FoundTargets, merge, restore
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.measurement_check import check_taken
from maasi_filter.records import AgentMeasurement, Cluster, FilterResult, FoundTarget
from maasi_filter.settings import FilterSettings
from maasi_filter.state_file import SavedGenerator, write_state
from maasi_filter.unexplored_map import UnexploredMap

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
    finds. One that stores its found targets elsewhere overrides `found_targets`, `register` and
    `adopt`.

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
        self.adopt_area(self.exploration.area)
        self.bounds = self.area.bounds
        self.dimension = self.exploration.dimension
        self.generator = generator
        self.clusters: list[Cluster] = []
        self._found = FoundTargets()

    @property
    def own(self) -> Any:
        """The filter's own settings."""
        return self.settings.settings

    def adopt_area(self, area: Area) -> None:
        """Take another area within the same bounds, as with other keep-outs."""
        self.area, self.environment = area, area.settings
        self.exploration.adopt_area(area)

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

    def adopt(self, change: Change) -> None:
        """Take found targets into the state, of which some are new or changed, or withdrawn."""
        self._found = change.found

    def own_found_targets(self) -> list[FoundTarget]:
        """Return the found targets that this filter found itself."""
        return [target for target in self.found_targets if not target.origin]

    def merge(self, others: Mapping[str, Sequence[FoundTarget]]) -> bool:
        """Merge all that the filters of other robots have found themselves, before `step`.

        Returns whether anything changed; see `found_targets.merge`.

        Raises
        ------
        ValueError
            If a number is not finite, or dimensions do not fit. The filter is then unchanged.
        """
        for robot, targets in others.items():
            check_taken(robot, targets, self.dimension)
        change = merge(self.register(), others)
        self.adopt(change)
        return bool(change)

    def keep_found(self, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Add targets found before this filter was created; return those that are new.

        They keep their ids, except that an id in use is replaced by the next free one. ValueError
        as of `merge`.
        """
        check_taken('kept', targets, self.dimension)
        change = restore(self.register(), targets)
        self.adopt(change)
        return change.changed

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
