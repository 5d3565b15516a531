"""The one place where a scenario file becomes a mission."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from maasi_filter.geometry.polygons import InputWarning
from maasi_sim.run.buildings.building_mission import BuildingMission
from maasi_sim.run.buildings.scenario import NAME, check_cuboid_scenario, is_cuboid_scenario
from maasi_sim.run.mission import Mission
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.scenario.layering import Key, ScenarioError
from maasi_sim.scenario.loading import check_scenario, find_scenario, read_scenario


def load_mission(
    path: str | Path, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> Mission[Any]:
    """Read a scenario file; parameters and errors as of `load_scenario`."""
    path = find_scenario(path)
    layer = read_scenario(path)
    if is_cuboid_scenario(layer):
        for origin, (key, value) in (overrides or {}).items():
            if key == ('planner', 'name') and value != NAME:
                raise ScenarioError(
                    f"{origin}: read '{value}'; {path} is a search of buildings, for which only "
                    f"'{NAME}' is allowed"
                )
        return BuildingMission(path.stem, check_cuboid_scenario(layer, overrides))
    for origin, given in (overrides or {}).items():
        if given == (('planner', 'name'), NAME):
            raise ScenarioError(
                f"{origin}: read '{NAME}', which searches buildings; {path} is a search for "
                'targets, for which any other planner is allowed'
            )
    return TargetMission(path.stem, check_scenario(layer, overrides))


def checked_mission(
    path: str | Path, overrides: Mapping[str, tuple[Key, Any]]
) -> tuple[Mission[Any], list[str]]:
    """Read a scenario file; return what is hardly meant in it as well."""
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter('always', InputWarning)
        mission = load_mission(path, overrides)
    # A file with overrides is read twice.
    return mission, list(dict.fromkeys(str(doubt.message) for doubt in doubts))


def send_warning(mission: Mission[Any], send: Callable[[str], None]) -> None:
    """Send the warning about a scenario."""
    send(mission.warning())
