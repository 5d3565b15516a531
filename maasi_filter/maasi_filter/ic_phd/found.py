"""Found targets: they remove their measurements from later corrections (000, section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from maasi_filter.measurement_check import CheckedMeasurement
from maasi_filter.models.label import UNLABELLED, Label
from maasi_filter.records import FoundTarget

FloatArray = NDArray[np.float64]

# Gate on the squared normalised distance of two estimates of the same target.
SAME_TARGET = 16.0


def distance(position: FloatArray, covariance: FloatArray, target: FoundTarget) -> float:
    """Return the squared normalised distance between an estimate and a found target."""
    offset = position - target.position
    return float(offset @ np.linalg.solve(covariance + target.covariance, offset))


def kept_measurements(
    centres: FloatArray, targets: Sequence[FoundTarget], limit: float, every: bool
) -> NDArray[np.bool_]:
    """Return which of m detections remain after removing those of found targets.

    Parameters
    ----------
    centres : (m, d) array
        g^-1(z), metres.
    limit : float
        T_z, metres.
    every : bool
        Whether to remove all detections within T_z of a found target (003, algorithm 1), or only
        the closest one to each (000, section 3.3; 001, algorithm 1).
    """
    keep = np.ones(len(centres), np.bool_)
    for target in targets:
        apart = np.sqrt(((centres - target.position) ** 2).sum(axis=1))
        near = keep & (apart <= limit)
        if every:
            keep &= ~near
        elif near.any():
            keep[int(np.argmin(np.where(near, apart, np.inf)))] = False
    return keep


def nearest_label(
    position: FloatArray, members: Sequence[CheckedMeasurement], limit: float
) -> Label:
    """Return the label of the detection nearest to a position, within T_z = `limit` metres.

    The PHD filter does not associate detections with targets.
    """
    best, least = UNLABELLED, limit
    for member in members:
        if not member.labels:
            continue
        centres = member.sensor.measurement.inverse(member.values, member.pose)
        for label, apart in zip(member.labels, np.linalg.norm(centres - position, axis=1).tolist()):
            if apart <= least:
                best, least = label, apart
    return best


class FoundTargets:
    """Found targets of a filter: its own, and those of the filters of other robots.

    Attributes
    ----------
    targets : list of FoundTarget
        In the order of being found.
    """

    def __init__(self, targets: Sequence[FoundTarget] = ()) -> None:
        self.targets = list(targets)

    def next_id(self) -> int:
        """Return the id of the next found target."""
        return 1 + max((target.id for target in self.targets), default=0)

    def own(self) -> list[FoundTarget]:
        """Return the targets that this filter found itself."""
        return [target for target in self.targets if not target.origin]

    def _nearest(self, target: FoundTarget) -> int:
        """Return the index of the nearest found target within the gate, or -1."""
        apart = [distance(target.position, target.covariance, known) for known in self.targets]
        best = int(np.argmin(apart)) if apart else -1
        return best if apart and apart[best] < SAME_TARGET else -1

    def _is_older(self, f: int, time: float, robot: str) -> bool:
        return (self.targets[f].time, self.targets[f].robot) <= (time, robot)

    def take_over(self, robot: str, targets: Sequence[FoundTarget]) -> tuple[list, bool]:
        """Merge targets found by another filter; return the new ones, and whether any changed.

        A target that two robots found belongs to the robot that found it first (ties: first by
        name), and follows the estimate of that robot (002, section 4).
        """
        added: list[FoundTarget] = []
        changed = False
        for target in targets:
            indices = {(item.robot, item.origin): f for f, item in enumerate(self.targets)}
            f = indices.get((robot, target.id), -1)
            if f < 0:
                f = self._nearest(target)
                if f >= 0 and self._is_older(f, target.time, robot):
                    continue
            number = self.targets[f].id if f >= 0 else self.next_id()
            taken = replace(target, id=number, robot=robot, origin=target.id)
            if f < 0:
                self.targets.append(taken)
                added.append(taken)
            elif _is_equal(taken, self.targets[f]):
                continue
            else:
                self.targets[f] = taken
            changed = True
        return added, changed

    def keep(self, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Add targets that were found before a restart; return the new ones.

        They keep their ids, except that an id in use is replaced by the next free one.
        """
        own = {target.id: target for target in self.targets}
        kept = {target.id for target in targets}
        since = [target for target in self.targets if target.id not in kept]
        new: list[FoundTarget] = []
        for target in targets:
            rivals = [own[target.id]] if target.id in own else since
            apart = [distance(target.position, target.covariance, known) for known in rivals]
            if min(apart, default=np.inf) < SAME_TARGET:
                continue
            added = replace(target, id=self.next_id() if target.id in own else target.id)
            self.targets.append(added)
            new.append(added)
        return new


def _is_equal(one: FoundTarget, other: FoundTarget) -> bool:
    return (
        (one.origin, one.robot) == (other.origin, other.robot)
        and np.array_equal(one.position, other.position)
        and np.array_equal(one.covariance, other.covariance)
    )
