"""YAML files in layers: read, merged and checked, with errors that name file, line and key."""

import re
import typing
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from maasi_filter.geometry.polygons import InputWarning
from maasi_filter.plugins import own_settings, unknown
from maasi_filter.ros.parameters import choices
from maasi_filter.wording import reason, shown

Key = tuple[str | int, ...]
Model = TypeVar('Model', bound=BaseModel)


class ScenarioError(ValueError):
    """Invalid input: names file, key, value and what is allowed."""


class ScenarioWarning(InputWarning):
    """Valid but improbable input: names file, key and value."""


def print_warnings_plainly() -> None:
    """Print warnings about inputs, from now on, once and without the line of our source."""
    usual, known = warnings.formatwarning, set[str]()

    def text(message: Any, category: type[Warning], *others: Any) -> str:
        if not issubclass(category, InputWarning):
            return usual(message, category, *others)
        # A file is validated several times.
        line = '' if str(message) in known else f'warning: {message}\n'
        known.add(str(message))
        return line

    warnings.formatwarning = text  # type: ignore[assignment]


# The compiled dumper, if available, saves a third of a second.
_Dumper = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)


def to_yaml(content: Any) -> str:
    """Return plain values as YAML, in their order."""
    text: str = yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=100
    )
    return text


_MOST_ENTRIES = 100_000  # far above any scenario


@dataclass
class Layer:
    """A tree of plain values with the file and line of each key."""

    data: Any
    origins: dict[Key, str] = field(default_factory=dict)
    folder: Path | None = None  #: of the file

    def origin(self, key: Key) -> str:
        """Return `file:line` of a key, or of the closest key above it."""
        for length in range(len(key), -1, -1):
            if key[:length] in self.origins:
                return self.origins[key[:length]]
        return ''

    def located(self, problem: str) -> str:
        """Return a problem, `key: text`, preceded by file and line of its key."""
        parts = re.findall(r'[^.[\]]+', problem.partition(': ')[0])
        key = tuple(int(part) if part.isdigit() else part for part in parts)
        return f'{self.origin(key)}: {problem}'


class _Loader(yaml.SafeLoader):
    """A safe loader: `1e-3` is a number; repeated keys and endless aliases are refused."""

    def __init__(self, text: str, path: Path) -> None:
        super().__init__(text)
        self.path = path
        self.origins: dict[Key, str] = {}

    def location(self, node: yaml.Node) -> str:
        """Return `file:line` of a node."""
        return f'{self.path}:{node.start_mark.line + 1}'

    def values(self, node: yaml.Node, key: Key, above: tuple[yaml.Node, ...] = ()) -> Any:
        """Return the values of a node, and store the line of each key."""
        if node in above:
            raise ScenarioError(f'{self.location(node)}: an alias refers to its own anchor')
        if len(self.origins) >= _MOST_ENTRIES:
            raise ScenarioError(
                f'{self.location(node)}: read more than {_MOST_ENTRIES} entries, counting '
                'repeated aliases'
            )
        self.origins.setdefault(key, self.location(node))
        above = (*above, node)
        if isinstance(node, yaml.SequenceNode):
            return [
                self.values(item, (*key, index), above) for index, item in enumerate(node.value)
            ]
        if not isinstance(node, yaml.MappingNode):
            return self.construct_object(node, deep=True)
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            name = self.construct_object(key_node, deep=True)
            inner, location = (*key, name), self.location(key_node)
            if not isinstance(name, str):
                raise ScenarioError(
                    f'{location}: {dotted(key)}: read {shown(name)} as a key, allowed is text'
                )
            if name in mapping:
                raise ScenarioError(f'{location}: {dotted(inner)}: is repeated')
            self.origins[inner] = location
            mapping[name] = self.values(value_node, inner, above)
        return mapping


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$'),
    list('-+.0123456789'),
)


def read_layer(path: Path, key: Key = ()) -> Layer:
    """Read a YAML file with a mapping at the top, as the values under a key."""
    try:
        text = path.read_text(encoding='utf-8')
        loader = _Loader(text, path)
        node = loader.get_single_node()
        data = None if node is None else loader.values(node, key)
    except OSError as error:
        raise ScenarioError(f'{path}: cannot be read: {error.strerror}') from None
    except UnicodeDecodeError:
        raise ScenarioError(f'{path}: is not text in UTF-8') from None
    except yaml.reader.ReaderError as error:
        line = text.count('\n', 0, error.position) + 1
        raise ScenarioError(
            f'{path}:{line}: is not YAML: read character {error.character:#x}, allowed is text '
            'without control characters'
        ) from None
    except yaml.MarkedYAMLError as error:
        location = f'{path}:{error.problem_mark.line + 1}' if error.problem_mark else path
        raise ScenarioError(f'{location}: is not YAML: {error.problem}') from None
    except RecursionError:
        raise ScenarioError(f'{path}: is nested too deeply') from None
    if not isinstance(data, dict):
        raise ScenarioError(f'{path}: read {shown(data)}, a mapping of keys is needed at the top')
    return under(key, data, loader.origins, path.parent)


def under(key: Key, data: Any, origins: dict[Key, str], folder: Path | None = None) -> Layer:
    """Return a layer of a value under a key."""
    for step in reversed(key):
        data = {step: data}
    return Layer(data, origins, folder)


def merge(*layers: Layer) -> Layer:
    """Merge layers: mappings key by key, anything else is replaced by the later one."""
    origins = {key: origin for layer in layers for key, origin in layer.origins.items()}
    return Layer(merged(*(layer.data for layer in layers)), origins, layers[-1].folder)


def merged(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Return mappings merged key by key, later ones on top; anything else is replaced."""
    result: dict[str, Any] = {}
    for layer in layers:
        for key, value in layer.items():
            below = result.get(key)
            both = isinstance(below, Mapping) and isinstance(value, Mapping)
            result[key] = merged(below, value) if both else value  # type: ignore[arg-type]
    return result


def validate(model: type[Model], layer: Layer) -> Model:
    """Return the settings of a tree, strictly by type; an error has a line for each problem."""
    try:
        return model.model_validate(layer.data, strict=True)
    except ValidationError as error:
        errors = error.errors(include_url=False)
    problems = []
    for item in errors:
        key = _key(item, layer.data)
        text = _explain(item, key, model, layer.data)
        problems.append(f'{layer.origin(key)}: {dotted(key)}: {text}')
    raise ScenarioError('\n'.join(dict.fromkeys(problems)))


def _key(item: Any, data: Any) -> Key:
    """Return the key of an error of pydantic, whose location also has tags of unions."""
    key = []
    for step in item['loc']:
        with suppress(KeyError, IndexError, TypeError):
            data = data[step]
            key.append(step)
    return (*key, item['loc'][-1]) if item['type'] == 'missing' else tuple(key)


def _explain(item: Any, key: Key, model: type[BaseModel], data: Any) -> str:
    kind, context = item['type'], item.get('ctx', {})
    if kind == 'extra_forbidden':
        return unknown(str(key[-1]), _known_keys(model, key[:-1], data), 'key')
    if kind == 'missing':
        return 'is missing'
    if kind == 'literal_error':
        expected = re.findall(r"'([^']*)'", context['expected']) or [context['expected']]
        return unknown(item['input'], expected, 'value')
    return reason(item)


def _known_keys(model: Any, key: Key, data: Any) -> list[str]:
    for step in key:
        if hasattr(model, 'model_fields'):
            fields = {info.alias or name: info for name, info in model.model_fields.items()}
            info = fields[str(step)]
            model = own_settings(info, data.get, partial(data.get, step)) or info.annotation
        else:
            model = typing.get_args(model)[-1]
        model = next(item for item in choices(model) if item is not type(None))
        data = data[step]
    return [info.alias or name for name, info in model.model_fields.items()]


def dotted(key: Key) -> str:
    """Return a key as text: `robots.mambo.start[2]`."""
    text = ''.join(f'[{step}]' if isinstance(step, int) else f'.{step}' for step in key)
    return text.removeprefix('.') or 'the whole'
