"""Conversion between settings and flat ROS parameters, and their help, without ROS.

Names of nested settings are joined by dots, and None is omitted. Lists of lists of fixed length
become one list, `bounds: [-0.3, 2.4, -0.3, 2.4]`. Other lists of lists and of small settings become
lists of strings, `obstacles: ['0.8 1.2 0.1']`, which are also accepted for the former. Settings by
name, `robots`, become the list `robots` and `robot.<name>.<key>`.
"""

import inspect
import re
import textwrap
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from shapely.geometry.base import BaseGeometry

from maasi_filter.plugins import ChosenSettings, PluginGroup, own_settings


@dataclass(frozen=True)
class ParameterField:
    """One parameter of a node: its dotted name, its keys in nested settings, its field."""

    name: str
    keys: tuple[str, ...]
    info: FieldInfo

    @property
    def default(self) -> Any:
        """Default value, or None without one."""
        if self.info.is_required() or _by_name(self.info.annotation):
            return None
        value = self.info.get_default(call_default_factory=True)
        return None if value in ([], ()) else _as_parameter(value, self.info.annotation)

    @property
    def constraints(self) -> str:
        """Text of the allowed values."""
        words = {'ge': 'at least', 'gt': 'above', 'le': 'at most', 'lt': 'below'}
        limits = {key: self.bound(key) for key in words}
        parts = [f'{words[key]} {limit}' for key, limit in limits.items() if limit is not None]
        for kind in choices(self.info.annotation):
            if get_origin(kind) is Literal:
                parts.append(f'one of {", ".join(map(str, get_args(kind)))}')
        for item in self.info.metadata:
            if isinstance(item, PluginGroup):
                parts.append(f'one of {", ".join(item.names())}, or module:Class')
        return ' and '.join(parts)

    def bound(self, *kinds: str) -> Any:
        """Return the first bound of these kinds, such as 'ge', or None."""
        found = (getattr(item, kind, None) for item in self.info.metadata for kind in kinds)
        return next((value for value in found if value is not None), None)


def parameter_fields(
    model: type[BaseModel], given: Mapping[str, Any], prefix: str = '', keys: tuple[str, ...] = ()
) -> Iterator[ParameterField]:
    """Yield the parameters of settings; the `given` values determine robots and parts."""
    for name, info in model.model_fields.items():
        key = info.alias or name
        full, path = prefix + key, (*keys, key)
        inside = partial(_inside, given, f'{full}.')
        nested = own_settings(info, lambda selector: given.get(prefix + selector), inside)
        nested = nested or _nested(info.annotation)
        if nested is None:
            yield ParameterField(full, path, info)
            if by_name := _by_name(info.annotation):
                for item in given.get(full) or []:
                    inner = f'{full.removesuffix("s")}.{item}.'
                    yield from parameter_fields(by_name, given, inner, (*path, item))
        elif type(None) not in get_args(info.annotation) or any(
            item.startswith(f'{full}.') for item in given
        ):
            yield from parameter_fields(nested, given, f'{full}.', path)


def _inside(given: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {key.removeprefix(prefix): given[key] for key in given if key.startswith(prefix)}


def flatten(settings: BaseModel, prefix: str = '') -> dict[str, Any]:
    """Return settings as flat parameters, whose names begin with a prefix."""
    flat: dict[str, Any] = {}
    for name, info in type(settings).model_fields.items():
        value = getattr(settings, name)
        key = prefix + (info.alias or name)
        if isinstance(value, BaseModel):
            flat |= flatten(value, f'{key}.')
        elif value is None or value in ([], (), {}):
            continue
        elif _by_name(info.annotation):
            flat[key] = sorted(value)
            for item in sorted(value):
                flat |= flatten(value[item], f'{key.removesuffix("s")}.{item}.')
        else:
            flat[key] = _as_parameter(value, info.annotation)
    return flat


def unflatten(model: type[BaseModel], flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return flat parameters as nested values; ValueError names an invalid one."""
    nested: dict[str, Any] = {}
    for item in parameter_fields(model, flat):
        # Parts without values are created, too, so that errors name the missing keys.
        owner = nested
        for key in item.keys[:-1]:
            owner = owner.setdefault(key, {})
        value = flat.get(item.name)
        if _by_name(item.info.annotation):
            owner[item.keys[-1]] = {}
        elif isinstance(value, (str, bool, int, float)):
            owner[item.keys[-1]] = value
        elif value is not None:
            try:
                owner[item.keys[-1]] = _from_list(value, item.info.annotation)
            except (ValueError, AttributeError, IndexError):
                width = _width(item.info.annotation)
                rows = f'rows of {width} numbers' if width else 'texts of numbers'
                raise ValueError(f'{item.name}: got {list(value)}, allowed are {rows}') from None
    return nested


# Lists.


def _as_parameter(value: Any, annotation: Any) -> Any:
    """Return a value with rows of a list as numbers or, for variable lengths, texts."""
    if not isinstance(value, (list, tuple)):
        return str(value) if isinstance(value, BaseGeometry) else value
    rows = [_as_row(item) for item in value]
    if _width(annotation) is not None:
        return [number for row in rows for number in row]
    return [' '.join(map(repr, row)) if isinstance(row, list) else row for row in rows]


def _as_row(item: Any) -> Any:
    if isinstance(item, BaseModel):
        return str(item)
    return [float(number) for number in item] if isinstance(item, (list, tuple)) else item


def _from_list(value: Sequence[Any], annotation: Any) -> list[Any]:
    element, width = _argument(annotation, list), _width(annotation)
    # Small settings such as zones read texts.
    if _nested(element) is not None or _argument(element, list) is None:
        return list(value)
    if width is not None and not any(isinstance(item, str) for item in value):
        return list(np.reshape(value, (-1, width)).tolist())
    return [[float(word) for word in text.split()] for text in value]


# Types of fields.


def choices(annotation: Any) -> list[Any]:
    """Return the types of an annotation: members of a union, without metadata."""
    if get_origin(annotation) is Annotated:
        return choices(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return [inner for item in get_args(annotation) for inner in choices(item)]
    return [annotation]


def _argument(annotation: Any, kind: type) -> Any:
    found = [get_args(item)[-1] for item in choices(annotation) if get_origin(item) is kind]
    return found[0] if found else None


def _width(annotation: Any) -> int | None:
    element = _argument(annotation, list)
    if _argument(element, list) is None:
        return None
    parts = FieldInfo.from_annotation(element).metadata
    lengths = [getattr(part, 'min_length', getattr(part, 'max_length', None)) for part in parts]
    return lengths[0] if len(lengths) == 2 and lengths[0] == lengths[1] else None


def _nested(annotation: Any) -> type[BaseModel] | None:
    models = [item for item in choices(annotation) if inspect.isclass(item)]
    return next((item for item in models if issubclass(item, BaseModel)), None)


def _by_name(annotation: Any) -> type[BaseModel] | None:
    return _nested(_argument(annotation, dict))


# Help.


def parameters_of(node: type) -> Iterator[ParameterField]:
    """Yield the parameters of a class of nodes, with NAME for robots, for all selectable models."""
    model = next(
        argument
        for kind in node.__mro__
        for base in kind.__dict__.get('__orig_bases__', ())
        for argument in get_args(base)
        if inspect.isclass(argument) and issubclass(argument, BaseModel)
    )
    tables = (item.name for item in parameter_fields(model, {}) if _by_name(item.info.annotation))
    fields = {i.name: i for i in parameter_fields(model, {key: ['NAME'] for key in tables})}
    for name, info in model.model_fields.items():
        for mark in info.metadata:
            for chosen in mark.models().values() if isinstance(mark, ChosenSettings) else ():
                found = parameter_fields(chosen, {}, f'{name}.', (name,))
                fields = {item.name: item for item in found} | fields
    yield from fields.values()


# Sections of docstrings that are for programmers.
_FOR_PROGRAMMERS = ('Parameters', 'Attributes', 'Notes')


def node_help(node: type, name: str, base: type) -> str:
    """Return the help of a class of nodes from its docstrings, down to `base`, and settings."""
    text = [
        f'usage: {name} [--ros-args [--params-file FILE] [-p NAME:=VALUE] '
        '[-r __ns:=/NAMESPACE] ...]'
    ]
    sections: dict[str, list[str]] = {}
    for kind in node.__mro__[: node.__mro__.index(base) + 1]:
        doc = inspect.cleandoc(kind.__dict__.get('__doc__') or '')
        description, *rest = re.split(r'^(\w+)\n-+\n', doc, flags=re.M)
        found = dict(zip(rest[::2], rest[1::2], strict=True))
        found = {title: found[title] for title in found if title not in _FOR_PROGRAMMERS}
        if kind is not base and (kind is node or found):
            text.append(description.strip())
        for title, content in found.items():
            sections.setdefault(title, []).append(content.strip())
    for title, contents in sections.items():
        text.append(f'{title}\n{"-" * len(title)}\n' + ';\n'.join(contents))
    text.append('ROS parameters\n--------------')
    for item in parameters_of(node):
        words = [
            item.info.description,
            item.constraints and f'allowed: {item.constraints}',
            None if item.default is None else f'default: {written(item.default)}',
        ]
        indent = ' ' * 6
        text[-1] += f'\n  {item.name}\n' + textwrap.fill(
            '; '.join(filter(None, words)), 96, initial_indent=indent, subsequent_indent=indent
        )
    text.append('Exit codes: 0 ended, 1 failed, 2 wrong parameters.')
    return '\n\n'.join(filter(None, text))


def written(value: Any) -> str:
    """Return a default for people: numbers of up to six digits, texts and lists as in YAML."""
    if isinstance(value, list | tuple):
        return f'[{", ".join(map(written, value))}]'
    if isinstance(value, bool):
        return str(value).lower()
    return f'{value:.6g}' if isinstance(value, float) and value != round(value, 6) else str(value)
