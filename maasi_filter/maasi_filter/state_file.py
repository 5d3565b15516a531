"""The state of a search in one file: a tree of dataclasses, arrays and plain values.

The file is one line of JSON (format, version, SHA-256 of the rest) and a NumPy archive: the tree as
JSON, and one array for all numbers of a type. Content with the right version and checksum was
written by this module and is not checked further.
"""

import hashlib
import io
import json
import os
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, PlainValidator

FORMAT = 'maasi_filter_state'
VERSION = 6


class StateFileError(ValueError):
    """A state file cannot be used; the message names the file and the reason."""


def _generator_of(state: dict[str, Any]) -> np.random.Generator:
    bit_generator = getattr(np.random, state['bit_generator'])()
    bit_generator.state = state
    return np.random.Generator(bit_generator)


#: Type of a random generator that is read.
SavedGenerator = Annotated[np.random.Generator, PlainValidator(_generator_of)]


def pack(tree: Any) -> dict[str, NDArray[Any]]:
    """Return a tree as a few arrays; an object that occurs twice is stored once."""
    parts: dict[str, list[NDArray[Any]]] = {}
    known: dict[int, dict[str, Any]] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            if id(value) not in known:
                kind = value.dtype.str[1:]
                part = parts.setdefault(kind, [])
                known[id(value)] = {'array': [kind, sum(item.size for item in part), value.shape]}
                part.append(value)
            return known[id(value)]
        if is_dataclass(value):
            return {
                item.name: plain(getattr(value, item.name)) for item in fields(value) if item.init
            }
        if isinstance(value, dict):
            return {str(key): plain(item) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(item) for item in value]
        if isinstance(value, BaseModel):
            return value.model_dump(mode='json', exclude_unset=True)
        if isinstance(value, np.random.Generator):
            return plain(value.bit_generator.state)
        return value.item() if isinstance(value, np.generic) else value

    text = json.dumps(plain(tree)).encode()
    arrays = {kind: np.concatenate([item.ravel() for item in part]) for kind, part in parts.items()}
    return {**arrays, 'tree': np.frombuffer(text, np.uint8)}


def write_state(path: str | os.PathLike[str], tree: Any, *, durable: bool = True) -> None:
    """Write a tree to a file atomically; `durable` flushes it to the disk first (fsync)."""
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


def read_state(path: str | os.PathLike[str]) -> Any:
    """Return the tree of a file: dictionaries, lists, arrays and plain values."""
    with np.load(io.BytesIO(_payload(path)), allow_pickle=False) as archive:
        parts = dict(archive)
    arrays: dict[str, NDArray[Any]] = {}

    def whole(item: dict[str, Any]) -> Any:
        if item.keys() != {'array'}:
            return item
        # An object that was stored once is shared again.
        key = str(item)
        if key not in arrays:
            kind, first, shape = item['array']
            arrays[key] = parts[kind][first:][: int(np.prod(shape))].reshape(shape).copy()
        return arrays[key]

    return json.loads(parts['tree'].tobytes(), object_hook=whole)


def _payload(path: str | os.PathLike[str]) -> bytes:
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
