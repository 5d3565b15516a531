"""A buffer of the transforms on /tf: where a frame was in another one at a stamp. Without ROS."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from maasi_drivers.agent.odometry import StampedPose, interpolate
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.ros.clocks import StampGate

# Upper bound on frames, against floods.
_MOST_FRAMES = 2000
_MOST_STAMPS = 4096
_LONGEST_NAME = 200


class TransformError(LookupError):
    """A transform is not known, or not at that stamp."""


class _Edge:
    """The pose of a frame in its parent, over time."""

    def __init__(self, parent: str, static: bool, horizon: int) -> None:
        self.parent = parent
        self.static = static
        self.gate = StampGate(horizon)
        self.stamps: list[int] = []
        self.poses: list[Pose] = []

    def at(self, stamp: int | None) -> Pose:
        """Return the pose at a stamp within those kept; None: the latest."""
        if self.static or stamp is None:
            return self.poses[-1]
        index = bisect_left(self.stamps, stamp)
        if self.stamps[index] == stamp:
            return self.poses[index]
        first, second = (_still(self.stamps[k], self.poses[k]) for k in (index - 1, index))
        return interpolate(first, second, stamp).pose


def _still(stamp: int, pose: Pose) -> StampedPose:
    zero = np.zeros(3)
    return StampedPose(stamp, pose, np.zeros((6, 6)), zero, zero)


class TransformBuffer:
    """Poses of frames in their parents, interpolated in time; nothing is extrapolated.

    Units: horizon [ns].
    """

    def __init__(self, horizon: int = 10_000_000_000) -> None:
        self.horizon = horizon
        self._edges: dict[str, _Edge] = {}

    def clear(self) -> None:
        """Forget all transforms that are not static, as after a jump of the clock."""
        self._edges = {name: edge for name, edge in self._edges.items() if edge.static}

    def add(
        self, parent: str, child: str, pose: Pose, stamp: int = 0, *, static: bool = False
    ) -> None:
        """Add a transform; a frame that has another parent from now on loses what was known of it.

        A single stamp that jumps by more than the horizon is not added; the next one that follows
        it is, and what was before it is forgotten.

        Units: stamp [ns].
        """
        for name in (parent, child):
            if not 0 < len(name) <= _LONGEST_NAME:
                raise ValueError(
                    f'frame: read {name[:40]!r}, allowed are names of 1 to {_LONGEST_NAME} letters'
                )
        if stamp < 0:
            raise ValueError(f'stamp: read {stamp} ns, allowed is from 0')
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent or edge.static != static:
            if edge is None and len(self._edges) >= _MOST_FRAMES:
                raise ValueError(f'{child!r}: there are {_MOST_FRAMES} frames, no more are allowed')
            if child in self._path(parent):
                raise ValueError(f'{parent!r} to {child!r}: a loop, allowed is a tree of frames')
            edge = self._edges[child] = _Edge(parent, static, self.horizon)
        if static:
            edge.poses[:] = [pose]
        elif edge.gate.accepts(stamp):
            self._insert(edge, stamp, pose)

    def _insert(self, edge: _Edge, stamp: int, pose: Pose) -> None:
        stamps, poses = edge.stamps, edge.poses
        if stamps and abs(stamp - stamps[-1]) > self.horizon:
            stamps.clear()
            poses.clear()
        index = bisect_left(stamps, stamp)
        if index < len(stamps) and stamps[index] == stamp:
            poses[index] = pose
            return
        stamps.insert(index, stamp)
        poses.insert(index, pose)
        old = max(bisect_left(stamps, stamps[-1] - self.horizon), len(stamps) - _MOST_STAMPS)
        del stamps[:old], poses[:old]

    def _path(self, frame: str) -> list[str]:
        """Return a frame and those above it, up to its root."""
        path = [frame]
        while (edge := self._edges.get(path[-1])) is not None:
            path.append(edge.parent)
        return path

    def _between(self, target: str, source: str) -> tuple[list[_Edge], list[_Edge]]:
        """Return the edges from target and from source up to the frame above both."""
        if target == source:
            return [], []
        known = {edge.parent for edge in self._edges.values()} | self._edges.keys()
        for name in (target, source):
            if name not in known:
                raise TransformError(f'frame {name!r} is not known')
        up, down = self._path(target), self._path(source)
        common = next((name for name in down if name in up), None)
        if common is None:
            raise TransformError(
                f'{source!r} and {target!r} are not connected: their roots are {down[-1]!r} and '
                f'{up[-1]!r}'
            )
        parts = (up[: up.index(common)], down[: down.index(common)])
        ups, downs = ([self._edges[name] for name in part] for part in parts)
        for edge, name in zip([*ups, *downs], [*parts[0], *parts[1]], strict=True):
            if not edge.poses:
                raise TransformError(f'nothing is known yet of {name!r} in {edge.parent!r}')
        return ups, downs

    def latest(self, target: str, source: str) -> int | None:
        """Return the latest stamp [ns] at which all transforms between two frames are known.

        None where all of them are static.
        """
        ups, downs = self._between(target, source)
        return min((edge.stamps[-1] for edge in [*ups, *downs] if not edge.static), default=None)

    def pose(self, target: str, source: str, stamp: int | None = None) -> Pose:
        """Return the pose of frame `source` in frame `target`.

        Units: stamp [ns].
        """
        ups, downs = self._between(target, source)
        dynamic = [edge for edge in [*ups, *downs] if not edge.static]
        if dynamic:
            first = max(edge.stamps[0] for edge in dynamic)
            last = min(edge.stamps[-1] for edge in dynamic)
            stamp = last if stamp is None else stamp
            if not first <= stamp <= last:
                raise TransformError(
                    f'{source!r} in {target!r} at {stamp} ns is not known, allowed is from {first} '
                    f'to {last} ns'
                )
        sides = []
        for edges in (ups, downs):
            placed = Pose(np.zeros(3))
            for edge in edges:
                placed = compose(edge.at(stamp), placed)
            sides.append(placed)
        return compose(inverse(sides[0]), sides[1])
