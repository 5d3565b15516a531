"""Interface of the search filters, and what all filters share."""

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
from maasi_filter.measurement_check import check_shared
from maasi_filter.records import AgentMeasurement, Cluster, FilterResult, FoundTarget
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
        self.adopt_area(self.exploration.area)
        self.bounds = self.area.bounds
        self.dimension = self.exploration.dimension
        self.generator = generator
        self.clusters: list[Cluster] = []
        self._found = FoundTargets()

    @property
    def own(self) -> Any:
        """The plugin's own settings."""
        return self.settings.settings

    def adopt_area(self, area: Area) -> None:
        """Change keep-outs or obstacles: `area` has the same bounds."""
        self.area, self.environment = area, area.settings
        self.exploration.adopt_area(area)

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

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the whole state, with the random generator, atomically to one file."""
        write_state(path, self.state())

    def state(self) -> dict[str, dict[str, Any]]:
        """Return the whole state, with the random generator, by the name of the method."""
        state = {name: getattr(self, name) for name in (*_SAVED, *self.saved)}
        return {self.settings.method: {**state, 'exploration': self.exploration.values}}

    @classmethod
    def of(cls, saved: Mapping[str, Any]) -> Self:
        """Return a saved filter, which continues bit for bit."""
        kinds = {**_SAVED, **cls.saved}
        state = {name: TypeAdapter(kinds[name]).validate_python(saved[name]) for name in kinds}
        search = cls(state['settings'], Area(state['environment']), state['generator'])
        search.exploration.values[...] = saved['exploration']
        for name in ('clusters', *cls.saved):
            setattr(search, name, state[name])
        return search
