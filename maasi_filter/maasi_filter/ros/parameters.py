"""Conversion between settings and flat ROS parameters. Without ROS.

Nested settings become names with dots, and `None` is omitted. Lists of lists of fixed length
become one list, `bounds: [-0.3, 2.4, -0.3, 2.4]`; other lists of lists, and of small settings,
become lists of strings of numbers, `obstacles: ['0.8 1.2 0.1']`, a form that is also accepted for
the former.
Settings by name, `robots`, become the list `robots` and `robot.<name>.<key>`.
"""

from __future__ import annotations

import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from maasi_filter.plugins import PluginGroup, own_settings

ParameterValue = bool | int | float | str | list[Any]


@dataclass(frozen=True)
class ParameterField:
    """One parameter of a node.

    Attributes
    ----------
    name : str
        With dots.
    default : bool, int, float, str, list or None
        None: no default.
    description : str
        Meaning and unit.
    constraints : str
        What is allowed, in words.
    number : type or None
        float or int for a single number.
    lowest, highest : float or None
        Its bounds; `constraints` says whether they are included.
    """

    name: str
    default: ParameterValue | None
    description: str
    constraints: str
    number: type | None = None
    lowest: float | None = None
    highest: float | None = None


def flatten(settings: BaseModel, prefix: str = '') -> dict[str, ParameterValue]:
    """Return settings as flat parameters.

    Parameters
    ----------
    settings : BaseModel
        Any settings of the suite.
    prefix : str
        Of all names.
    """
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
    return _nest(model, flat, '')


def parameter_fields(
    model: type[BaseModel], given: Mapping[str, Any], prefix: str = ''
) -> Iterator[ParameterField]:
    """Yield the parameters of settings.

    Parameters
    ----------
    model : type
        The settings.
    given : mapping
        Flat parameters that are set; they determine which robots and optional parts exist.
    prefix : str
        Of all names.
    """
    for name, info in model.model_fields.items():
        key = prefix + (info.alias or name)
        by_name = _model_by_name(info.annotation)
        nested = _nested(info.annotation) or own_settings(info, given, prefix)
        if by_name is not None:
            yield ParameterField(key, None, info.description or '', '')
            for item in given.get(key) or []:
                yield from parameter_fields(by_name, given, f'{prefix}{_singular(name)}.{item}.')
        elif nested is not None:
            optional = type(None) in get_args(info.annotation)
            if not optional or any(item.startswith(f'{key}.') for item in given):
                yield from parameter_fields(nested, given, f'{key}.')
        else:
            yield ParameterField(
                key,
                _default(info),
                info.description or '',
                constraints(info),
                _number(info.annotation),
                _bound(info, 'ge', 'gt'),
                _bound(info, 'le', 'lt'),
            )


def parameter_name(model: type[BaseModel], location: Iterable[int | str]) -> str:
    """Return the parameter of a location in nested values.

    Parameters
    ----------
    model : type
        The settings.
    location : iterable of str or int
        Keys and indices of the location, as in errors of pydantic.
    """
    parts: list[str] = []
    current: type[BaseModel] | None = model
    keys = iter(location)
    for key in keys:
        info = None
        if current is not None:
            info = next(
                (item for name, item in current.model_fields.items() if key in (name, item.alias)),
                None,
            )
        if info is None:
            # An index, or a part of a single parameter.
            break
        by_name = _model_by_name(info.annotation)
        if by_name is None:
            parts.append(str(key))
            current = _nested(info.annotation)
            if info.annotation is Any:
                # Settings of a plugin.
                parts += [str(inner) for inner in keys if isinstance(inner, str)]
            continue
        name = next(keys, None)
        parts += [str(key)] if name is None else [_singular(str(key)), str(name)]
        current = by_name
    return '.'.join(parts)


def _default(info: FieldInfo) -> ParameterValue | None:
    if info.is_required():
        return None
    value = info.get_default(call_default_factory=True)
    if isinstance(value, (list, tuple)):
        return _as_list(value, info.annotation) or None
    return value


def _bound(info: FieldInfo, *kinds: str) -> float | None:
    for item in info.metadata:
        for kind in kinds:
            if getattr(item, kind, None) is not None:
                return float(getattr(item, kind))
    return None


def _number(annotation: Any) -> type | None:
    kinds = [item for item in choices(annotation) if item is not type(None)]
    return kinds[0] if len(kinds) == 1 and kinds[0] in (int, float) else None


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


def _nest(model: type[BaseModel], flat: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for name, info in model.model_fields.items():
        key = prefix + (info.alias or name)
        target = info.alias or name
        by_name = _model_by_name(info.annotation)
        inner = _nested(info.annotation) or own_settings(info, flat, prefix)
        if by_name is not None:
            nested[target] = {
                item: _nest(by_name, flat, f'{prefix}{_singular(name)}.{item}.')
                for item in flat.get(key) or []
            }
        elif inner is not None:
            optional = type(None) in get_args(info.annotation)
            if not optional or any(item.startswith(f'{key}.') for item in flat):
                nested[target] = _nest(inner, flat, f'{key}.')
        elif flat.get(key) is not None:
            value = flat[key]
            if not isinstance(value, (str, bool, int, float)):
                value = _from_list(key, value, info.annotation)
            nested[target] = value
    return nested


def _as_list(value: Sequence[Any], annotation: Any) -> list[Any]:
    if _width(annotation) is not None:
        return [float(number) for item in value for number in item]
    return [_as_text(item) for item in value]


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


def _as_text(item: Any) -> Any:
    """Return an item of a list; a list or settings become a string of numbers."""
    if isinstance(item, BaseModel):
        numbers: list[float] = []
        for name in type(item).model_fields:
            value = getattr(item, name)
            numbers += value if isinstance(value, list) else [value]
        return ' '.join(repr(float(number)) for number in numbers)
    if isinstance(item, (list, tuple)):
        return ' '.join(repr(float(number)) for number in item)
    return item


def _from_text(key: str, item: Any, annotation: Any) -> Any:
    element = _element(annotation)
    if not isinstance(item, str) or element is str or element is None:
        return item
    if get_origin(element) is Literal:
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


def _element(annotation: Any) -> Any:
    for choice in choices(annotation):
        if get_origin(choice) is list:
            return _bare(get_args(choice)[0])
    return None


def _width(annotation: Any) -> int | None:
    """Return the length of the lists in a list, if it is fixed."""
    for choice in choices(annotation):
        if get_origin(choice) is list and get_origin(get_args(choice)[0]) is Annotated:
            element, *metadata = get_args(get_args(choice)[0])
            limits = [item for item in metadata if isinstance(item, FieldInfo)]
            lengths = {
                getattr(part, kind)
                for item in limits
                for part in item.metadata
                for kind in ('min_length', 'max_length')
                if hasattr(part, kind)
            }
            parts = [part for item in limits for part in item.metadata]
            if get_origin(element) is list and len(lengths) == 1 and len(parts) == 2:
                return int(lengths.pop())
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


def settings_by_name(model: type[BaseModel]) -> list[str]:
    """Return the keys of settings that hold other settings by name, as `robots`."""
    return [
        info.alias or name
        for name, info in model.model_fields.items()
        if _model_by_name(info.annotation) is not None
    ]


def _singular(name: str) -> str:
    return name.removesuffix('s')
