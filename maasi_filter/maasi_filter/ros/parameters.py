"""Conversion between settings and flat ROS parameters, and their help. Without ROS.

Nested settings become names with dots, and `None` is omitted. Lists of lists of fixed length
become one list, `bounds: [-0.3, 2.4, -0.3, 2.4]`; other lists of lists, and of small settings,
become lists of strings of numbers, `obstacles: ['0.8 1.2 0.1']`, a form that is also accepted for
the former.
Settings by name, `robots`, become the list `robots` and `robot.<name>.<key>`.
"""

from __future__ import annotations

import inspect
import re
import textwrap
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from maasi_filter.plugins import PluginGroup, own_settings

ParameterValue = bool | int | float | str | list[Any]

_WIDTH = 96


@dataclass(frozen=True)
class ParameterField:
    """One parameter of a node: its name with dots, its keys in nested settings, its field."""

    name: str
    keys: tuple[str, ...]
    info: FieldInfo
    #: Whether it stands for a part of the settings, and is no parameter itself.
    part: bool = False

    @property
    def default(self) -> ParameterValue | None:
        """Default value; None: there is none."""
        if self.info.is_required() or _model_by_name(self.info.annotation) is not None:
            return None
        value = self.info.get_default(call_default_factory=True)
        if isinstance(value, (list, tuple)):
            return _as_list(value, self.info.annotation) or None
        return value

    @property
    def constraints(self) -> str:
        """What is allowed, in words."""
        words = {'ge': 'at least', 'gt': 'above', 'le': 'at most', 'lt': 'below'}
        limits = {key: self.bound(key) for key in words}
        parts = [f'{words[key]} {limit}' for key, limit in limits.items() if limit is not None]
        for part in (self.info.annotation, *get_args(self.info.annotation)):
            if get_origin(part) is Literal:
                parts.append('one of ' + ', '.join(str(item) for item in get_args(part)))
        for item in self.info.metadata:
            if isinstance(item, PluginGroup):
                parts.append(f'one of {", ".join(item.names())}, or module:Class')
        return ' and '.join(parts)

    def bound(self, *kinds: str) -> Any:
        """Return the first bound of these kinds, such as 'ge', or None."""
        found = (getattr(item, kind, None) for item in self.info.metadata for kind in kinds)
        return next((value for value in found if value is not None), None)


def parameter_fields(model: type[BaseModel], given: Mapping[str, Any]) -> Iterator[ParameterField]:
    """Yield the parameters of settings; the `given` ones determine which robots and parts exist."""
    return (item for item in _walk(model, given) if not item.part)


def _walk(
    model: type[BaseModel], given: Mapping[str, Any], prefix: str = '', keys: tuple[str, ...] = ()
) -> Iterator[ParameterField]:
    """Yield parameters, and before them the parts of the settings that they belong to."""
    for name, info in model.model_fields.items():
        key = info.alias or name
        full, place = prefix + key, (*keys, key)
        by_name = _model_by_name(info.annotation)
        nested = _nested(info.annotation) or own_settings(info, given, prefix)
        if by_name is not None:
            yield ParameterField(full, place, info)
            for item in given.get(full) or []:
                inner = f'{full.removesuffix("s")}.{item}'
                yield ParameterField(inner, (*place, item), info, part=True)
                yield from _walk(by_name, given, f'{inner}.', (*place, item))
        elif nested is None:
            yield ParameterField(full, place, info)
        elif type(None) not in get_args(info.annotation) or any(
            item.startswith(f'{full}.') for item in given
        ):
            yield ParameterField(full, place, info, part=True)
            yield from _walk(nested, given, f'{full}.', place)


def flatten(settings: BaseModel, prefix: str = '') -> dict[str, ParameterValue]:
    """Return settings as flat parameters, with a prefix of all names."""
    flat: dict[str, ParameterValue] = {}
    for name, info in type(settings).model_fields.items():
        value = getattr(settings, name)
        key = prefix + (info.alias or name)
        if value is None:
            continue
        if isinstance(value, BaseModel):
            flat.update(flatten(value, f'{key}.'))
        elif _model_by_name(info.annotation) is not None:
            if value:
                flat[key] = sorted(value)
            for item in sorted(value):
                flat.update(flatten(value[item], f'{key.removesuffix("s")}.{item}.'))
        elif not isinstance(value, (list, tuple)):
            flat[key] = value
        elif len(value):
            flat[key] = _as_list(value, info.annotation)
    return flat


def unflatten(model: type[BaseModel], flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return flat parameters as nested values for `model.model_validate`.

    ValueError, if a list of numbers is not one, names the parameter.
    """
    nested: dict[str, Any] = {}
    for item in _walk(model, flat):
        owner = nested
        for key in item.keys[:-1]:
            owner = owner[key]
        value = flat.get(item.name)
        if item.part or _model_by_name(item.info.annotation) is not None:
            owner[item.keys[-1]] = {}
        elif isinstance(value, (str, bool, int, float)):
            owner[item.keys[-1]] = value
        elif value is not None:
            owner[item.keys[-1]] = _from_list(item.name, value, item.info.annotation)
    return nested


def parameter_name(
    model: type[BaseModel], location: Iterable[int | str], given: Mapping[str, Any]
) -> str:
    """Return the parameter of a location in nested values, as in errors of pydantic."""
    keys = tuple(map(str, location))
    found = [item for item in _walk(model, given) if item.keys == keys[: len(item.keys)]]
    return max(found, key=lambda item: len(item.keys)).name if found else '.'.join(keys)


# Lists.


def _as_list(value: Sequence[Any], annotation: Any) -> list[Any]:
    if _width(annotation) is not None:
        return [float(number) for item in value for number in item]
    return [_as_text(item) for item in value]


def _as_text(item: Any) -> Any:
    """Return an item of a list; a list or settings become a string of numbers."""
    if isinstance(item, BaseModel):
        item = [item[1] for item in item]
        item = [number for part in item for number in (part if isinstance(part, list) else [part])]
    if isinstance(item, (list, tuple)):
        return ' '.join(repr(float(number)) for number in item)
    return item


def _from_list(key: str, value: Sequence[Any], annotation: Any) -> list[Any]:
    width = _width(annotation)
    if width is None or any(not isinstance(item, (int, float)) for item in value):
        return [_from_text(key, item, annotation) for item in value]
    if len(value) % width:
        raise ValueError(
            f'{key}: got {len(value)} numbers, allowed are multiples of {width}, as '
            'x_min, x_max, y_min, y_max for bounds'
        )
    return [list(value[first : first + width]) for first in range(0, len(value), width)]


def _from_text(key: str, item: Any, annotation: Any) -> Any:
    element = _argument(annotation, list)
    model = _nested(element)
    if not isinstance(item, str) or (model is None and _argument(element, list) is None):
        return item
    try:
        numbers = [float(word) for word in item.split()]
    except ValueError as error:
        raise ValueError(f'{key}: got {item!r}, allowed are numbers with spaces between') from error
    if model is None:
        return numbers
    # All but the last number belong to the list, such as the centre of an obstacle.
    names = list(model.model_fields)
    return {names[0]: numbers[:-1], names[1]: numbers[-1] if numbers else None}


# Types of fields.


def choices(annotation: Any) -> list[Any]:
    """Return the types of an annotation: the members of a union, without metadata."""
    while get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    if get_origin(annotation) in (Union, types.UnionType):
        return [inner for item in get_args(annotation) for inner in choices(item)]
    return [annotation]


def _argument(annotation: Any, kind: type) -> Any:
    """Return the type of the elements of a list, or of the values of a dictionary, or None."""
    found = [get_args(item)[-1] for item in choices(annotation) if get_origin(item) is kind]
    return found[0] if found else None


def _width(annotation: Any) -> int | None:
    """Return the length of the lists in a list, if it is fixed."""
    element = _argument(annotation, list)
    if _argument(element, list) is None:
        return None
    parts = FieldInfo.from_annotation(element).metadata
    lengths = [getattr(part, 'min_length', getattr(part, 'max_length', None)) for part in parts]
    return lengths[0] if len(lengths) == 2 and lengths[0] == lengths[1] else None


def _nested(annotation: Any) -> type[BaseModel] | None:
    models = [item for item in choices(annotation) if inspect.isclass(item)]
    return next((item for item in models if issubclass(item, BaseModel)), None)


def _model_by_name(annotation: Any) -> type[BaseModel] | None:
    return _nested(_argument(annotation, dict))


# Help.


def parameters_of(node: type) -> Iterator[ParameterField]:
    """Yield the parameters of a class of nodes; those of each robot as of one named NAME.

    Its settings are the type argument of one of its bases.
    """
    model = next(
        argument
        for kind in node.__mro__
        for base in kind.__dict__.get('__orig_bases__', ())
        for argument in get_args(base)
        if inspect.isclass(argument) and issubclass(argument, BaseModel)
    )
    tables = [item for item in _walk(model, {}) if _model_by_name(item.info.annotation)]
    return parameter_fields(model, {item.name: ['NAME'] for item in tables})


def node_help(node: type, name: str, base: type) -> str:
    """Return the help of a class of nodes, whose executable has this name.

    Topics are from the docstrings, up to that of `base`.
    """
    text = [
        f'usage: {name} [--ros-args [--params-file FILE] [-p NAME:=VALUE] [-r __ns:=/TEAM] ...]'
    ]
    for kind in node.__mro__[: node.__mro__.index(base) + 1]:
        doc = inspect.cleandoc(kind.__dict__.get('__doc__') or '')
        # Without the sections for who writes code.
        text.append(re.split(r'\n(?:Parameters|Attributes)\n-+\n', doc)[0].strip())
    rows = [_row(item) for item in parameters_of(node)]
    text.append('\n'.join(['ROS parameters', '--------------', *rows]))
    text.append('Exit codes: 0 ended, 1 failed, 2 wrong parameters.')
    return '\n\n'.join(filter(None, text))


def _row(item: ParameterField) -> str:
    default: Any = item.default
    said = [item.info.description or '']
    if item.constraints:
        said.append(f'allowed: {item.constraints}')
    if default is not None:
        said.append(f'default: {str(default).lower() if isinstance(default, bool) else default}')
    indent = ' ' * 6
    words = textwrap.fill('; '.join(said), _WIDTH, initial_indent=indent, subsequent_indent=indent)
    return f'  {item.name}\n{words}'
