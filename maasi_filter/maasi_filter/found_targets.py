"""Found targets of a filter, its own and those of other filters (002, section 4)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.records import FoundTarget
from maasi_filter.vector_math import squared_distance

SAME_TARGET = 16.0  # gate on the squared normalised distance of two estimates of the same target


def distance(position: FloatArray, covariance: FloatArray, target: FoundTarget) -> float:
    """Return the squared normalised distance between an estimate and a found target."""
    return squared_distance(position - target.position, covariance + target.covariance)


def nearest(target: FoundTarget, estimates: Sequence[tuple[FloatArray, FloatArray]]) -> int:
    """Return the index of the nearest estimate, position and covariance, within the gate, or -1."""
    apart = [distance(*estimate, target) for estimate in estimates]
    best = int(np.argmin(apart)) if apart else -1
    return best if apart and apart[best] < SAME_TARGET else -1


@dataclass
class FoundTargets:
    """Found targets of a filter: its own, and those of the filters of other robots."""

    targets: list[FoundTarget] = field(default_factory=list)  # In the order of being found
    last_id: int = 0  # Largest id given so far

    def next_id(self) -> int:
        """Return the id of the next found target."""
        self.last_id += 1
        return self.last_id

    def take_over(self, robot: str, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Merge targets found by another filter; return those that are new or changed."""
        added, changed = [], []
        for target in targets:
            known = [(item.robot, item.origin) == (robot, target.id) for item in self.targets]
            estimates = [(item.position, item.covariance) for item in self.targets]
            f = known.index(True) if any(known) else nearest(target, estimates)
            old = self.targets[f] if f >= 0 else None
            if old is not None and not any(known) and (old.time, old.robot) <= (target.time, robot):
                continue  # another one found it first
            number = self.next_id() if old is None else old.id
            new = replace(target, id=number, robot=robot, origin=target.id)
            if old is None:
                self.targets.append(new)
                added.append(new)
            elif not (
                (new.origin, new.robot) == (old.origin, old.robot)
                and np.array_equal(new.position, old.position)
                and np.array_equal(new.covariance, old.covariance)
            ):
                self.targets[f] = new
                changed.append(new)
        return added + changed

    def keep(self, targets: Sequence[FoundTarget]) -> list[FoundTarget]:
        """Add targets that were found before a restart; return the new ones."""
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
            self.last_id = max(self.last_id, added.id)
            self.targets.append(added)
            new.append(added)
        return new
