"""Scenario files: found by name, laid over robot types, and checked."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from copy import deepcopy
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, TypeVar

from maasi_filter.plugins import is_reference
from maasi_filter.settings import EnvironmentSettings
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.checks import Problems, doubts_about, problems_of
from maasi_sim.scenario.layering import (
    Key,
    Layer,
    ScenarioError,
    ScenarioWarning,
    dotted,
    doubt,
    merge,
    override,
    read_layer,
    refuse,
    under,
    unknown,
    validate,
)
from maasi_sim.scenario.schema import RobotSettings, Scenario
from maasi_sim.scenario.visibility import covering_grid

AnyScenario = TypeVar('AnyScenario', bound=BaseScenario)


def config_folder() -> Path:
    """Return the folder of `robots/` and `scenarios/`: of ROS, of pip, or of this repository."""
    places = []
    try:
        from ament_index_python.packages import get_package_share_directory

        places.append(Path(get_package_share_directory('maasi_config')))
    except (ImportError, LookupError, OSError):
        pass
    try:
        files = distribution('maasi_config').files or []
    except PackageNotFoundError:
        files = []
    manifests = [file for file in files if file.match('share/maasi_config/package.xml')]
    places += [Path(os.path.normpath(file.locate())).parent for file in manifests]
    places.append(Path(__file__).resolve().parents[3] / 'config')
    for folder in places:
        # Of links to the files of a repository, messages name those.
        for file in (folder / 'robots').glob('*.yaml'):
            return file.resolve().parent.parent
    raise ScenarioError(f'robots: no such folder in {", ".join(map(str, places))}')


def find_scenario(name: str | Path) -> Path:
    """Return the file of a scenario: a path, or the name of one in `config/scenarios`."""
    path = Path(name)
    if path.exists() or path.suffix or len(path.parts) > 1:
        return path
    folder = config_folder() / 'scenarios'
    known = sorted(item.stem for item in folder.glob('*.yaml'))
    if path.name not in known:
        raise ScenarioError(unknown(path.name, known, 'scenario'))
    return folder / f'{path.name}.yaml'


def load_scenario(
    path: str | Path, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> Scenario:
    """Read a scenario file with its layers: all robots, then the type, then the robot itself.

    Types are looked for in `robots/` beside the scenario file and beside its folder, then in
    `config/robots`.

    Parameters
    ----------
    path : str or Path
        Scenario file, or the name of one in `config/scenarios`.
    overrides : mapping, optional
        Values that win over the file's: where each comes from (for messages), key and value.
    """
    return check_scenario(read_scenario(path), overrides)


def read_scenario(path: str | Path) -> Layer:
    """Return the values of a scenario file with its layers, not checked yet."""
    path = find_scenario(path)
    layer = _with_types(read_layer(path), path)
    _name_folders(layer)
    return layer


def _name_folders(layer: Layer) -> None:
    """Name the folders of modules in `plugin_path`, where a plugin is given as module:Class."""
    folder = layer.folder or Path.cwd()
    given = layer.data.get('plugin_path', [])
    if not isinstance(given, list) or not all(isinstance(item, str) for item in given):
        return
    folders = [folder / item for item in given]
    if _names_module(layer.data):
        folders += [folder, Path.cwd()]
    if folders:
        absolute = dict.fromkeys(str(item.absolute()) for item in folders)
        override(layer, ('plugin_path',), list(absolute), layer.origin(('plugin_path',)))


def _names_module(data: Any) -> bool:
    if isinstance(data, dict):
        return any(_names_module(item) for item in data.values())
    return is_reference(data)


def scenario_from_values(values: dict[str, Any], origin: str) -> Scenario:
    """Return the scenario of values as a scenario file has them: types come from config/robots.

    What a program made gets no warnings.
    """
    layer = Layer(deepcopy(values), {(): origin})
    return _without_warnings(_with_types(layer, config_folder() / 'scenarios' / origin))


def scenario_from_content(content: dict[str, Any], origin: str) -> Scenario:
    """Return the scenario of values with all layers merged, as from `Scenario.content`."""
    return _without_warnings(Layer(content, {(): origin}))


def _without_warnings(layer: Layer) -> Scenario:
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', ScenarioWarning)
        return check_scenario(layer)


def check_scenario(
    layer: Layer, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> Scenario:
    """Return the scenario of a tree of values with all layers merged."""
    return checked(Scenario, _with_candidates(layer), overrides, problems_of)


def checked(
    model: type[AnyScenario],
    layer: Layer,
    overrides: Mapping[str, tuple[Key, Any]] | None,
    problems: Callable[[AnyScenario], Problems],
) -> AnyScenario:
    """Return the scenario of a tree of values, with what wins over them, or raise its problems."""
    if overrides:
        # What wins over the file hides none of its errors.
        validate(model, layer)
        layer = deepcopy(layer)
        for origin, (key, value) in overrides.items():
            if key == ('planner', 'name') and isinstance(layer.data.get('planner'), dict):
                # Of the planner that this one replaces.
                layer.data['planner'].pop('settings', None)
            override(layer, key, value, origin)
        _name_folders(layer)
    scenario = validate(model, layer)
    refuse(layer, problems(scenario))
    doubt(layer, doubts_about(scenario))
    return scenario


def _with_candidates(layer: Layer) -> Layer:
    """Return a tree in which robots without candidates have a grid that sees everything."""
    robots = layer.data.get('robots')
    if not isinstance(robots, dict):
        return layer
    result = deepcopy(layer)
    for name, values in robots.items():
        if isinstance(values, dict) and values.get('candidates') is None:
            candidates: dict[str, Any] = {'ring': 4, 'distance': 1.0}
            try:
                robot = RobotSettings.model_validate({**values, 'candidates': candidates})
                environment = EnvironmentSettings.model_validate(layer.data.get('environment'))
                candidates = covering_grid(name, robot, environment)
            except ValueError:
                # The error is reported when all is validated.
                pass
            key: Key = ('robots', name, 'candidates')
            override(result, key, candidates, layer.origin(key))
    return result


def _with_types(layer: Layer, path: Path) -> Layer:
    """Return a layer over those of the types of its robots."""
    robots = layer.data.get('robots')
    if not isinstance(robots, dict):
        return layer
    # In the order of the file.
    types = [Layer({'robots': {name: {} for name in robots}})]
    for name, own in robots.items():
        if isinstance(own, dict):
            key: Key = ('robots', name)
            types += [under(key, item) for item in _type_layers(own, path, layer, key)]
    return merge(*types, layer)


def _type_layers(own: dict[str, Any], path: Path, layer: Layer, key: Key) -> list[Layer]:
    """Return the layers of a robot's type, for a scenario file."""
    folders = [path.parent / 'robots', path.parent.parent / 'robots', config_folder() / 'robots']
    files: dict[str, Path] = {}
    for folder in folders:
        for file in sorted(folder.glob('*.yaml')):
            files.setdefault(file.stem, file)
    kind, known = own.get('type'), sorted(files.keys() - {'all'})
    if kind not in known and own.keys() >= RobotSettings.model_fields.keys():
        # Of a run: with all layers merged, where the files of types may be missing.
        return []
    if kind is None or (isinstance(kind, str) and kind not in known):
        key = (*key, 'type')
        problem = f'is missing, known are {", ".join(known)}'
        text = problem if kind is None else unknown(kind, known, 'robot type')
        raise ScenarioError(f'{layer.origin(key)}: {dotted(key)}: {text}')
    return [read_layer(files[name]) for name in ('all', str(kind)) if name in files]


def robot_type(name: str) -> RobotSettings:
    """Return a robot of a type in `config/robots`, on its own."""
    content = {
        'type': name,
        'start': [0.0, 0.0, 0.0],
        'candidates': {'ring': 4, 'distance': 1.0},
    }
    origin = f'robot type {name}'
    layer = Layer({}, {(): origin})
    layers = _type_layers(content, config_folder() / 'scenarios' / name, layer, ())
    return validate(RobotSettings, merge(*layers, Layer(content, {(): origin})))
