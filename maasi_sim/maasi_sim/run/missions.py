"""Missions from scenario files."""

import importlib
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from maasi_filter.geometry.polygons import InputWarning
from maasi_sim.run.mission import MISSIONS, Mission
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.run_options import Options
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.scenario.layering import Key, ScenarioError
from maasi_sim.scenario.loading import check_scenario, find_scenario, read_scenario

for module in sorted(Path(__file__).parent.glob('*/*_mission.py')):
    importlib.import_module(f'{__package__}.{module.parent.name}.{module.stem}')


def load_mission(
    path: str | Path, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> Mission[Any]:
    """Read a scenario file; parameters and errors as in `load_scenario`."""
    path = find_scenario(path)
    layer = read_scenario(path)
    planner = layer.data.get('planner')
    name = str(planner.get('name')) if isinstance(planner, dict) else ''
    mission = MISSIONS.get(name)
    for origin, (key, value) in (overrides or {}).items():
        if key == ('planner', 'name') and MISSIONS.get(str(value)) is not mission:
            what, allowed = 'a target search', 'a planner of target searches'
            if mission is not None:
                what, allowed = mission.what, f"'{name}'"
            raise ScenarioError(f"{origin}: read '{value}'; {path} is {what}, allowed is {allowed}")
    if mission is None:
        return TargetMission(path.stem, check_scenario(layer, overrides))
    return mission.make(path.stem, layer, overrides)


def checked_mission(options: Options, display: ProgressDisplay) -> Mission[Any]:
    """Return the mission of a run; print its estimate and the warnings about its file."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always', InputWarning)
        mission = load_mission(options.scenario, options.overrides())
    forecast = mission.preflight()
    for line in forecast.lines:
        display.say(line)
    # A file with overrides is validated twice.
    display.warn(*dict.fromkeys(str(warning.message) for warning in caught), *forecast.warnings)
    # A node in the namespace of a robot belongs to that robot.
    if options.namespace.rpartition('/')[2] in mission.scenario.names():
        raise ScenarioError(
            f"--namespace: read '{options.namespace}', allowed is a name that no robot has"
        )
    return mission


def send_warning(mission: Mission[Any], send: Callable[[str], None]) -> None:
    """Send the warning about a scenario."""
    send(mission.warning())
