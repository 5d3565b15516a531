"""What `--help` says of a node: its topics, from the docstrings, and its parameters."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel

from maasi_filter.ros.parameters import ParameterField, parameter_fields, settings_by_name

_WIDTH = 96


def parameters_of(model: type[BaseModel]) -> Iterator[ParameterField]:
    """Yield the parameters of a node's settings; those of each robot as of one named NAME."""
    given = {name: ['NAME'] for name in settings_by_name(model)}
    yield from parameter_fields(model, given)


def settings_of(node: type) -> type[BaseModel]:
    """Return the settings of a class of nodes: the type argument of their base."""
    for kind in node.__mro__:
        for base in kind.__dict__.get('__orig_bases__', ()):
            for argument in get_args(base):
                if inspect.isclass(argument) and issubclass(argument, BaseModel):
                    return argument
    raise TypeError(f'{node.__name__}: has no settings')


def node_help(node: type, name: str, base: type) -> str:
    """Return the help of a node.

    Parameters
    ----------
    node : type
        Its class.
    name : str
        Of its executable.
    base : type
        Of all nodes: the last class whose topics are listed.
    """
    text = [
        f'usage: {name} [--ros-args [--params-file FILE] [-p NAME:=VALUE] [-r __ns:=/TEAM] ...]'
    ]
    for kind in node.__mro__:
        text.append(_without_arguments(inspect.cleandoc(kind.__dict__.get('__doc__') or '')))
        if kind is base:
            break
    rows = [_row(item) for item in parameters_of(settings_of(node))]
    text.append('\n'.join(['ROS parameters', '--------------', *rows]))
    text.append('Exit codes: 0 ended, 1 failed, 2 wrong parameters.')
    return '\n\n'.join(filter(None, text))


def _without_arguments(doc: str) -> str:
    """Return a docstring up to the sections that are for who writes code."""
    return re.split(r'\n(?:Parameters|Attributes)\n-+\n', doc)[0].strip()


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
