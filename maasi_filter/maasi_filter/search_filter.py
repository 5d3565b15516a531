"""Interface of a search filter for nodes, planners and searches in one process."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.records import AgentMeasurement, Cluster, FilterResult, FoundTarget
from maasi_filter.settings import FilterSettings
from maasi_filter.unexplored_map import UnexploredMap


@dataclass
class FilterState:
    """What the saved states of all filters have."""

    settings: FilterSettings
    bounds: FloatArray
    generator: np.random.Generator
    exploration: FloatArray
    clusters: list[Cluster]
    #: Name of the filter, under which its state is saved.
    method: ClassVar[str]

    def check(self, found: Sequence[FoundTarget]) -> None:
        """Refuse clusters and found targets that a filter cannot continue from.

        Raises
        ------
        ValueError
            Naming what was read and what is allowed.
        """
        d = len(self.bounds)
        items: list[Cluster | FoundTarget] = [*self.clusters, *found]
        for item in items:
            shapes = item.position.shape, item.covariance.shape
            # A cluster of equal particles has zero covariance.
            if (
                shapes != ((d,), (d, d))
                or not (np.isfinite(item.position).all() and np.isfinite(item.covariance).all())
                or not np.allclose(item.covariance, item.covariance.T)
                or (np.diagonal(item.covariance) < 0.0).any()
            ):
                raise ValueError(
                    f'{type(item).__name__}: got {item.position.tolist()} with covariance '
                    f'{item.covariance.tolist()}, allowed are finite numbers of {d} dimensions '
                    'and a symmetric matrix with a diagonal from 0'
                )
        ids = [target.id for target in found]
        if min(ids, default=1) < 1 or len(set(ids)) < len(ids):
            raise ValueError(f'found targets: got ids {ids}, allowed are different ones from 1')


class SearchFilter(Protocol):
    """A filter that finds targets from the detections of several robots.

    Attributes
    ----------
    settings : FilterSettings
        As given.
    bounds : (d, 2) array
        Of the environment, metres.
    dimension : int
        2 or 3.
    exploration : UnexploredMap
        e, updated with every measurement.
    clusters : list of Cluster
        Potential targets that are not found, heaviest first.
    """

    settings: FilterSettings
    bounds: FloatArray
    dimension: int
    exploration: UnexploredMap
    clusters: list[Cluster]

    @property
    def found_targets(self) -> list[FoundTarget]:
        """Targets found so far, in the order of being found."""

    @property
    def particles(self) -> FloatArray:
        """(n, d), metres."""

    @property
    def weights(self) -> FloatArray:
        """(n,); they sum to the expected number of targets that are not found yet."""

    @property
    def expected_number(self) -> float:
        """Expected number of targets that are not found yet, of those that were detected."""

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

    def own_found_targets(self) -> list[FoundTarget]:
        """Return the found targets that this filter found itself."""

    def take_over(self, robot: str, targets: Sequence[FoundTarget]) -> bool:
        """Merge targets found by the filter of another robot; return whether anything changed.

        A target that two robots found belongs to the robot that found it first (ties: first by
        name), and follows the estimate of that robot (002, section 4).

        Parameters
        ----------
        robot : str
            Robot of that filter.
        targets : sequence of FoundTarget
            All targets that its filter found itself; call before `step`.

        Raises
        ------
        ValueError
            If a number is not finite, or dimensions do not fit. The filter is then unchanged.
        """

    def keep_found(self, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Add targets found before this filter was created; return those that are new.

        They keep their ids, except that an id in use is replaced by the next free one.

        Raises
        ------
        ValueError
            As of `take_over`.
        """

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the whole state, random generator included, to one file.

        The file is replaced atomically: a crash leaves the old one or the new one.
        """

    def state(self) -> FilterState:
        """Return the whole state, random generator included, for `write_state`."""
