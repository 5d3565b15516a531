"""Answers measurement batches with the detections of an image at its pose."""

from collections import Counter, deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from maasi_drivers.agent.odometry import PoseHistory, StampedPose
from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.sensor_input import SensorInput
from maasi_drivers.agent.sensor_reading import SensorReading
from maasi_drivers.agent.watchdog import Watchdog
from maasi_filter.ros.clocks import JUMP, batch_id_limit
from maasi_filter.ros.conversions import (
    MOST_DETECTIONS,
    detections_to_ros,
    pose_to_ros,
    stamp_from_ros,
    stamp_to_ros,
)
from maasi_filter.ros.qos import RELIABLE
from maasi_msgs.msg import DetectionArray, MeasurementBatch


@dataclass(frozen=True)
class MeasurementRequest:
    """A measurement that a robot must take with the first image at or after a stamp [ns]."""

    batch: int
    stamp: int
    measurement: int


class MeasurementQueue:
    """Matches requests, images (or sweeps) and poses in any order, one image per request."""

    def __init__(
        self, history: PoseHistory, offset: int = 0, frames: int = 8, requests: int = 16
    ) -> None:
        self.history, self.offset = history, offset
        # Stamp [ns] and data of images.
        self._frames: deque[tuple[int, Any]] = deque(maxlen=frames)
        self._requests: list[MeasurementRequest] = []
        self._capacity = requests
        self.latest: int | None = None  #: stamp of the last image [ns]

    def __len__(self) -> int:
        return len(self._requests)

    def add_frame(self, stamp: int, data: Any) -> None:
        """Add an image, later than all before."""
        self._frames.append((stamp, data))
        self.latest = stamp

    def add_request(self, request: MeasurementRequest) -> MeasurementRequest | None:
        """Add a new request; return one that is dropped for it."""
        if request not in self._requests:
            self._requests.append(request)
        return self._requests.pop(0) if len(self._requests) > self._capacity else None

    def clear(self) -> None:
        """Discard everything, as after a jump of the clock."""
        self._frames.clear()
        self._requests.clear()
        self.latest = None

    def next(self) -> tuple[MeasurementRequest, int, Any, StampedPose] | None:
        """Return the next request that can be answered, with stamp, image and its pose.

        The image is removed; the request stays until `answered`, as another image may
        answer it.
        """
        latest = self.history.latest
        if not self._requests or latest is None:
            return None
        # The earliest one: a request for a later time must not block others.
        request = min(self._requests, key=lambda item: item.stamp)
        while self._frames:
            stamp, data = self._frames[0]
            if request.stamp <= stamp and stamp + self.offset > latest.stamp:
                return None
            self._frames.popleft()
            pose = self.history.at(stamp + self.offset)
            # Images before the request or the first pose are useless.
            if request.stamp <= stamp and pose is not None:
                return request, stamp, data, pose
        return None

    def answered(self, request: MeasurementRequest) -> None:
        """Remove a request that `next` returned."""
        self._requests.remove(request)


_AHEAD = 2_000_000_000  # largest lead of image or batch stamps over the odometry [ns]


class MeasurementResponder:
    """Answers each batch of the robot with the detections of one image or sweep."""

    def __init__(self, driver: RobotNode, sensor: SensorInput, watchdog: Watchdog) -> None:
        self._driver, self._sensor, self._watchdog = driver, sensor, watchdog
        #: Batches without an answer yet.
        self.queue = MeasurementQueue(driver.history, sensor.offset)
        self._answer: DetectionArray | None = None
        # The last image and its stamp [ns].
        self._frame: tuple[int, Any] | None = None
        self.left_out: Counter[str] = Counter()
        self._publisher = driver.create_publisher(DetectionArray, 'detections', RELIABLE)
        driver.create_subscription(
            MeasurementBatch, driver.team_topic('measurement_batch'), self._on_batch, RELIABLE
        )
        driver.expect_subscribers(self._publisher, names={'filter_node'})

    def reset(self) -> None:
        """Discard data from another time."""
        self.queue.clear()
        self._answer = self._frame = None

    def receive_frame(self, topic: str, stamp: int, data: Any, repeated: bool) -> None:
        """Handle an image or sweep; see `RobotNode.receive_frame`."""
        driver = self._driver
        if not driver.active or self._is_ahead('image stamp', f'{topic}.header.stamp', stamp):
            return
        latest = self.queue.latest
        if latest is not None and stamp <= latest:
            if latest - stamp <= JUMP:
                driver.drop(
                    'image stamp',
                    f'{topic}.header.stamp: read {stamp} ns, allowed are stamps after {latest} ns',
                )
                return
            driver.get_logger().warning(
                f'{topic}.header.stamp jumped back by {1e-9 * (latest - stamp):.3f} s'
            )
            self.queue.clear()
        self._watchdog.note_frame(topic, repeated)
        self._frame = stamp, data
        self.queue.add_frame(stamp, data)
        self.serve()

    def serve(self) -> None:
        """Answer the batches whose image and pose are known."""
        while (found := self.queue.next()) is not None:
            request, stamp, data, pose = found
            try:
                reading = self._sensor.detect(data, pose)
            except ValueError as error:
                # No empty answer, as a miss is information; the next image answers.
                self._driver.drop('image', str(error))
                continue
            self.queue.answered(request)
            self._publish(request, stamp, pose, reading)

    def _on_batch(self, message: MeasurementBatch) -> None:
        driver = self._driver
        if not driver.active:
            return
        stamp = stamp_from_ros(message.stamp)
        if message.id > batch_id_limit(0):
            driver.drop(
                'batch', f'measurement_batch.id: read {message.id}, allowed are smaller numbers'
            )
            return
        if self._is_ahead('batch', 'measurement_batch.stamp', stamp):
            return
        answer = self._answer
        if (
            answer is not None
            and answer.batch_id == message.id
            and stamp_from_ros(answer.header.stamp) >= stamp
        ):
            # Repeat the answer to a repeated batch: a restarted peer may need it.
            self._publisher.publish(answer)
            return
        for member in message.members:
            if member.robot == driver.robot:
                request = MeasurementRequest(int(message.id), stamp, int(member.measurement))
                if (old := self.queue.add_request(request)) is not None:
                    driver.drop(
                        'batch',
                        f'batch {old.batch}: dropped without an image, too many newer batches',
                    )
                self.serve()
                # In lockstep no other image comes. After a restart it may have answered the
                # previous batch, which is published again.
                frame = self._frame if driver.settings.lockstep and len(self.queue) else None
                if frame is not None and frame[0] == stamp:
                    self.queue.add_frame(*frame)
                    self.serve()
                return

    def _is_ahead(self, reason: str, what: str, stamp: int) -> bool:
        """Return whether a stamp [ns] is far ahead of the odometry and must be dropped."""
        latest = self._driver.history.latest
        if self._driver.settings.lockstep or latest is None or stamp <= latest.stamp + _AHEAD:
            return False
        self._driver.drop(
            reason,
            f'{what}: read {stamp} ns, allowed is up to {_AHEAD * 1e-9:g} s after the odometry, '
            f'{latest.stamp + _AHEAD} ns',
        )
        return True

    def _publish(
        self, request: MeasurementRequest, stamp: int, pose: StampedPose, reading: SensorReading
    ) -> None:
        driver = self._driver
        beyond = len(reading.values) - MOST_DETECTIONS
        if beyond > 0:
            driver.drop(
                'too many detections',
                f'{self._sensor.name}: {len(reading.values)} detections, allowed are '
                f'{MOST_DETECTIONS}',
                beyond,
            )
            first = np.arange(len(reading.values)) < MOST_DETECTIONS
            reading = reading.only(first, 'too many')
        self.left_out.update(reading.dropped)
        answer = DetectionArray(
            batch_id=request.batch,
            step=driver.step_of(stamp),
            robot=driver.robot,
            measurement=request.measurement,
            sensor=driver.sensor.name,
            detections=detections_to_ros(reading.values, reading.covariances, reading.labels),
            dropped=sum(reading.dropped.values()),
        )
        answer.header.stamp = stamp_to_ros(stamp)
        answer.header.frame_id = driver.settings.frame
        answer.pose.pose = pose_to_ros(pose.pose)
        answer.pose.covariance = pose.covariance.ravel()
        self._publisher.publish(answer)
        self._answer = answer
