"""Filter updates, joined with the poses of their measurements."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from maasi_filter.models.pose import Pose
from maasi_filter.records import Cluster
from maasi_filter.ros.silence import Silence
from maasi_msgs.msg import FilterUpdate

# Robot and index of a measurement.
Key = tuple[str, int]
# Measurements that are remembered, for late or repeated updates.
_KEPT = 1000


@dataclass(frozen=True)
class JoinedUpdate:
    """An update with the poses at which its measurements were taken.

    Attributes
    ----------
    message : FilterUpdate
        As received.
    clusters : list of Cluster
        Its potential targets.
    poses : dict
        Of its members, by robot; empty where they never came.
    unknown : list
        Members without a pose: the update cannot be used.
    silence : float
        How long it waited for them [s].
    """

    message: FilterUpdate
    clusters: list[Cluster]
    poses: dict[str, Pose]
    unknown: list[Key]
    silence: float


class UpdateQueue:
    """Holds updates until the detections of all their members have arrived, in their order.

    Parameters
    ----------
    patience : float, optional
        Longest wait for detections [s]; None: without limit, as in lockstep.
    """

    def __init__(self, patience: float | None) -> None:
        self._patience = patience
        self._poses: dict[Key, Pose] = {}
        self._used: dict[Key, None] = {}
        self._updates: deque[tuple[FilterUpdate, list[Cluster], Silence]] = deque()

    def add_pose(self, robot: str, measurement: int, pose: Pose) -> None:
        """Note the pose of a measurement."""
        self._poses[robot, measurement] = pose
        if len(self._poses) > _KEPT:
            del self._poses[next(iter(self._poses))]

    def add(self, message: FilterUpdate, clusters: list[Cluster], silence: Silence) -> None:
        """Append an update, which has just come."""
        self._updates.append((message, clusters, silence))

    def take(self) -> Iterator[JoinedUpdate]:
        """Yield the updates whose detections have arrived as well, or were waited for too long.

        Duplicates, which a restarted filter publishes, are left out.
        """
        while self._updates:
            message, clusters, silence = self._updates[0]
            keys = [(member.robot, int(member.measurement)) for member in message.members]
            if keys and all(key in self._used for key in keys):
                self._updates.popleft()
                continue
            unknown = [key for key in keys if key not in self._poses]
            if unknown and (self._patience is None or silence.length < self._patience):
                return
            self._updates.popleft()
            poses = {} if unknown else {name: self._poses.pop((name, i)) for name, i in keys}
            if not unknown:
                self._used.update(dict.fromkeys(keys))
                while len(self._used) > _KEPT:
                    del self._used[next(iter(self._used))]
            yield JoinedUpdate(message, clusters, poses, unknown, silence.length)
