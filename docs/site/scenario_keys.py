"""The keys of a scenario file, as its settings have them: docs/scenario_keys.md."""

from __future__ import annotations

import re
import textwrap
import types
import typing
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from page_tables import code, table
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from shapely.geometry.base import BaseGeometry

from maasi_filter.plugins import ChosenSettings
from maasi_filter.ros.parameters import ParameterField, written
from maasi_sim.run.buildings.scenario import CuboidScenario
from maasi_sim.scenario.schema import Scenario

PAGE = Path(__file__).resolve().parents[1] / 'scenario_keys.md'
HEAD = """# Keys of a scenario file

This page lists the keys of a scenario file; `./scripts/docs --write` writes it from the settings
that read the file. NAME stands for the name of a robot, `[]` for each entry of a list. A key that
is *needed* has no default. A robot takes all keys that its scenario does not give from its type,
a file in `config/robots`. Where the default is *none*, the meaning tells what holds then (in
`filter`, the value of the preset).

"""
COLUMNS = ('key', 'type [unit]', 'default', 'allowed', 'meaning')
ONE_AND_MANY = {
    bool: ('true or false', 'true or false'),
    int: ('whole number', 'whole numbers'),
    float: ('number', 'numbers'),
    str: ('text', 'texts'),
    BaseGeometry: ('text', 'texts'),
}


class Sections:
    """The sections of the page; settings that come again are described where they first were."""

    def __init__(self) -> None:
        self._places: dict[type[BaseModel], str] = {}

    def write(self, model: type[BaseModel], title: str, text: str, mark: str) -> str:
        """Return the section of a kind of scenario, with those of the settings inside."""
        return '\n'.join([f'## {title}\n\n{text}\n', *self._inside(model, '', mark)])

    def _inside(
        self, model: type[BaseModel], path: str, mark: str, known: Collection[str] = ()
    ) -> Iterator[str]:
        rows, inner = [], []
        for name, info in model.model_fields.items():
            key = info.alias or name
            if key in known:
                continue
            for kind, step in _models(info):
                if kind not in self._places:
                    place = f'{path}{key}{step}'
                    self._places[kind] = f'{place}{mark}'
                    inner.append((kind, place, info.description, ()))
            for kind, titles in _chosen(info):
                text = f'Further keys with {titles}'
                common = info.annotation.model_fields
                inner.append((kind, f'{path}{key} of {titles}', text, common))
            meaning, unit = _unit(info.description or '')
            shown = ' or '.join(dict.fromkeys(self._type(part) for part in _members(info)))
            rows.append((code(key), shown + unit, _default(info), _allowed(info), meaning))
        yield table(COLUMNS, rows)
        for kind, place, description, common in inner:
            yield f'### {place}{mark}\n\n{textwrap.fill(f"{description}.", 110)}\n'
            yield from self._inside(kind, f'{place}.', mark, common)

    def _type(self, info: FieldInfo, many: bool = False) -> str:
        """Return a type in words, with a link where it is described."""
        kind = info.annotation
        origin, arguments = typing.get_origin(kind), typing.get_args(kind)
        if origin is list:
            element = FieldInfo.from_annotation(arguments[0])
            words = ' or '.join(self._type(part, many=True) for part in _members(element))
            length = _length(info)
            if many:
                return f'rows of {length} {words}' if length else f'rows of {words}'
            return f'{length} {words}' if length else f'list of {words}'
        if origin is dict:
            return f'by name: {self._type(FieldInfo.from_annotation(arguments[1]))}'
        if origin is typing.Literal:
            return ONE_AND_MANY[type(arguments[0])][many]
        if _is_model(kind):
            place = self._places[kind]
            return f'[{place}](#{re.sub(r"[^a-z0-9 _-]", "", place.lower()).replace(" ", "-")})'
        return ONE_AND_MANY[kind][many] if kind in ONE_AND_MANY else 'its own keys'


def _is_model(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _members(info: FieldInfo) -> Iterator[FieldInfo]:
    """Yield the types of a union but None, or the one type."""
    if typing.get_origin(info.annotation) not in (typing.Union, types.UnionType):
        yield info
        return
    for kind in typing.get_args(info.annotation):
        if kind is not type(None):
            part = FieldInfo.from_annotation(kind)
            part.metadata = [*info.metadata, *part.metadata]
            yield from _members(part)


def _elements(info: FieldInfo) -> Iterator[FieldInfo]:
    """Yield the types inside of lists, to the innermost."""
    for part in _members(info):
        if typing.get_origin(part.annotation) is list:
            element = FieldInfo.from_annotation(typing.get_args(part.annotation)[0])
            yield element
            yield from _elements(element)


def _models(info: FieldInfo) -> Iterator[tuple[type[BaseModel], str]]:
    """Yield the settings in a field, and how its entries are written behind its key."""
    for part in _members(info):
        steps = {list: '[]', dict: '.NAME'}
        origin = typing.get_origin(part.annotation)
        kind = typing.get_args(part.annotation)[-1] if origin in steps else part.annotation
        for inner in _members(FieldInfo.from_annotation(kind)):
            if _is_model(inner.annotation):
                yield inner.annotation, steps.get(origin, '')


def _chosen(info: FieldInfo) -> Iterator[tuple[type[BaseModel], str]]:
    """Yield the settings that a field may have by its values, and what chooses them."""
    titles: dict[type[BaseModel], list[str]] = {}
    for mark in info.metadata:
        if isinstance(mark, ChosenSettings):
            for title, kind in mark.models().items():
                titles.setdefault(kind, []).append(title)
    for kind, chosen_by in titles.items():
        if kind is not info.annotation:
            yield kind, ', '.join(chosen_by)


def _length(info: FieldInfo) -> str:
    """Return how long a list has to be, or nothing where it is not limited to a few entries."""
    least, most = (
        next((getattr(item, name) for item in info.metadata if hasattr(item, name)), None)
        for name in ('min_length', 'max_length')
    )
    if most is None:
        return '' if least is None else f'{least} or more'
    return f'{most}' if least == most else f'{least or 0} to {most}'


def _allowed(info: FieldInfo) -> str:
    limits = [ParameterField('', (), part).constraints for part in (info, *_members(info))]
    limits += [ParameterField('', (), part).constraints for part in _elements(info)]
    return '; '.join(dict.fromkeys(re.sub(r'\.0\b', '', limit) for limit in limits if limit))


def _default(info: FieldInfo) -> str:
    if info.is_required():
        return '*needed*'
    value = info.get_default(call_default_factory=True)
    if value is PydanticUndefined or isinstance(value, BaseModel):
        return ''
    return '*none*' if value is None else code(written(value))


def _unit(description: str) -> tuple[str, str]:
    """Return what a key means, and its unit."""
    found = re.fullmatch(r'(.*?)( \[[^\[\]]+\])', description)
    return (found[1], found[2]) if found else (description, '')


def page() -> str:
    """Return the page."""
    sections = Sections()
    targets = sections.write(
        Scenario, 'Search for targets', 'With any planner but `cuboid_mpc`.', ''
    )
    buildings = sections.write(
        CuboidScenario,
        'Search of buildings',
        'With `planner: {name: cuboid_mpc}`: [cuboid_mpc.md](cuboid_mpc.md).',
        ' of buildings',
    )
    return HEAD + '\n'.join([targets, buildings])


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
