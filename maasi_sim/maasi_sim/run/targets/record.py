"""The record of a run of nodes that search for targets."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.records import FoundTarget, Label
from maasi_sim.run.log import RunLog
from maasi_sim.run.mission import RunRecord
from maasi_sim.run.topics import seconds


@dataclass
class TargetRecord(RunRecord):
    """The record of a search for targets."""

    log: RunLog  #: at the end
    #: By robot, in order: chosen ones, (n, 3) [m], and poses at which it measured.
    waypoints: dict[str, FloatArray] = field(default_factory=dict)
    measured_from: dict[str, list[Pose]] = field(default_factory=dict)


def found_target(item: Any, begin: float, dimension: int = 3) -> FoundTarget:
    """Return the found target of a message, with its time since `begin` [s]."""
    position = np.array([item.position.x, item.position.y, item.position.z])
    covariance = np.array(item.covariance, dtype=float).reshape(3, 3)
    return FoundTarget(
        int(item.id),
        position[:dimension],
        covariance[:dimension, :dimension],
        item.robot,
        int(item.measurement),
        seconds(item.stamp) - begin,
        label=Label(item.class_id, item.score, item.identity),
    )
