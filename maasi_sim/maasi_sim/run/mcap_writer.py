"""The writer of `rosbags`, extended: flushes by time, type hashes, name of the distribution."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import ClassVar, cast

from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import (
    Channel,
    McapWriter,
    write_channel,
    write_string,
)

from maasi_drivers.calibration.bag_reader import whole_length, write_end

ROS_DISTRO = 'jazzy'
# Latest time after which written messages are in the file [s of wall time].
FLUSH_PERIOD = 0.5
_FOREIGN_DISTRO, _OWN_DISTRO = 'ros_distro: rosbags', f'ros_distro: {ROS_DISTRO}'


class FlushingStorage(McapWriter):
    """An MCAP file that loses at most the last moments when its writer is killed."""

    _flushed = 0.0

    def add_connection(self, connection: Connection, offered_qos_profiles: str) -> None:
        """Add a topic, with the hash of its type as rosbag2 stores it."""
        metadata = BytesIO()
        for text in (
            'offered_qos_profiles',
            offered_qos_profiles,
            'topic_type_hash',
            connection.digest,
        ):
            write_string(metadata, text)
        extension = cast('ConnectionExtRosbag2', connection.ext)
        self.channels.append(
            Channel(
                connection.id,
                connection.msgtype,
                connection.topic,
                extension.serialization_format,
                metadata.getvalue(),
            )
        )
        self.channel_stats[connection.id] = 0
        write_channel(self.chunk.bio, self.channels[-1], self.schemas)

    def flush(self, now: float) -> float:
        """Write the chunk to the file if it is due; return the time until it is [s]."""
        if not self.chunk.msgs:
            self._flushed = now
        elif now >= self._flushed + FLUSH_PERIOD:
            self.close_chunk()
            self.bio.flush()
            self._flushed = now
        return max(0.0, self._flushed + FLUSH_PERIOD - now)

    def close(self, version: int, metadata: str) -> None:
        """Write index and end."""
        super().close(version, metadata.replace(_FOREIGN_DISTRO, _OWN_DISTRO))


class BagFile(Writer):
    """A recording in the format of rosbag2, version 9, MCAP with compressed chunks.

    Parameters
    ----------
    path : Path
        Its folder; must not exist.
    """

    STORAGE_PLUGINS: ClassVar[Mapping[StoragePlugin, type[FlushingStorage]]] = {  # type: ignore[misc, assignment]
        StoragePlugin.MCAP: FlushingStorage
    }

    def __init__(self, path: Path) -> None:
        super().__init__(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    def flush(self) -> float:
        """Write due chunks to the file; return the time until the next [s]."""
        assert isinstance(self.storage, FlushingStorage)
        return self.storage.flush(time.monotonic())

    def close(self) -> None:
        """Write the index and `metadata.yaml`."""
        super().close()
        text = self.metapath.read_text(encoding='utf-8')
        copy = self.metapath.with_suffix('.yaml.tmp')
        copy.write_text(text.replace(_FOREIGN_DISTRO, _OWN_DISTRO), encoding='utf-8')
        copy.replace(self.metapath)

    def give_up(self) -> None:
        """Close after a failed write: complete records stay readable, without an index."""
        file = self.path / f'{self.path.name}.mcap'
        self.metapath.with_suffix('.yaml.tmp').unlink(missing_ok=True)
        with contextlib.suppress(Exception):
            self.abort()
        with contextlib.suppress(Exception):
            length = whole_length(file)
            os.truncate(file, length)
            with file.open('ab') as end:
                write_end(end)
