"""Scenario files: found by name, merged with robot types, and checked."""

import os
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import deepcopy
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, TypeVar

from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.geometry.readers import FILES
from maasi_filter.plugins import is_reference, unknown
from maasi_planner.settings import shared_values
from maasi_sim.scenario.base import BaseScenario
from maasi_sim.scenario.checks import (
    Problems,
    covering_grid,
    problems_of,
    problems_of_file,
    warnings_about,
)
from maasi_sim.scenario.layering import (
    Key,
    Layer,
    ScenarioError,
    ScenarioWarning,
    merge,
    read_layer,
    under,
    validate,
)
from maasi_sim.scenario.on_earth import put_on_map
from maasi_sim.scenario.schema import RobotSettings, Scenario

AnyScenario = TypeVar('AnyScenario', bound=BaseScenario)


def config_folder() -> Path:
    """Return the folder of `robots/` and `scenarios/`: of ROS, of pip, or of this repository."""
    folders = []
    with suppress(ImportError, LookupError, OSError):
        from ament_index_python.packages import get_package_share_directory

        folders.append(Path(get_package_share_directory('maasi_config')))
    with suppress(PackageNotFoundError):
        for item in distribution('maasi_config').files or []:
            if item.match('share/maasi_config/package.xml'):
                folders.append(Path(os.path.normpath(item.locate())).parent)
    folders.append(Path(__file__).resolve().parents[3] / 'config')
    for folder in folders:
        # If these are links to files of a repository, messages name those files.
        for file in (folder / 'robots').glob('*.yaml'):
            return file.resolve().parent.parent
    raise ScenarioError(f'robots: folder not found in {", ".join(map(str, folders))}')


def find_scenario(name: str | Path) -> Path:
    """Return the file of a scenario.

    Parameters
    ----------
    name : str or Path
        A file, or the name of a scenario in `config/scenarios`.

    Raises
    ------
    ScenarioError
        If no scenario has this name.
    """
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

    Types are searched in `robots/` next to the scenario file and next to its folder, then in
    `config/robots`.

    Parameters
    ----------
    path : str or Path
        Scenario file, or the name of one in `config/scenarios`.
    overrides : mapping, optional
        Values that override the file's: origin (for messages), key and value.

    Returns
    -------
    Scenario

    Raises
    ------
    ScenarioError
        If the file cannot be read, or a key is not allowed; names file, line and key.
    """
    return check_scenario(read_scenario(path), overrides)


def read_scenario(path: str | Path) -> Layer:
    """Return the merged but unchecked values of a scenario file."""
    path = find_scenario(path)
    layer = _with_folders(_with_types(read_layer(path), path))
    environment = layer.data.get('environment')
    if isinstance(environment, dict):
        layer.data['environment'] = _with_files(environment, path.parent)
    return layer


def _with_files(value: Any, folder: Path) -> Any:
    if isinstance(value, dict):
        return {key: _with_files(item, folder) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_files(item, folder) for item in value]
    is_file = isinstance(value, str) and Path(value).suffix.lower() in FILES
    return str((folder / value).absolute()) if is_file else value


def _with_folders(layer: Layer) -> Layer:
    """Return a layer with the folders of plugin modules, if it names a plugin as module:Class."""
    key, folder = ('plugin_path',), layer.folder or Path.cwd()
    given = layer.data.get('plugin_path', [])
    if not isinstance(given, list) or not all(isinstance(item, str) for item in given):
        return layer
    folders = [folder / item for item in given]
    if _names_module(layer.data):
        folders += [folder, Path.cwd()]
    absolute = list(dict.fromkeys(str(item.absolute()) for item in folders))
    return merge(layer, under(key, absolute, {key: layer.origin(key)}, layer.folder))


def _names_module(data: Any) -> bool:
    if isinstance(data, dict):
        return any(_names_module(item) for item in data.values())
    return is_reference(data)


def scenario_from_values(values: dict[str, Any], origin: str) -> Scenario:
    """Return the scenario of values as in a scenario file or from `Scenario.content`.

    Types come from config/robots. Values from programs get no warnings.
    """
    layer = Layer(deepcopy(values), {(): origin})
    return check_scenario(_with_types(layer, config_folder() / 'scenarios' / origin))


def check_scenario(
    layer: Layer, overrides: Mapping[str, tuple[Key, Any]] | None = None
) -> Scenario:
    """Return the scenario of a tree of values with all layers merged."""
    put_on_map(layer, _robots(layer))
    _give_candidates(layer)
    problems = problems_of_file if layer.folder else problems_of
    return checked(Scenario, layer, overrides, problems)


def checked(
    model: type[AnyScenario],
    layer: Layer,
    overrides: Mapping[str, tuple[Key, Any]] | None,
    problems: Callable[[AnyScenario], Problems],
) -> AnyScenario:
    """Return the scenario of merged values with overrides, or raise its problems."""
    if overrides:
        # Errors of the file are reported even if they are overridden.
        validate(model, layer)
        for origin, (key, value) in overrides.items():
            # Settings of the planner or filter that is replaced.
            if key == ('filter', 'method'):
                layer.data.get('filter', {}).pop('settings', None)
            elif key == ('planner', 'name') and model is Scenario:
                layer.data['planner'] = shared_values(value, layer.data.get('planner', {}))
            layer = merge(layer, under(key, value, {key: origin}, layer.folder))
        layer = _with_folders(layer)
    scenario = validate(model, layer)
    # Some are found for filter and planner, or for several robots.
    lines = dict.fromkeys(layer.located(problem) for problem in problems(scenario))
    if lines:
        raise ScenarioError('\n'.join(lines))
    for warning in warnings_about(scenario) if layer.folder else ():
        warnings.warn(layer.located(warning), ScenarioWarning, stacklevel=2)
    return scenario


def _give_candidates(layer: Layer) -> None:
    """Give robots without candidates a grid that sees everything."""
    for name, values in _robots(layer).items():
        if values.get('candidates') is None:
            values['candidates'] = {'ring': 4, 'distance': 1.0}
            # Validation reports errors later.
            with suppress(ValueError):
                robot = RobotSettings.model_validate(values)
                environment = EnvironmentSettings.model_validate(layer.data.get('environment'))
                values['candidates'] = covering_grid(name, robot, environment)


def _with_types(layer: Layer, path: Path) -> Layer:
    folders = [path.parent / 'robots', path.parent.parent / 'robots', config_folder() / 'robots']
    files = {file.stem: file for folder in reversed(folders) for file in folder.glob('*.yaml')}
    known = sorted(files.keys() - {'all'})
    robots = _robots(layer)
    # In the order of the file.
    types = [Layer({'robots': {name: {} for name in robots}})]
    measured = {name: _taken_external(own) for name, own in robots.items()}
    for name, own in robots.items():
        if own.keys() >= RobotSettings.model_fields.keys():
            # From a run: with all layers merged, without files of types.
            continue
        kind = own.get('type')
        if kind not in known:
            problem = unknown(kind, known, 'robot type')
            raise ScenarioError(layer.located(f'robots.{name}.type: {problem}'))
        key: Key = ('robots', name)
        types += [read_layer(files[item], key) for item in ('all', kind) if item in files]
    result = merge(*types, layer)
    for name, taken in measured.items():
        other = 'sensor' if result.data['robots'][name].get('camera') is None else 'camera'
        if taken not in ('', other):
            problem = f"robots.{name}.{taken}: read 'external', but it measures by its {other}"
            raise ScenarioError(layer.located(f'{problem}; allowed is {other}: external'))
    return result


def _taken_external(own: dict[str, Any]) -> str:
    """Replace `camera: external` or `sensor: external` by `measurements`; return the key."""
    for key in ('camera', 'sensor'):
        if own.get(key) == 'external':
            # The settings of the type remain.
            del own[key]
            own['measurements'] = 'external'
            return key
    return ''


def _robots(layer: Layer) -> dict[str, dict[str, Any]]:
    """Return the settings of robots that have any, unchecked."""
    robots = layer.data.get('robots')
    if not isinstance(robots, dict):
        return {}
    return {name: own for name, own in robots.items() if isinstance(own, dict)}


def robot_type(name: str) -> RobotSettings:
    """Return a robot of a type in `config/robots`."""
    candidates = {'ring': 4, 'distance': 1.0}
    content = {'type': name, 'start': [0.0, 0.0, 0.0], 'candidates': candidates}
    layer = Layer({'robots': {name: content}}, {(): f'robot type {name}'})
    layer = _with_types(layer, config_folder() / 'scenarios' / name)
    return validate(RobotSettings, Layer(layer.data['robots'][name], layer.origins))
