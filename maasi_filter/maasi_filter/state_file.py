"""The state of a search in one file: a tree of dataclasses, arrays and plain values.

The file is one line of JSON (format, version, length and SHA-256 of the rest) and a NumPy archive
of the tree as JSON with one array for all numbers of a type. It is read by the types of the
fields: a checksum proves that a file is as it was written, not that a filter wrote it.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import types
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

FORMAT = 'maasi_filter_state'
VERSION = 3
BIT_GENERATORS = ('PCG64', 'PCG64DXSM', 'Philox', 'SFC64', 'MT19937')
LONGEST_HEADER = 4096

Arrays = Mapping[str, NDArray[Any]]
T = TypeVar('T')


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
        if isinstance(value, (list, tuple)):
            return [plain(item) for item in value]
        if isinstance(value, bytes):
            return list(value)
        if isinstance(value, BaseModel):
            return value.model_dump_json(exclude_unset=True)
        if isinstance(value, np.random.Generator):
            state = value.bit_generator.state
            _check_generator(state['bit_generator'])
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
    payload = buffer.getvalue()
    header = {
        'format': FORMAT,
        'version': VERSION,
        'length': len(payload),
        'sha256': hashlib.sha256(payload).hexdigest(),
    }
    temporary = target.with_name(f'.{target.name}.{os.getpid()}.part')
    try:
        with open(temporary, 'wb') as stream:
            stream.write(json.dumps(header).encode() + b'\n')
            stream.write(payload)
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
        self._arrays = _read(path)
        with self.named():
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

    def read(self, name: str, kind: type[T]) -> T:
        """Return a tree of a type."""
        with self.named():
            value: T = self._value(kind, self._trees[name], name)
            return value

    def _value(self, hint: Any, value: Any, name: str) -> Any:
        origin, arguments = get_origin(hint), get_args(hint)
        if origin is np.ndarray:
            return self._array(value, name, get_args(arguments[1])[0])
        if is_dataclass(hint):
            hints = _hints(hint)  # type: ignore[arg-type]
            _check(isinstance(value, dict), name, value, 'fields')
            return hint(  # type: ignore[operator]
                **{key: self._value(kind, value[key], key) for key, kind in hints.items()}
            )
        if origin in (Union, types.UnionType):
            if value is None and type(None) in arguments:
                return None
            fits = [kind for kind in arguments if kind is type(value)]
            return self._value((fits or list(arguments))[0], value, name)
        if origin in (list, tuple):
            _check(isinstance(value, list), name, value, 'a list')
            kinds = arguments if origin is tuple else arguments * len(value)
            _check(len(kinds) == len(value), name, value, f'{len(kinds)} entries')
            return origin(self._value(kind, item, name) for kind, item in zip(kinds, value))
        if origin is dict:
            _check(isinstance(value, dict), name, value, 'a mapping')
            return {
                arguments[0](key): self._value(arguments[1], item, f'{name}: {key}')
                for key, item in value.items()
            }
        if hint is bytes:
            return bytes(value)
        if hint is np.random.Generator:
            bit_generator = getattr(np.random, _check_generator(value['bit_generator']))()
            bit_generator.state = value
            return np.random.Generator(bit_generator)
        if issubclass(hint, BaseModel):
            return hint.model_validate_json(value)
        if hint is float:
            number = type(value) in (int, float) and not np.isnan(value)
            _check(number, name, value, 'a number')
            return float(value)
        _check(type(value) is hint, name, value, hint.__name__)
        return value

    def _array(self, value: Any, name: str, kind: Any) -> NDArray[Any]:
        """Return an array; one that was stored once is one again."""
        key = json.dumps(value)
        if key not in self._shared:
            _check(isinstance(value, dict), name, value, 'an array')
            numbers = self._arrays[value['type']]
            shape = tuple(value['shape'])
            part = numbers[value['first'] : value['first'] + int(np.prod(shape))]
            self._shared[key] = part.reshape(shape).copy()
        array = self._shared[key]
        if array.dtype != kind:
            raise ValueError(f'{name}: got type {array.dtype}, allowed is {np.dtype(kind)}')
        if np.isnan(array).any():
            raise ValueError(f'{name}: got a number that is not finite')
        return array


def _check(fits: bool, name: str, value: Any, allowed: str) -> None:
    if not fits:
        raise ValueError(f'{name}: got {str(value)[:100]}, allowed is {allowed}')


def _check_generator(name: str) -> str:
    if name not in BIT_GENERATORS:
        raise ValueError(f'generator: got {name}, allowed are {", ".join(BIT_GENERATORS)}')
    return name


def _read(path: str | os.PathLike[str]) -> Arrays:
    """Return the arrays of a file, undamaged."""
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise StateFileError(f'{path}: cannot be read: {error.strerror}') from None
    line, separator, payload = content.partition(b'\n')
    try:
        if not separator or len(line) > LONGEST_HEADER:
            raise ValueError
        header = json.loads(line)
        if header['format'] != FORMAT:
            raise ValueError
        version, length, checksum = header['version'], header['length'], header['sha256']
    except (ValueError, KeyError, TypeError):
        raise StateFileError(f'{path}: is not a state of a search filter') from None
    if version != VERSION:
        raise StateFileError(f'{path}: version: got {version}, allowed is {VERSION}')
    if len(payload) != length:
        raise StateFileError(
            f'{path}: is damaged: {len(payload)} bytes of state where {length} should be'
        )
    if hashlib.sha256(payload).hexdigest() != checksum:
        raise StateFileError(f'{path}: is damaged: its checksum does not fit its content')
    try:
        with np.load(io.BytesIO(payload), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, KeyError, zipfile.BadZipFile) as error:
        raise StateFileError(f'{path}: is damaged: {error}') from None
