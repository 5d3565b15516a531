"""The state of a search in one file: a tree of dataclasses, arrays and plain values.

The file is one line of JSON (format, version, SHA-256 of the rest) and a NumPy archive of the tree
as JSON with one array for all numbers of a type. It is read by the types of the fields. What has
the right checksum was written by this module, so that only types are checked then.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import types
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

FORMAT = 'maasi_filter_state'
VERSION = 3


class StateFileError(ValueError):
    """A state file cannot be used; the message says which file and why."""


@cache
def _hints(kind: type) -> dict[str, Any]:
    """Return the types of the saved fields of a dataclass: those of its constructor."""
    hints = get_type_hints(kind)
    return {item.name: hints[item.name] for item in fields(kind) if item.init}


def pack(tree: Any) -> dict[str, NDArray[Any]]:
    """Return a tree as a few arrays; one that occurs twice is stored once."""
    parts: dict[str, list[NDArray[Any]]] = {}
    sizes: dict[str, int] = {}
    known: dict[int, Any] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            if id(value) not in known:
                kind = value.dtype.str[1:]
                first = sizes.get(kind, 0)
                known[id(value)] = {'type': kind, 'first': first, 'shape': value.shape}
                parts.setdefault(kind, []).append(value.ravel())
                sizes[kind] = first + value.size
            return known[id(value)]
        if is_dataclass(value):
            return {name: plain(getattr(value, name)) for name in _hints(type(value))}  # type: ignore[arg-type]
        if isinstance(value, dict):
            return {str(key): plain(item) for key, item in value.items()}
        if isinstance(value, (list, tuple, bytes)):
            return [plain(item) for item in value]
        if isinstance(value, BaseModel):
            return value.model_dump_json(exclude_unset=True)
        if isinstance(value, np.random.Generator):
            state = value.bit_generator.state
            return json.loads(json.dumps(state, default=lambda item: item.tolist()))
        return value.item() if isinstance(value, np.generic) else value

    text = json.dumps(plain(tree)).encode()
    arrays = {kind: np.concatenate(items) for kind, items in parts.items()}
    return {**arrays, 'tree': np.frombuffer(text, np.uint8)}


def write_state(path: str | os.PathLike[str], tree: Any, *, durable: bool = True) -> None:
    """Write a tree to a file, which is replaced atomically.

    `durable` forces it to the disk (fsync) first, so that it also survives a power failure.
    """
    target = Path(path)
    buffer = io.BytesIO()
    np.savez(buffer, **pack(tree))  # type: ignore[arg-type]
    checksum = hashlib.sha256(buffer.getvalue()).hexdigest()
    header = {'format': FORMAT, 'version': VERSION, 'sha256': checksum}
    temporary = target.with_name(f'.{target.name}.{os.getpid()}.part')
    try:
        with open(temporary, 'wb') as stream:
            stream.write(json.dumps(header).encode() + b'\n' + buffer.getvalue())
            stream.flush()
            if durable:
                os.fsync(stream.fileno())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


class SavedState:
    """A file that `write_state` wrote with a mapping of names to trees.

    Raises
    ------
    StateFileError
        If the file is missing, is of another format or version, or is damaged.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = path
        payload = io.BytesIO(_payload(path))
        with self.named(), np.load(payload, allow_pickle=False) as archive:
            self._arrays = dict(archive)
            self._trees = json.loads(self._arrays['tree'].tobytes())
        self._shared: dict[str, NDArray[Any]] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._trees

    @contextmanager
    def named(self) -> Iterator[None]:
        """Convert errors of the content to a StateFileError that names the file."""
        try:
            yield
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            reason = f'no {error}' if isinstance(error, KeyError) else error
            raise StateFileError(f'{self.path}: does not hold a usable state: {reason}') from None

    def read(self, name: str, kind: Any) -> Any:
        """Return a tree of a type, or of a type for each of its names."""
        with self.named():
            return self._value(kind, self._trees[name], name)

    def _value(self, hint: Any, value: Any, name: str) -> Any:
        origin, arguments = get_origin(hint), get_args(hint)
        if origin is np.ndarray:
            return self._array(value, name, get_args(arguments[1])[0])
        if isinstance(hint, dict):
            return {key: self._value(kind, value[key], key) for key, kind in hint.items()}
        if is_dataclass(hint):
            return hint(**self._value(_hints(hint), value, name))  # type: ignore[arg-type, operator]
        if origin in (Union, types.UnionType):
            fits = [kind for kind in arguments if kind is type(value)] or list(arguments)
            return self._value(fits[0], value, name)
        if origin in (list, tuple):
            kinds = arguments if origin is tuple else arguments * len(value)
            return origin(self._value(kind, item, name) for kind, item in zip(kinds, value))
        if origin is dict:
            return {
                arguments[0](key): self._value(arguments[1], item, f'{name}: {key}')
                for key, item in value.items()
            }
        if hint is bytes:
            return bytes(value)
        if hint is np.random.Generator:
            bit_generator = getattr(np.random, value['bit_generator'])()
            bit_generator.state = value
            return np.random.Generator(bit_generator)
        if issubclass(hint, BaseModel):
            return hint.model_validate_json(value)
        if hint is float and type(value) is int:
            return float(value)
        if type(value) is not hint or value != value:
            raise ValueError(f'{name}: got {value!r:.100}, allowed is {hint.__name__}')
        return value

    def _array(self, value: Any, name: str, kind: Any) -> NDArray[Any]:
        """Return an array; one that was stored once is one again."""
        key = json.dumps(value)
        if key not in self._shared:
            part = self._arrays[value['type']][value['first'] :][: int(np.prod(value['shape']))]
            self._shared[key] = part.reshape(value['shape']).copy()
        array = self._shared[key]
        if array.dtype != kind or np.isnan(array).any():
            raise ValueError(f'{name}: got {array.dtype} numbers, allowed are {kind} without nan')
        return array


def _payload(path: str | os.PathLike[str]) -> bytes:
    """Return what follows the header of a file, undamaged."""
    try:
        line, _, payload = Path(path).read_bytes().partition(b'\n')
    except OSError as error:
        raise StateFileError(f'{path}: cannot be read: {error.strerror}') from None
    try:
        header = json.loads(line)
        version, checksum = header['version'], header['sha256']
        known = header['format'] == FORMAT
    except (ValueError, KeyError, TypeError):
        known = False
    if not known:
        raise StateFileError(f'{path}: is not a state of a search filter')
    if version != VERSION:
        raise StateFileError(f'{path}: version: got {version}, allowed is {VERSION}')
    if hashlib.sha256(payload).hexdigest() != checksum:
        raise StateFileError(f'{path}: is damaged: its checksum does not fit its content')
    return payload
