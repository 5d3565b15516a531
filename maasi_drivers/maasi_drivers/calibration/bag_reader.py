"""Read recordings (rosbag2), also MCAP files without their end."""

import contextlib
import importlib
import io
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping
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
_SUFFIXES = ('.mcap', '.db3', '.bag')
# The zstd module: of Python 3.14, else installed with rosbags.
_ZSTD = ('compression.zstd', 'backports.zstd', 'zstandard')
_PART = 2**16  # shorter rests are lost at the end of a cut file [bytes]
_FRAME = b'\x28\xb5\x2f\xfd'  # begin of a zstd frame, and of no message


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
    """Return the number of bytes of an MCAP file up to the end of its last complete record."""
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
        raise BagError(f'is cut off: its {size} bytes contain no complete record')
    return end


def _sealed(path: Path, folder: Path) -> Path:
    """Copy the complete records of an MCAP file and add an end without an index."""
    length = whole_length(path)
    copy = folder / path.name
    with path.open('rb') as source, copy.open('wb') as target:
        shutil.copyfileobj(source, target)
        target.truncate(length)
        target.seek(length)
        target.write(_END)
    return copy


def _unpacked(source: Path | io.BytesIO) -> Any:
    for name in _ZSTD:
        with contextlib.suppress(ImportError):
            return importlib.import_module(name).open(source, 'rb')
    raise BagError(f'is compressed, which needs one of {", ".join(_ZSTD)}')


def _copied(path: Path, folder: Path) -> Path:
    """Decompress a file; of a cut one the part before the cut."""
    copy = folder / path.stem
    with _unpacked(path) as source, copy.open('wb') as target, contextlib.suppress(EOFError):
        while part := source.read(_PART):
            target.write(part)
    return copy


class BagReader:
    """Reads a recording, also without its end (writer killed or disk full).

    `remap`: new names of recorded topics.
    """

    def __init__(self, path: Path, remap: Mapping[str, str] | None = None) -> None:
        path = Path(path)
        if not path.exists():
            raise BagError(f'{path}: no such recording')
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
            self._stack.callback(self._reader.close)
        except Exception as error:
            self._stack.close()
            raise BagError(f'{self.path}: cannot be read: {_words(error)}') from error
        self._remap = {_absolute(old): _absolute(new) for old, new in (remap or {}).items()}
        recorded = {item.topic for item in self._reader.connections}
        for old, new in self._remap.items():
            if old not in recorded or new in recorded - self._remap.keys():
                problem = f'{new} is recorded too' if old in recorded else f'{old} is not recorded'
                self.close()
                raise BagError(
                    f'{self.path}: --remap {old}:={new}: {problem}; recorded are '
                    f'{", ".join(sorted(recorded))}'
                )

    def _readable(self, path: Path) -> list[Path]:
        whole = path.is_file() or (path / _METADATA).exists()
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        names = {file.name for file in files}
        files = [
            file
            for file in files
            if file.suffix in _SUFFIXES
            or (
                (file.suffix == '.zstd' and file.stem not in names)
                and Path(file.stem).suffix in _SUFFIXES
            )
        ]
        packed = [file for file in files if file.suffix == '.zstd']
        if not files and not whole:
            raise BagError(f'has no {_METADATA} and no file {", ".join(_SUFFIXES)}, or such .zstd')
        if packed and (path.is_file() or not whole):
            folder = self._folder()
            files = [_copied(file, folder) if file in packed else file for file in files]
        cut = [file for file in files if file.suffix == '.mcap' and not has_end(file)]
        if not cut and whole:
            return files if path in packed else [path]
        if not cut:
            self.recovered = f'{path}: has no {_METADATA}'
            return files
        folder = self._folder()
        missing = ', '.join(file.name for file in cut)
        self.recovered = f'{path}: the end of {missing} is missing; reading the part before it'
        return [_sealed(file, folder) if file in cut else file for file in files]

    def _folder(self) -> Path:
        return Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix='maasi_bag_')))

    def _name(self, topic: str) -> str:
        return self._remap.get(topic, topic)

    @property
    def types(self) -> dict[str, str]:
        """Type name by topic."""
        return {self._name(item.topic): item.msgtype for item in self._reader.connections}

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages by topic."""
        counts: dict[str, int] = {}
        for item in self._reader.connections:
            topic = self._name(item.topic)
            counts[topic] = counts.get(topic, 0) + item.msgcount
        return counts

    def raw(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, str, int, bytes]]:
        """Yield topic, type, time [ns] and serialised message, by time."""
        chosen = [
            item
            for item in self._reader.connections
            if topics is None or self._name(item.topic) in topics
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
            if data[: len(_FRAME)] == _FRAME:
                # Each message is compressed, which only the missing metadata says.
                with _unpacked(io.BytesIO(data)) as whole:
                    data = whole.read()
            yield self._name(connection.topic), connection.msgtype, time, data

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield the messages of `topics` (all if None), by time."""
        for topic, type_name, time, data in self.raw(topics):
            try:
                message = self._reader.deserialize(data, type_name)
            except Exception as error:
                raise BagError(
                    f'{self.path}: contains no valid {type_name}: {_words(error)}'
                ) from error
            yield BagMessage(topic, time, type_name, message)

    def close(self) -> None:
        """Close the files."""
        self._stack.close()

    def __enter__(self: Reader) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _absolute(topic: str) -> str:
    return f'/{topic.strip("/")}'


def _words(error: Exception) -> str:
    text = ' '.join(str(error).split()) or type(error).__name__
    if 'Profile is not ros2' in text:
        text = 'is an MCAP file of another profile than ros2, for example ROS 1: use its .bag file'
    return text if len(text) <= 300 else f'{text[:297]}...'
