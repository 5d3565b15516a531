"""Write recordings (rosbag2, MCAP) of serialised messages without ROS, and read those of runs."""

import contextlib
import queue
import threading
from collections.abc import Mapping
from pathlib import Path
from time import monotonic
from typing import Any, ClassVar, Literal, cast

import numpy as np
import yaml
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from maasi_drivers.calibration.bag_reader import BagError, BagReader

IMAGE_TYPE = 'sensor_msgs/msg/Image'
COMPRESSED_TYPE = 'sensor_msgs/msg/CompressedImage'
SCENARIO_TOPIC = '/scenario'
ENDING_TOPIC = '/ending'  # reason as one word, then a line of text

ImageFormat = Literal['jpeg', 'png', 'raw']

# Compressed encodings, with their number of channels.
_CHANNELS = {'bgr8': 3, 'rgb8': 3, 'mono8': 1, '8UC1': 1, '8UC3': 3}
ROS_DISTRO = 'jazzy'
# Written messages are in the file after this time [s of wall time].
FLUSH_PERIOD = 0.5
_FOREVER = QosTime(9223372036, 854775807)


class BagWriteError(BagError):
    """A recording cannot be written, e.g. because the disk is full."""


def topic_qos(reliable: bool = True, latched: bool = False, depth: int = 10) -> Qos:
    """Return the quality of service of a topic, for players."""
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        _FOREVER,
        _FOREVER,
        QosLiveliness.AUTOMATIC,
        _FOREVER,
        False,
    )


def load_types() -> Typestore:
    """Return the message types of Jazzy and of `maasi_msgs`, installed or in this repository."""
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = Path(__file__).resolve().parents[3] / 'maasi_msgs' / 'msg'
    with contextlib.suppress(ImportError, LookupError, OSError):
        from ament_index_python.packages import get_package_share_directory

        installed = Path(get_package_share_directory('maasi_msgs')) / 'msg'
        folder = installed if installed.is_dir() else folder
    if not folder.is_dir():
        raise BagError(f'package maasi_msgs: no message definitions in {folder}')
    types: dict[str, Any] = {}
    for path in folder.glob('*.msg'):
        types |= get_types_from_msg(path.read_text('utf-8'), f'maasi_msgs/msg/{path.stem}')
    store.register(types)
    return store


class _Storage(McapWriter):
    """An MCAP file whose metadata names the ROS distribution instead of the library."""

    def close(self, version: int, metadata: str) -> None:
        super().close(version, _with_distribution(metadata))


class _Writer(Writer):
    STORAGE_PLUGINS: ClassVar[Mapping[StoragePlugin, type[_Storage]]] = {  # type: ignore[misc, assignment]
        StoragePlugin.MCAP: _Storage
    }

    def close(self) -> None:
        super().close()
        copy = self.metapath.with_suffix('.yaml.tmp')
        copy.write_text(_with_distribution(self.metapath.read_text('utf-8')), 'utf-8')
        copy.replace(self.metapath)


def _with_distribution(metadata: str) -> str:
    return metadata.replace('ros_distro: rosbags', f'ros_distro: {ROS_DISTRO}')


class BagWriter(contextlib.AbstractContextManager['BagWriter']):
    """Writes a recording in its own thread; readable after `close`, also after errors.

    Messages are in the file after `FLUSH_PERIOD`; times that do not increase are raised by 1
    ns. Images are stored on `<topic>/compressed` as by image_transport (JPEG of quality 95, or
    PNG, ten times slower). `write` blocks while more than `backlog` bytes wait; it and `close`
    raise the errors of the thread.
    """

    def __init__(
        self, path: Path, types: Typestore, images: ImageFormat = 'jpeg', backlog: int = 8 * 2**20
    ) -> None:
        self.path = Path(path)
        self._types, self._images = types, images
        self._limit = backlog
        if self.path.exists():
            raise BagError(f'{path}: exists already')
        self._writer = _Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._flushed = 0.0
        try:
            self._writer.open()
        except OSError as error:
            raise BagWriteError(f'{path}: cannot write: {error.strerror}') from error
        self._topics: dict[str, tuple[str, Qos]] = {}
        self._connections: dict[str, Connection] = {}
        self._time = -1
        self._queue: queue.SimpleQueue[tuple[str, int, bytes] | None] = queue.SimpleQueue()
        self._pending = 0
        self._changed = threading.Condition()
        self._error: BaseException | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name='bag writer', daemon=True)
        self._thread.start()

    def add_topic(self, topic: str, type_name: str, qos: Qos | None = None) -> None:
        """Add a topic, which the recording has even without messages."""
        if type_name not in self._types.fielddefs:
            raise BagError(f'topic {topic}: unknown message type {type_name}')
        self._topics[topic] = (type_name, qos or topic_qos())

    def write(self, topic: str, time: int, data: bytes) -> None:
        """Write a serialised message (CDR) received at `time` [ns]."""
        self._check()
        if topic not in self._topics:
            raise BagError(f'topic {topic}: add_topic was not called')
        with self._changed:
            self._pending += len(data)
            self._queue.put((topic, time, data))
            self._changed.wait_for(lambda: self._pending <= self._limit or self._error)

    def write_message(self, topic: str, time: int, message: Any) -> None:
        """Serialise and write a message of the classes of `rosbags`."""
        type_name = self._topics[topic][0]
        self.write(topic, time, bytes(self._types.serialize_cdr(message, type_name)))

    def write_scenario(self, text: str, facts: Mapping[str, str]) -> None:
        """Store the scenario on the latched topic `/scenario` and as metadata."""
        for key, value in facts.items():
            self._writer.set_custom_data(key, value)
        self.write_text(SCENARIO_TOPIC, 0, text)

    def write_text(self, topic: str, time: int, text: str) -> None:
        """Store a text on its own latched topic, at `time` [ns]."""
        string = self._types.types['std_msgs/msg/String']
        self.add_topic(topic, 'std_msgs/msg/String', topic_qos(latched=True, depth=1))
        self.write_message(topic, time, string(data=text))

    @property
    def failed(self) -> bool:
        """Whether writing has failed."""
        return self._error is not None

    def close(self) -> None:
        """Write all waiting messages and the index."""
        if self._closed:
            return
        self._closed = True
        self._queue.put(None)
        self._thread.join()
        if self._error is None:
            try:
                for topic in self._topics:
                    self._connect(topic, compressed=True)
                self._writer.close()
            except Exception as error:
                self._error = error
        if self._error is not None:
            # Complete chunks stay readable without an index.
            self._writer.metapath.with_suffix('.yaml.tmp').unlink(missing_ok=True)
            with contextlib.suppress(Exception):
                self._writer.abort()
        self._check()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check(self) -> None:
        if self._error is not None:
            text = getattr(self._error, 'strerror', None) or self._error
            kind = BagWriteError if isinstance(self._error, OSError) else BagError
            raise kind(f'{self.path}: writing failed: {text}') from self._error

    def _work(self) -> None:
        while True:
            item = None
            with contextlib.suppress(queue.Empty):
                item = self._queue.get(timeout=FLUSH_PERIOD)
                if item is None:
                    return
            if self._error is None:
                try:
                    if item is not None:
                        self._store(*item)
                    self._flush()
                except Exception as error:
                    self._error = error
            with self._changed:
                self._pending -= 0 if item is None else len(item[2])
                self._changed.notify_all()

    def _flush(self) -> None:
        storage = cast('McapWriter', self._writer.storage)
        if storage.chunk.msgs and monotonic() >= self._flushed + FLUSH_PERIOD:
            storage.close_chunk()
            storage.bio.flush()
            self._flushed = monotonic()

    def _store(self, topic: str, time: int, data: bytes) -> None:
        compressed = None
        if self._topics[topic][0] == IMAGE_TYPE and self._images != 'raw':
            compressed = self._compress(data)
        connection = self._connect(topic, compressed=compressed is not None)
        self._time = max(time, self._time + 1)
        self._writer.write(connection, self._time, data if compressed is None else compressed)

    def _connect(self, topic: str, *, compressed: bool) -> Connection:
        name, (type_name, qos) = topic, self._topics[topic]
        if compressed and type_name == IMAGE_TYPE and self._images != 'raw':
            name, type_name = f'{topic}/compressed', COMPRESSED_TYPE
        if name not in self._connections:
            self._connections[name] = self._writer.add_connection(
                name, type_name, typestore=self._types, offered_qos_profiles=[qos]
            )
        return self._connections[name]

    def _compress(self, data: bytes) -> bytes | None:
        """Return a compressed image, or None if OpenCV does not support its encoding."""
        import cv2

        image: Any = self._types.deserialize_cdr(data, IMAGE_TYPE)
        channels = _CHANNELS.get(image.encoding)
        if channels is None or image.height * image.width == 0:
            return None
        if image.step < image.width * channels or image.data.size < image.height * image.step:
            return None
        rows = image.data[: image.height * image.step].reshape(image.height, image.step)
        pixels = rows[:, : image.width * channels].reshape(image.height, image.width, channels)
        pixels = np.ascontiguousarray(pixels)
        if image.encoding == 'rgb8':
            pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
        finest = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
        options = {
            'png': [cv2.IMWRITE_PNG_COMPRESSION, 1],
            'jpeg': [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, finest],
        }[self._images]
        done, encoded = cv2.imencode(f'.{self._images}', pixels, options)
        if not done:
            return None
        stored = 'bgr8' if channels == 3 else ''
        message = self._types.types[COMPRESSED_TYPE](
            header=image.header,
            format=f'{image.encoding}; {self._images} compressed {stored}',
            data=encoded.reshape(-1),
        )
        return bytes(self._types.serialize_cdr(message, COMPRESSED_TYPE))


class Bag(BagReader):
    """Reads the recording of a run, even if its end is missing."""

    def scenario(self) -> dict[str, Any]:
        """Return the scenario, seed and node parameters of the run."""
        for item in self.messages([SCENARIO_TOPIC]):
            content = yaml.safe_load(item.message.data)
            if isinstance(content, dict):
                return content
        raise BagError(f'{self.path}: contains no scenario; only recordings of run_scenario do')
