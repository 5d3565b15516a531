"""Found targets of a filter and of the filters of other robots (002, section 4)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.vector_math import squared_distance
from maasi_filter.records import FoundTarget

SAME_TARGET = 16.0  # gate on the squared normalised distance of two estimates of the same target


def distance(position: FloatArray, covariance: FloatArray, target: FoundTarget) -> float:
    """Return the squared normalised distance between an estimate and a found target."""
    return squared_distance(position - target.position, covariance + target.covariance)


def nearest(target: FoundTarget, estimates: Sequence[tuple[FloatArray, FloatArray]]) -> int:
    """Return the index of the nearest (position, covariance) within the gate, or -1."""
    apart = [distance(*estimate, target) for estimate in estimates]
    best = int(np.argmin(apart)) if apart else -1
    return best if apart and apart[best] < SAME_TARGET else -1


@dataclass
class FoundTargets:
    """Found targets known to a filter, in the order of being found, and the largest id so far."""

    targets: list[FoundTarget] = field(default_factory=list)
    last_id: int = 0

    def next_id(self) -> int:
        """Return the id of the next found target."""
        self.last_id += 1
        return self.last_id


@dataclass
class Change:
    """Found targets after a change: all of them, new or changed ones, and removed ones."""

    found: FoundTargets
    changed: list[FoundTarget] = field(default_factory=list)
    withdrawn: list[FoundTarget] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.changed or self.withdrawn)


def merge(own: FoundTargets, others: Mapping[str, Sequence[FoundTarget]]) -> Change:
    """Merge the found targets of a filter with all those of others, given by robot.

    A target found by two robots belongs to the first finder (ties: first by name), and follows the
    estimate of that robot.
    """
    change = Change(FoundTargets([*own.targets], own.last_id))
    for robot, targets in others.items():
        _adopt(change, robot, targets)
    for robot, targets in others.items():
        theirs = {target.id for target in targets}
        change.withdrawn += [
            item
            for item in change.found.targets
            if item.origin and item.robot == robot and item.origin not in theirs
        ]
    gone = {target.id for target in change.withdrawn}
    change.found.targets = [item for item in change.found.targets if item.id not in gone]
    return change


def _adopt(change: Change, robot: str, targets: Sequence[FoundTarget]) -> None:
    known, changed = change.found.targets, []
    for target in targets:
        same = [(item.robot, item.origin) == (robot, target.id) for item in known]
        estimates = [(item.position, item.covariance) for item in known]
        f = same.index(True) if any(same) else nearest(target, estimates)
        if f < 0:
            known.append(replace(target, id=change.found.next_id(), robot=robot, origin=target.id))
            change.changed.append(known[-1])
            continue
        old = known[f]
        # A target restored after a restart has its robot, but no id of that robot's filter.
        theirs = any(same) or (old.robot, old.origin) == (robot, 0)
        if not theirs and (old.time, old.robot) <= (target.time, robot):
            continue  # another robot found it first
        new = replace(target, id=old.id, robot=robot, origin=target.id)
        if not (
            (new.origin, new.robot) == (old.origin, old.robot)
            and np.array_equal(new.position, old.position)
            and np.array_equal(new.covariance, old.covariance)
        ):
            known[f] = new
            changed.append(new)
    change.changed += changed


def restore(own: FoundTargets, kept: Sequence[FoundTarget]) -> Change:
    """Add targets found before the filter was created; an id in use becomes the next free one."""
    change = Change(FoundTargets([*own.targets], own.last_id))
    known, ids = {target.id: target for target in own.targets}, {target.id for target in kept}
    since = [target for target in own.targets if target.id not in ids]
    for target in kept:
        rivals = [known[target.id]] if target.id in known else since
        apart = [distance(target.position, target.covariance, rival) for rival in rivals]
        if min(apart, default=np.inf) >= SAME_TARGET:
            used = target.id in known
            added = replace(target, id=change.found.next_id() if used else target.id)
            change.found.last_id = max(change.found.last_id, added.id)
            change.found.targets.append(added)
            change.changed.append(added)
    return change
