"""Searches with several planners and filters on the same seeds, as an experiment."""

from __future__ import annotations

import hashlib
import inspect
import pkgutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_planner.settings import PLANNERS
from maasi_sim.buildings.scenario import is_cuboid_scenario
from maasi_sim.experiments.experiment import Case, Experiment, Outcome
from maasi_sim.experiments.figures import draw_comparison
from maasi_sim.experiments.searches import outcome_of
from maasi_sim.machine import code_digest
from maasi_sim.scenario.layering import Key, ScenarioError
from maasi_sim.scenario.loading import (
    find_scenario,
    load_scenario,
    read_scenario,
    scenario_from_content,
)
from maasi_sim.scenario.schema import Scenario
from maasi_sim.search import leaving, search
from maasi_sim.search_result import SearchResult


def comparison_of(name: str, cases: Sequence[Case]) -> Experiment:
    """Return searches as an experiment; differences are to the first case.

    The cases have settings from `search_settings`.
    """
    return Experiment(
        name=name,
        title='Searches on the same seeds',
        cases=lambda small: list(cases),
        run=run_compared,
        quantities=(),
        draw=lambda figure, results: draw_comparison(figure, [results]),
        compared=True,
    )


def search_settings(scenario: Scenario, planner: str | None = None) -> dict[str, Any]:
    """Return the settings of a case.

    `planner` is a function to make planners, as of `search`, as `module:function`; None: the
    scenario's planner.
    """
    return {'scenario': scenario.content(), 'planner': planner, 'code': code_of(scenario)}


def code_of(scenario: Scenario) -> str:
    """Return a hash of the code of a search, including the file of a user's own planner."""
    name = scenario.planner.name
    if name in PLANNERS.own:
        return code_digest()
    file = inspect.getsourcefile(PLANNERS.load(name))
    own = Path(file).read_bytes() if file is not None else b''
    return f'{code_digest()} {hashlib.sha256(own).hexdigest()[:16]}'


def run_compared(settings: dict[str, Any], seed: int) -> Outcome:
    """Run a search of a case; RuntimeError if the code differs from that of the settings."""
    scenario = scenario_from_content(settings['scenario'], 'settings')
    if settings['code'] != code_of(scenario):
        raise RuntimeError('this worker has another version of the code')
    limit = scenario.limits.time
    planner = settings['planner'] and pkgutil.resolve_name(settings['planner'])
    result = search(scenario, seed, planner=planner)
    outcome = outcome_of(result, None, limit)
    times = find_times(result, limit)
    complete = outcome.summary['time_to_find_all']
    outcome.summary['complete'] = complete is not None
    outcome.summary['time'] = limit if complete is None else complete
    outcome.summary['mean_time'] = float(times.mean()) if len(times) else None
    outcome.timing['slowest_decision'] = max(result.planning_times, default=0.0)
    return outcome


def find_times(result: SearchResult, limit: float) -> NDArray[np.float64]:
    """Return when the first, second and so on of the true targets was found, (n,) [s].

    A target that was not found counts with the limit.
    """
    times = np.full(len(result.truth), limit)
    for item in reversed(result.progress):
        times[: item.true_found] = np.minimum(times[: item.true_found], item.time)
    return times


def compared(
    scenario: str | Path,
    planners: Sequence[str] = (),
    filters: Sequence[str] = (),
    time_limit: float | None = None,
) -> Experiment:
    """Return the comparison of planners and filters in a scenario.

    `planners` and `filters` are values of `planner.name` and `filter.method`; without any, the
    scenario's own. `time_limit` is instead of the scenario's [s].
    """
    path = find_scenario(scenario)
    if is_cuboid_scenario(read_scenario(path)):
        raise ScenarioError(f'{path}: is a search of buildings, allowed are searches for targets')
    cases = []
    for method in filters or (None,):
        for planner in planners or (None,):
            # Many searches run in parallel; results do not depend on the number of threads.
            overrides: dict[str, tuple[Key, Any]] = {'one process': (('filter', 'threads'), 1)}
            if planner is not None:
                overrides['--planners'] = ('planner', 'name'), planner
            if method is not None:
                overrides['--filters'] = ('filter', 'method'), method
            if time_limit is not None:
                overrides['--time-limit'] = ('limits', 'time'), time_limit
            loaded = load_scenario(path, overrides)
            try:
                leaving(loaded)
            except ValueError as error:
                raise ScenarioError(f'{path}: {error}') from None
            names = [planner or loaded.planner.name]
            if len(filters) > 1:
                names.append(str(method))
            cases.append(Case(', '.join(names), search_settings(loaded)))
    return comparison_of(path.stem, cases)
