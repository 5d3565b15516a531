"""Transforms on /tf at any stamp, without ROS: the ROS 2 wheels have no tf2_ros."""

from dataclasses import dataclass, field

import numpy as np

from maasi_drivers.agent.odometry import PoseHistory, StampedPose
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.ros.clocks import StampGate

# Limits against floods.
_MOST_FRAMES = 2000
_LONGEST_NAME = 200
_JUMP = 10_000_000_000  # a stamp farther from the previous one belongs to another time [ns]


class TransformError(LookupError):
    """A transform is unknown, or unknown at a stamp."""


@dataclass
class _Edge:
    """The pose of a frame in its parent: fixed, or its latest ones."""

    parent: str
    fixed: Pose | None
    history: PoseHistory = field(default_factory=PoseHistory)
    gate: StampGate = field(default_factory=lambda: StampGate(_JUMP))

    @property
    def last(self) -> int | None:
        """Latest stamp [ns]; None if fixed."""
        latest = self.history.latest
        return None if latest is None else latest.stamp

    def add(self, stamp: int, pose: Pose) -> None:
        """Add a pose; one far from the previous ones replaces them once the next follows it."""
        if not self.gate.accepts(stamp):
            return
        if self.last is not None and abs(stamp - self.last) > _JUMP:
            self.history.clear()
        self.history.add(StampedPose(stamp, pose))


class TransformBuffer:
    """Poses of frames in their parents, interpolated but never extrapolated."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def clear(self) -> None:
        """Discard transforms that are not static."""
        self._edges = {name: edge for name, edge in self._edges.items() if edge.fixed is not None}

    def add(
        self, parent: str, child: str, pose: Pose, stamp: int = 0, *, static: bool = False
    ) -> None:
        """Add a transform, later than before [ns]; a new parent replaces the old transforms."""
        for name in (parent, child):
            if not 0 < len(name) <= _LONGEST_NAME:
                raise ValueError(
                    f'frame: read {name[:40]!r}, allowed are names of 1 to {_LONGEST_NAME} letters'
                )
        if stamp < 0:
            raise ValueError(f'stamp: read {stamp} ns, allowed is from 0')
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent or (edge.fixed is not None) != static:
            if edge is None and len(self._edges) >= _MOST_FRAMES:
                raise ValueError(f'{child!r}: more than {_MOST_FRAMES} frames, allowed are fewer')
            if child in self._path(parent):
                raise ValueError(f'{parent!r} to {child!r}: a loop, allowed is a tree of frames')
            edge = self._edges[child] = _Edge(parent, pose if static else None)
        if static:
            edge.fixed = pose
        else:
            edge.add(stamp, pose)

    def _path(self, frame: str) -> list[str]:
        path = [frame]
        while (edge := self._edges.get(path[-1])) is not None:
            path.append(edge.parent)
        return path

    def _between(self, target: str, source: str) -> tuple[list[_Edge], list[_Edge]]:
        if target == source:
            return [], []
        known = {edge.parent for edge in self._edges.values()} | self._edges.keys()
        for name in (target, source):
            if name not in known:
                raise TransformError(f'unknown frame {name!r}')
        up, down = self._path(target), self._path(source)
        common = next((name for name in down if name in up), None)
        if common is None:
            raise TransformError(
                f'{source!r} and {target!r} are not connected: their roots are {down[-1]!r} and '
                f'{up[-1]!r}'
            )
        parts = (up[: up.index(common)], down[: down.index(common)])
        ups, downs = ([self._edges[name] for name in part] for part in parts)
        return ups, downs

    def latest(self, target: str, source: str) -> int | None:
        """Return the latest common stamp [ns] between two frames; None if all are static."""
        ups, downs = self._between(target, source)
        return min((edge.last for edge in [*ups, *downs] if edge.last is not None), default=None)

    def pose(self, target: str, source: str, stamp: int | None = None) -> Pose:
        """Return the pose of `source` in `target` at a stamp [ns], default: `latest`."""
        stamp = self.latest(target, source) if stamp is None else stamp
        sides = []
        for edges in self._between(target, source):
            placed = Pose(np.zeros(3))
            for edge in edges:
                found = edge.fixed
                if found is None and (then := edge.history.at(stamp or 0)) is not None:
                    found = then.pose
                if found is None:
                    raise TransformError(
                        f'{source!r} in {target!r} at {stamp} ns is unknown, allowed is from '
                        f'{edge.history.first} to {edge.last} ns'
                    )
                placed = compose(found, placed)
            sides.append(placed)
        return compose(inverse(sides[0]), sides[1])
