"""Read recordings (rosbag2), also MCAP files whose end is missing."""

import contextlib
import shutil
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

Reader = TypeVar('Reader', bound='BagReader')

_MAGIC = b'\x89MCAP0\r\n'
# Opcode and length of a record.
_RECORD_HEADER = 9
_HEADER, _DATA_END = 0x01, 0x0F
_LAST_OPCODE = 0x0F
# An empty data end and footer: opcode, length, content.
_END = b'\x0f' + (4).to_bytes(8, 'little') + bytes(4)
_END += b'\x02' + (20).to_bytes(8, 'little') + bytes(20) + _MAGIC
_METADATA = 'metadata.yaml'


class BagError(RuntimeError):
    """A recording cannot be written or read."""


@dataclass(frozen=True)
class BagMessage:
    """A message of a recording: topic, time [ns, of the run's clock], type and content."""

    topic: str
    time: int
    type: str
    message: Any


def has_end(path: Path) -> bool:
    """Return whether an MCAP file was closed."""
    size = path.stat().st_size
    with path.open('rb') as file:
        file.seek(max(0, size - len(_MAGIC)))
        return size > len(_MAGIC) and file.read() == _MAGIC


def whole_length(path: Path) -> int:
    """Return the number of bytes of an MCAP file up to the end of its last whole record."""
    size = path.stat().st_size
    with path.open('rb') as file:
        magic = file.read(len(_MAGIC))
        if magic != _MAGIC[: len(magic)]:
            raise BagError('is not an MCAP file')
        end = len(_MAGIC)
        while True:
            file.seek(end)
            start = file.read(_RECORD_HEADER)
            if len(start) < _RECORD_HEADER:
                break
            opcode, after = start[0], end + _RECORD_HEADER + int.from_bytes(start[1:], 'little')
            if opcode == _DATA_END or not _HEADER <= opcode <= _LAST_OPCODE or after > size:
                break
            end = after
    if end <= len(_MAGIC):
        raise BagError(f'is cut off: its {size} bytes hold no whole record')
    return end


def _sealed(path: Path, folder: Path) -> Path:
    """Copy what is whole of an MCAP file; end it without an index, as the format allows."""
    length = whole_length(path)
    copy = folder / path.name
    with path.open('rb') as source, copy.open('wb') as target:
        shutil.copyfileobj(source, target)
        target.truncate(length)
        target.seek(length)
        target.write(_END)
    return copy


class BagReader:
    """Read a recording, also one whose end is missing (its writer was killed, or the disk full)."""

    def __init__(self, path: Path) -> None:
        path = Path(path)
        if not path.exists():
            raise BagError(f'{path}: there is no such recording')
        if (path / 'bag').is_dir():
            path = path / 'bag'
        self.path = path
        self.recovered = ''
        self._stack = contextlib.ExitStack()
        try:
            self._reader = AnyReader(
                self._readable(path), default_typestore=get_typestore(Stores.ROS2_JAZZY)
            )
            self._reader.open()
        except Exception as error:
            self._stack.close()
            raise BagError(f'{self.path}: cannot be read: {_words(error)}') from error

    def _readable(self, path: Path) -> list[Path]:
        files = sorted(path.glob('*.mcap')) if path.is_dir() else [path]
        files = [file for file in files if file.suffix == '.mcap']
        cut = [file for file in files if not has_end(file)]
        if path.is_dir() and not (path / _METADATA).exists() and not files:
            raise BagError(f'has no {_METADATA} and no .mcap file')
        if not cut and (path.is_file() or (path / _METADATA).exists()):
            return [path]
        if not cut:
            self.recovered = f'{path}: has no {_METADATA}'
            return files
        folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix='maasi_bag_')))
        names = ', '.join(file.name for file in cut)
        self.recovered = f'{path}: the end of {names} is missing; what is before it is read'
        return [_sealed(file, folder) if file in cut else file for file in files]

    @property
    def types(self) -> dict[str, str]:
        """Type name by topic."""
        return {item.topic: item.msgtype for item in self._reader.connections}

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages by topic."""
        counts: dict[str, int] = {}
        for item in self._reader.connections:
            counts[item.topic] = counts.get(item.topic, 0) + item.msgcount
        return counts

    def raw(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, str, int, bytes]]:
        """Yield topic, type, time [ns] and serialised message, in order of time."""
        chosen = [
            item for item in self._reader.connections if topics is None or item.topic in topics
        ]
        # An empty selection would read all topics.
        messages = self._reader.messages(chosen) if chosen else iter(())
        while True:
            try:
                connection, time, data = next(messages)
            except StopIteration:
                return
            except Exception as error:
                raise BagError(f'{self.path}: is damaged: {_words(error)}') from error
            yield connection.topic, connection.msgtype, time, data

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages of `topics` (all if None), in order of time."""
        for topic, type_name, time, data in self.raw(topics):
            try:
                message = self._reader.deserialize(data, type_name)
            except Exception as error:
                raise BagError(f'{self.path}: holds no {type_name}: {_words(error)}') from error
            yield BagMessage(topic, time, type_name, message)

    def close(self) -> None:
        """Close the files."""
        if self._reader.stack is not None:
            self._reader.close()
        self._stack.close()

    def __enter__(self: Reader) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _words(error: Exception) -> str:
    text = ' '.join(str(error).split()) or type(error).__name__
    return text if len(text) <= 300 else f'{text[:297]}...'
