"""The whole state of a search filter in one file: versioned, checksummed, written atomically.

The file is one line of JSON (format, version, length and SHA-256 of the rest) and a NumPy archive.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FORMAT = 'maasi_filter_state'
VERSION = 2
BIT_GENERATORS = ('PCG64', 'PCG64DXSM', 'Philox', 'SFC64', 'MT19937')
LONGEST_HEADER = 4096


class StateFileError(ValueError):
    """A state file cannot be used; the message says which file and why."""


def write_state(
    path: str | os.PathLike[str], values: dict[str, NDArray[Any]], *, durable: bool = True
) -> None:
    """Write arrays to `path`, replacing the file atomically.

    Parameters
    ----------
    path : path
        The file.
    values : dict of str to array
        The arrays.
    durable : bool
        Whether to force the data to the disk (fsync) before replacing the old file, so that it
        also survives a power failure.
    """
    target = Path(path)
    buffer = io.BytesIO()
    np.savez(buffer, **values)  # type: ignore[arg-type]
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


def read_state(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays in `path`.

    Raises
    ------
    StateFileError
        If the file is missing, is of another format or version, or is damaged.
    """
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


def text(value: str) -> NDArray[Any]:
    """Return a string as an array of bytes."""
    return np.frombuffer(value.encode(), dtype=np.uint8)


def untext(value: NDArray[Any]) -> str:
    """Return the string of an array of bytes."""
    return value.tobytes().decode()


def generator_state(generator: np.random.Generator) -> str:
    """Return the state of a generator as JSON.

    Raises
    ------
    ValueError
        If it is of a kind that cannot be restored.
    """
    state = generator.bit_generator.state
    if state['bit_generator'] not in BIT_GENERATORS:
        raise ValueError(
            f'generator: got {state["bit_generator"]}, allowed are {", ".join(BIT_GENERATORS)}'
        )

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, np.ndarray):
            return {'array': value.tolist(), 'dtype': str(value.dtype)}
        return value.item() if isinstance(value, np.generic) else value

    return json.dumps(plain(state))


def restored_generator(state: str) -> np.random.Generator:
    """Return a generator that continues where `generator_state` was taken."""

    def rich(value: Any) -> Any:
        if isinstance(value, dict):
            if set(value) == {'array', 'dtype'}:
                return np.array(value['array'], dtype=value['dtype'])
            return {key: rich(item) for key, item in value.items()}
        return value

    values = rich(json.loads(state))
    name = values['bit_generator']
    if name not in BIT_GENERATORS:
        raise ValueError(f'generator: got {name}, allowed are {", ".join(BIT_GENERATORS)}')
    bit_generator = getattr(np.random, name)()
    bit_generator.state = values
    return np.random.Generator(bit_generator)
