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
    def description(self) -> str:
        """Meaning and unit."""
        return self.info.description or ''

    @property
    def constraints(self) -> str:
        """What is allowed, in words."""
        return constraints(self.info)

    @property
    def number(self) -> type | None:
        """Type of a single number: float or int."""
        kinds = [item for item in choices(self.info.annotation) if item is not type(None)]
        return kinds[0] if len(kinds) == 1 and kinds[0] in (int, float) else None

    def bound(self, *kinds: str) -> float | None:
        """Return the first bound of these kinds, such as 'ge'."""
        found = (getattr(item, kind, None) for item in self.info.metadata for kind in kinds)
        return next((float(value) for value in found if value is not None), None)


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
                inner = f'{prefix}{_singular(name)}.{item}'
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
                flat.update(flatten(value[item], f'{prefix}{_singular(name)}.{item}.'))
        elif not isinstance(value, (list, tuple)):
            flat[key] = value
        elif len(value):
            flat[key] = _as_list(value, info.annotation)
    return flat


def unflatten(model: type[BaseModel], flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return flat parameters as nested values for `model.model_validate`.

    Raises
    ------
    ValueError
        If a list of numbers is not one; the message names the parameter.
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


def constraints(info: FieldInfo) -> str:
    """Return in words what a field allows."""
    words = {'gt': 'above', 'ge': 'at least', 'lt': 'below', 'le': 'at most'}
    parts = [
        f'{words[key]} {getattr(item, key)}'
        for item in info.metadata
        for key in words
        if getattr(item, key, None) is not None
    ]
    for part in (info.annotation, *get_args(info.annotation)):
        if get_origin(part) is Literal:
            parts.append('one of ' + ', '.join(str(item) for item in get_args(part)))
    for item in info.metadata:
        if isinstance(item, PluginGroup):
            parts.append(f'one of {", ".join(item.names())}, or module:Class')
    return ' and '.join(parts)


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
    elements = [get_args(kind)[0] for kind in choices(annotation) if get_origin(kind) is list]
    element = _bare(elements[0]) if elements else str
    if not isinstance(item, str) or element is str or get_origin(element) is Literal:
        return item
    try:
        numbers = [float(word) for word in item.split()]
    except ValueError as error:
        raise ValueError(f'{key}: got {item!r}, allowed are numbers with spaces between') from error
    if isinstance(element, type) and issubclass(element, BaseModel):
        # All but the last number belong to the list, such as the centre of an obstacle.
        names = list(element.model_fields)
        return {names[0]: numbers[:-1], names[1]: numbers[-1] if numbers else None}
    return numbers


# Types of fields.


def _bare(annotation: Any) -> Any:
    while get_origin(annotation) is Annotated:
        annotation = get_args(annotation)[0]
    return annotation


def choices(annotation: Any) -> list[Any]:
    """Return the types of an annotation: the members of a union, without metadata."""
    annotation = _bare(annotation)
    if get_origin(annotation) in (Union, types.UnionType):
        return [inner for item in get_args(annotation) for inner in choices(item)]
    return [annotation]


def _width(annotation: Any) -> int | None:
    """Return the length of the lists in a list, if it is fixed."""
    for choice in choices(annotation):
        element = get_args(choice)[0] if get_origin(choice) is list else None
        limits = [item for item in get_args(element)[1:] if isinstance(item, FieldInfo)]
        lengths = [
            getattr(part, kind)
            for item in limits
            for part in item.metadata
            for kind in ('min_length', 'max_length')
            if hasattr(part, kind)
        ]
        if get_origin(_bare(element)) is list and len(lengths) == 2 and lengths[0] == lengths[1]:
            return int(lengths[0])
    return None


def _nested(annotation: Any) -> type[BaseModel] | None:
    for choice in choices(annotation):
        if isinstance(choice, type) and issubclass(choice, BaseModel):
            return choice
    return None


def _model_by_name(annotation: Any) -> type[BaseModel] | None:
    for choice in choices(annotation):
        if get_origin(choice) is dict:
            return _nested(get_args(choice)[1])
    return None


def _singular(name: str) -> str:
    return name.removesuffix('s')


# Help.


def parameters_of(model: type[BaseModel]) -> Iterator[ParameterField]:
    """Yield the parameters of a node's settings; those of each robot as of one named NAME."""
    tables = [item for item in _walk(model, {}) if _model_by_name(item.info.annotation) is not None]
    return parameter_fields(model, {item.name: ['NAME'] for item in tables})


def settings_of(node: type) -> type[BaseModel]:
    """Return the settings of a class of nodes: the type argument of their base."""
    for kind in node.__mro__:
        for base in kind.__dict__.get('__orig_bases__', ()):
            for argument in get_args(base):
                if inspect.isclass(argument) and issubclass(argument, BaseModel):
                    return argument
    raise TypeError(f'{node.__name__}: has no settings')


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
    rows = [_row(item) for item in parameters_of(settings_of(node))]
    text.append('\n'.join(['ROS parameters', '--------------', *rows]))
    text.append('Exit codes: 0 ended, 1 failed, 2 wrong parameters.')
    return '\n\n'.join(filter(None, text))


def _row(item: ParameterField) -> str:
    default: Any = item.default
    said = [item.description]
    if item.constraints:
        said.append(f'allowed: {item.constraints}')
    if default is not None:
        said.append(f'default: {str(default).lower() if isinstance(default, bool) else default}')
    indent = ' ' * 6
    words = textwrap.fill('; '.join(said), _WIDTH, initial_indent=indent, subsequent_indent=indent)
    return f'  {item.name}\n{words}'
