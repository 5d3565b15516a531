"""YAML files in layers: read, merged and checked, with errors that name file, line and key."""

from __future__ import annotations

import difflib
import math
import re
import typing
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from maasi_filter.plugins import own_settings
from maasi_filter.ros.parameters import choices

Key = tuple[str | int, ...]
Model = TypeVar('Model', bound=BaseModel)


class ScenarioError(ValueError):
    """Invalid input: names file, key, value and what is allowed."""


class ScenarioWarning(UserWarning):
    """Valid input that is hardly meant: names file, key and value."""


# Compiled, where PyYAML was built so: writing takes a third of a second without it.
_Dumper = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)


def to_yaml(content: Any) -> str:
    """Return plain values as YAML, in their order."""
    text: str = yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=100
    )
    return text


# Far more than any scenario has.
_MOST_ENTRIES = 100_000
_STRANGE = yaml.reader.Reader.NON_PRINTABLE


class _Loader(yaml.SafeLoader):
    """A safe loader that also takes `1e-3` for a number, as YAML 1.2 and ROS do."""


_Loader.yaml_implicit_resolvers = {
    first: list(pairs) for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$'),
    list('-+.0123456789'),
)


@dataclass
class Layer:
    """A tree of plain values, and for each key the place that it was read from."""

    data: Any
    origins: dict[Key, str] = field(default_factory=dict)
    #: Of the file.
    folder: Path | None = None

    def origin(self, key: Key) -> str:
        """Return `file:line` of a key, or of the closest key above it."""
        for length in range(len(key), -1, -1):
            if key[:length] in self.origins:
                return self.origins[key[:length]]
        return ''


def read_layer(path: Path) -> Layer:
    """Read a YAML file whose top is a mapping."""
    try:
        text = path.read_text(encoding='utf-8')
    except FileNotFoundError:
        raise ScenarioError(f'{path}: there is no such file') from None
    except IsADirectoryError:
        raise ScenarioError(f'{path}: is a folder, a YAML file is needed') from None
    except UnicodeDecodeError:
        raise ScenarioError(f'{path}: is not text in UTF-8') from None
    except OSError as error:
        raise ScenarioError(f'{path}: cannot be read: {error.strerror}') from None
    strange = _STRANGE.search(text)
    if strange:
        number = text.count('\n', 0, strange.start()) + 1
        raise ScenarioError(
            f'{path}:{number}: is not YAML: read character {ord(strange.group()):#x}, allowed is '
            'text without control characters'
        )
    loader = _Loader(text)
    layer = Layer(None, folder=path.parent)
    try:
        node = loader.get_single_node()
        if node is None:
            raise ScenarioError(f'{path}: is empty, a mapping of keys is needed')
        layer.data = _build(loader, node, (), layer.origins, path)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f'{path}:{mark.line + 1}' if mark else path
        raise ScenarioError(f'{place}: is not YAML: {error.problem}') from None
    except yaml.YAMLError as error:
        raise ScenarioError(f'{path}: is not YAML: {" ".join(str(error).split()):.200}') from None
    except RecursionError:
        raise ScenarioError(f'{path}: is nested too deeply') from None
    finally:
        loader.dispose()
    if not isinstance(layer.data, dict):
        raise ScenarioError(
            f'{path}: read {_show(layer.data)}, a mapping of keys is needed at the top'
        )
    return layer


def _build(
    loader: _Loader,
    node: yaml.Node,
    key: Key,
    origins: dict[Key, str],
    path: Path,
    above: tuple[yaml.Node, ...] = (),
) -> Any:
    """Return the values of a node, and note where each key stands.

    Refused are aliases that hold themselves, or that stand for more than anyone would write.
    """
    place = f'{path}:{node.start_mark.line + 1}'
    if node in above:
        raise ScenarioError(f'{place}: an alias stands inside its own anchor')
    if len(origins) >= _MOST_ENTRIES:
        raise ScenarioError(
            f'{place}: read more than {_MOST_ENTRIES} entries, aliases counted as often as they '
            'stand there'
        )
    origins[key] = place
    above = (*above, node)
    if isinstance(node, yaml.SequenceNode):
        return [
            _build(loader, item, (*key, index), origins, path, above)
            for index, item in enumerate(node.value)
        ]
    if not isinstance(node, yaml.MappingNode):
        return loader.construct_object(node, deep=True)
    mapping: dict[str, Any] = {}
    for key_node, value_node in node.value:
        name = loader.construct_object(key_node, deep=True)
        place = f'{path}:{key_node.start_mark.line + 1}'
        if not isinstance(name, str):
            raise ScenarioError(
                f'{place}: {dotted(key) or "the whole"}: read {_show(name)} as a key, allowed is '
                'text'
            )
        inner = (*key, name)
        if name in mapping:
            raise ScenarioError(f'{place}: {dotted(inner)}: stands there twice')
        mapping[name] = _build(loader, value_node, inner, origins, path, above)
        origins[inner] = place
    return mapping


def under(key: Key, layer: Layer) -> Layer:
    """Return a layer in which the tree of another stands under a key."""
    data = layer.data
    for step in reversed(key):
        data = {step: data}
    return Layer(data, {(*key, *path): origin for path, origin in layer.origins.items() if path})


def merge(*layers: Layer) -> Layer:
    """Merge layers: mappings key by key, anything else is replaced by the later one."""
    result = Layer({}, folder=layers[-1].folder)
    for layer in layers:
        result.data = _merge(result.data, layer.data)
        result.origins.update(layer.origins)
    return result


def _merge(below: Any, above: Any) -> Any:
    if not (isinstance(below, dict) and isinstance(above, dict)):
        return above
    both = {name: _merge(below[name], above[name]) for name in below.keys() & above.keys()}
    return below | above | both


def override(layer: Layer, key: Key, value: Any, origin: str) -> None:
    """Put a value under a key, making the mappings above it; `origin` stands for its place."""
    data = layer.data
    for step in key[:-1]:
        if not isinstance(data.get(step), dict):
            data[step] = {}
        data = data[step]
    data[key[-1]] = value
    layer.origins[key] = origin


def validate(model: type[Model], layer: Layer) -> Model:
    """Return the settings of a tree, strictly by type; an error has one line for each wrong key."""
    try:
        return model.model_validate(layer.data, strict=True)
    except ValidationError as error:
        errors = error.errors(include_url=False)
    problems: dict[Key, list[Any]] = {}
    for item in errors:
        problems.setdefault(_resolve(item['loc'], layer.data, item['type']), []).append(item)
    lines = []
    for key, items in problems.items():
        texts = list(dict.fromkeys(_explain(item, key, model, layer.data) for item in items))
        read = f'read {_show(items[0]["input"])}, '
        texts[1:] = [text.removeprefix(read) for text in texts[1:]]
        origin = layer.origin(key)
        lines.append(f'{origin}: {dotted(key) or "the whole"}: ' + '; or '.join(texts))
    raise ScenarioError('\n'.join(lines))


def refuse(layer: Layer, problems: Iterable[tuple[Key, str]]) -> None:
    """Raise a ScenarioError with one line for each problem between keys, if there is one."""
    lines = [f'{layer.origin(key)}: {dotted(key)}: {text}' for key, text in problems]
    if lines:
        raise ScenarioError('\n'.join(lines))


def doubt(layer: Layer, problems: Iterable[tuple[Key, str]]) -> None:
    """Issue a ScenarioWarning for each problem."""
    for key, text in problems:
        warnings.warn(f'{layer.origin(key)}: {dotted(key)}: {text}', ScenarioWarning, stacklevel=3)


def _resolve(loc: Sequence[str | int], data: Any, kind: str) -> Key:
    """Return the keys of a pydantic location; tags of unions are left out."""
    key: list[str | int] = []
    for index, step in enumerate(loc):
        known = isinstance(data, dict) and step in data
        if isinstance(data, list) and isinstance(step, int):
            known = step < len(data)
        if known:
            data = data[step]
        elif not (kind == 'missing' and index == len(loc) - 1):
            continue
        key.append(step)
    return tuple(key)


def _explain(item: Any, key: Key, model: type[BaseModel], data: Any) -> str:
    kind, context = item['type'], item.get('ctx', {})
    read = f'read {_show(item["input"])}, '
    if kind == 'extra_forbidden':
        return unknown(str(key[-1]), _known_keys(model, key[:-1], data), 'key')
    if kind == 'missing':
        return 'is missing'
    if kind == 'literal_error':
        expected = re.findall(r"'([^']*)'", context['expected']) or [context['expected']]
        return unknown(item['input'], expected, 'value')
    if kind == 'value_error':
        return str(context['error'])
    text = item['msg'].replace('Input should be', 'allowed is').replace(' after validation', '')
    text = re.sub(r'a valid dictionary( or .*)?', 'a mapping of keys', text)
    return f'{read}{text[0].lower()}{text[1:]}'


def unknown(read: Any, known: Sequence[str], what: str) -> str:
    """Return the complaint about an unknown name, with the closest known ones first."""
    close = difflib.get_close_matches(str(read), known, n=1, cutoff=0.6)
    hint = f" (did you mean '{close[0]}'?)" if close else ''
    return f'unknown {what} {_show(read)}{hint}, known are {", ".join(known)}'


def dotted(key: Key) -> str:
    """Return a key as text: `robots.mambo.start[2]`."""
    text = ''
    for step in key:
        text += f'[{step}]' if isinstance(step, int) else f'.{step}' if text else step
    return text


def _known_keys(model: type[BaseModel], key: Key, data: Any) -> list[str]:
    annotations: list[Any] = [model]
    for step in key:
        annotations = [
            inner
            for annotation in annotations
            for candidate in choices(annotation)
            for inner in _inside(candidate, step, data)
        ]
        data = data[step]
    return [
        info.alias or name
        for annotation in annotations
        for candidate in choices(annotation)
        if isinstance(candidate, type) and issubclass(candidate, BaseModel)
        for name, info in candidate.model_fields.items()
    ]


def _inside(annotation: Any, step: str | int, data: Any) -> list[Any]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for name, info in annotation.model_fields.items():
            if step in (name, info.alias):
                return [own_settings(info, data) or info.annotation]
        return []
    if typing.get_origin(annotation) in (list, dict):
        return [typing.get_args(annotation)[-1]]
    return []


def _show(value: Any) -> str:
    if isinstance(value, str):
        return f"'{value}'" if len(value) <= 60 else f"'{value[:57]}...'"
    if isinstance(value, float) and not math.isfinite(value):
        return {math.inf: '.inf', -math.inf: '-.inf'}.get(value, '.nan')
    if value is None:
        return 'nothing'
    if isinstance(value, Mapping):
        return 'a mapping of keys'
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return text if len(text) <= 60 else text[:57] + '...'
