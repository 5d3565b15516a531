"""Plugins: classes found by entry point or by `module:Class` (docs/plugins.md)."""

import contextlib
import difflib
import importlib
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint, distributions
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationInfo
from pydantic.fields import FieldInfo

_NAME = r'[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*'
_REFERENCE = re.compile(f'{_NAME}:{_NAME}')
# Folders of modules named in `module:Class`, the last added first.
_folders: list[str] = []


@cache
def _entry_points(folder: str) -> list[EntryPoint]:
    return [point for found in distributions(path=[folder]) for point in found.entry_points]


class PluginError(ValueError):
    """A plugin is unknown, cannot be imported, or does not fit its interface."""


def is_reference(text: Any) -> bool:
    """Return whether a value has the form `module:Class`."""
    return isinstance(text, str) and _REFERENCE.fullmatch(text) is not None


def unknown(read: Any, known: Sequence[str], what: str) -> str:
    """Return the error text for an unknown name, with the closest known one first."""
    close = difflib.get_close_matches(str(read), known, n=1, cutoff=0.6)
    hint = f" (did you mean '{close[0]}'?)" if close else ''
    return f'unknown {what} {read!r:.60}{hint}, known are {", ".join(known)}'


def add_folders(folders: Iterable[str | Path]) -> list[str]:
    """Add folders to the search path of modules, after installed packages; return them."""
    given = [str(Path(folder).absolute()) for folder in folders]
    for folder in reversed(given):
        if folder in _folders:
            _folders.remove(folder)
        _folders.insert(0, folder)
        if folder not in sys.path:
            sys.path.append(folder)
    return given


@dataclass(frozen=True)
class PluginGroup:
    """Classes of one kind: built in, from installed packages, or named by `module:Class`."""

    group: str  # name of the group of entry points
    what: str  # kind of plugin, for messages
    base: str  # base class, as `module:Class`
    built_in: Mapping[str, str] = field(hash=False)  # by name: `module:Class`

    def names(self) -> list[str]:
        """Return all names: those of the suite, then those of installed packages."""
        return [*sorted(self.built_in), *sorted(set(self._installed()) - set(self.built_in))]

    def load(self, name: str) -> type:
        """Return the class of one of `names` or of `module:Class`; PluginError if unusable."""
        if name in self.built_in:
            return _attribute(self.built_in[name])
        if is_reference(name):
            add_folders([*_folders, Path.cwd()])
            found = _attribute(name, named=True)
        else:
            installed = self._installed()
            if name not in installed:
                raise PluginError(self._unknown(name, self.names()))
            try:
                found = _attribute(installed[name].value.partition('[')[0].strip())
            except PluginError as error:
                raise PluginError(f'{self.what} {name!r}: {error}') from error
        base = _attribute(self.base)
        if not (isinstance(found, type) and issubclass(found, base)):
            raise PluginError(f'{name} is not a subclass of {self.base.replace(":", ".")}')
        if inspect.isabstract(found):
            lacking = ', '.join(sorted(found.__abstractmethods__))  # type: ignore[attr-defined]
            raise PluginError(f'{name} lacks {lacking} of {self.base.replace(":", ".")}')
        return found

    def check(self, name: str) -> str:
        """Return a name that can be loaded; a validator for settings."""
        if name not in self.built_in:
            self.load(name)
        return name

    def check_known(self, name: str) -> str:
        """Return a known name without importing its class; a validator for settings."""
        if name not in self.built_in and not is_reference(name) and name not in self._installed():
            raise PluginError(self._unknown(name, self.names()))
        return name

    def settings(self, name: str) -> type[BaseModel] | None:
        """Return a plugin's attribute `Settings`, the model of its settings, or None."""
        if name in self.built_in:
            return None
        model = getattr(self.load(name), 'Settings', None)
        if model is None:
            return None
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            raise PluginError(f'{name}: its Settings are not a pydantic model')
        return model

    def _installed(self) -> dict[str, EntryPoint]:
        # The first one on the path counts.
        points = [item for folder in reversed(sys.path) for item in _entry_points(folder)]
        return {item.name: item for item in points if item.group == self.group}

    def _unknown(self, name: str, known: list[str]) -> str:
        return f'{unknown(name, known, self.what)}, and your own module:Class'


@dataclass(frozen=True)
class OwnSettings:
    """Marks a settings field that holds the settings of a plugin."""

    group: PluginGroup  # kind of the plugin
    selector: str  # earlier field, which names the plugin

    def check(self, value: Any, info: ValidationInfo) -> BaseModel | None:
        """Return the plugin's settings; a validator of the marked field."""
        name = info.data.get(self.selector)
        model = None if name is None else self.group.settings(name)
        if model is not None:
            return model.model_validate({} if value is None else value, strict=True)
        if value and name is not None:
            raise ValueError(f"{self.group.what} '{name}' has no settings")
        return None


@dataclass(frozen=True)
class ChosenSettings:
    """Marks a settings field whose model depends on its values."""

    choose: Callable[[Mapping[str, Any]], type[BaseModel]]  # or ValueError
    models: Callable[[], Mapping[str, type[BaseModel]]]  # by the values that choose them

    def check(self, value: Any) -> Any:
        """Return the settings for values; a validator of the marked field."""
        if not isinstance(value, Mapping):
            return value
        # YAML's null stands for the default.
        given = {key: item for key, item in value.items() if item is not None}
        return self.choose(given).model_validate(given, strict=True)


def own_settings(
    info: FieldInfo, sibling: Callable[[str], Any], values: Callable[[], Mapping[str, Any]]
) -> Any:
    """Return the model of a marked field for its values, or None without a mark."""
    for mark in info.metadata:
        # An error is reported where the values are checked.
        with contextlib.suppress(ValueError):
            if isinstance(mark, ChosenSettings):
                return mark.choose(values())
            if isinstance(mark, OwnSettings) and isinstance(name := sibling(mark.selector), str):
                return mark.group.settings(name)
    return None


def _attribute(reference: str, named: bool = False) -> Any:
    name, _, attribute = reference.partition(':')
    if named:
        importlib.invalidate_caches()
    try:
        module = importlib.import_module(name)
    except (Exception, SystemExit) as error:
        raise PluginError(_import_problem(name, error)) from error
    if named:
        _check_file(name, module)
    found: Any = module
    for part in attribute.split('.'):
        if not hasattr(found, part):
            classes = [
                key
                for key, value in vars(module).items()
                if isinstance(value, type) and value.__module__ == name
            ]
            raise PluginError(
                f'module {name} has no {attribute}'
                + (f', its classes are {", ".join(sorted(classes))}' if classes else '')
            )
        found = getattr(found, part)
    return found


def _import_problem(name: str, error: BaseException) -> str:
    missing = getattr(error, 'name', None)
    if isinstance(error, ModuleNotFoundError) and missing and f'{name}.'.startswith(f'{missing}.'):
        return (
            f'there is no module {missing}: it is not installed, and not in '
            f'{", ".join(_folders) or "any folder of plugins"}'
        )
    location = ''
    if isinstance(error, SyntaxError) and error.filename:
        location = f' ({error.filename}:{error.lineno})'
    elif frames := traceback.extract_tb(error.__traceback__):
        location = f' ({frames[-1].filename}:{frames[-1].lineno})'
    text = ' '.join(str(error).split())[:300]
    return f'module {name} cannot be imported: {type(error).__name__}: {text}{location}'


def _check_file(name: str, module: Any) -> None:
    """Raise PluginError if another module of that name hides the file next to the scenario."""
    top = name.partition('.')[0]
    for folder in _folders:
        spec = PathFinder.find_spec(top, [folder])
        if spec is None or spec.origin is None:
            continue
        loaded = getattr(sys.modules.get(top), '__file__', None)
        if loaded is not None and Path(loaded).resolve() != Path(spec.origin).resolve():
            raise PluginError(
                f'module {top} is {loaded} already, and {spec.origin} is another; give it another '
                'name'
            )
        return
