"""Which image answers which measurement batch, and where the robot was then. Without ROS."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

from maasi_drivers.agent.odometry import PoseHistory, StampedPose

DataT = TypeVar('DataT')


@dataclass(frozen=True)
class MeasurementRequest:
    """A measurement that a robot is to take.

    Attributes
    ----------
    batch : int
        Id of the batch.
    stamp : int
        The first image stamped at or after it is used [ns].
    measurement : int
        Index of this robot's measurement.
    """

    batch: int
    stamp: int
    measurement: int


@dataclass(frozen=True)
class Frame(Generic[DataT]):
    """An image, or a sweep of another sensor, with its stamp [ns]."""

    stamp: int
    data: DataT


class MeasurementQueue(Generic[DataT]):
    """Matches requests, images and poses, in any order of arrival.

    An image answers one request at most: it is one measurement.

    Parameters
    ----------
    history : PoseHistory
        Of the robot.
    offset : int
        Added to an image's stamp for the time of its pose [ns].
    frames, requests : int
        How many are kept; the oldest go first.
    """

    def __init__(
        self, history: PoseHistory, offset: int = 0, frames: int = 8, requests: int = 16
    ) -> None:
        self.history = history
        self.offset = offset
        self._frames: deque[Frame[DataT]] = deque(maxlen=frames)
        self._requests: deque[MeasurementRequest] = deque()
        self._capacity = requests
        self._next: MeasurementRequest | None = None
        #: Stamp of the last image [ns].
        self.latest: int | None = None

    def __len__(self) -> int:
        return len(self._requests)

    def add_frame(self, frame: Frame[DataT]) -> None:
        """Add an image, later than all before."""
        self._frames.append(frame)
        self.latest = frame.stamp

    def add_request(self, request: MeasurementRequest) -> list[MeasurementRequest]:
        """Add a request, unless it waits already; return those that are dropped for it."""
        if request in self._requests:
            return []
        self._requests.append(request)
        dropped = []
        while len(self._requests) > self._capacity:
            dropped.append(self._requests.popleft())
        return dropped

    def clear(self) -> None:
        """Discard everything, as after a jump of the clock."""
        self._frames.clear()
        self._requests.clear()
        self.latest = None

    def next(self) -> tuple[MeasurementRequest, Frame[DataT], StampedPose] | None:
        """Return the next request that can be answered, its image and the pose then.

        The image is taken; the request stays until `answered`, so that another image can take the
        place of one that turns out bad. None while something is awaited.
        """
        latest = self.history.latest
        if not self._requests or latest is None:
            return None
        # The earliest one: a request for a later time must not block others.
        request = self._next = min(self._requests, key=lambda item: item.stamp)
        while self._frames:
            frame = self._frames[0]
            if frame.stamp >= request.stamp:
                stamp = frame.stamp + self.offset
                if stamp > latest.stamp:
                    return None
                pose = self.history.at(stamp)
                if pose is not None:
                    self._frames.popleft()
                    return request, frame, pose
            # Before the request, or before the first pose: no use any more.
            self._frames.popleft()
        return None

    def answered(self) -> None:
        """Take off the request that `next` returned."""
        if self._next is not None and self._next in self._requests:
            self._requests.remove(self._next)
