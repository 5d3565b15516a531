"""Facts: the events of a run.

`maasi_sim.search` and `MessageFacts` (from node messages) create facts. The log of a search
(`RunLog`), its report and its page (`EventMaker`) use them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from shapely.geometry.base import BaseGeometry

from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.records import AgentMeasurement, Cluster, FoundTarget
from maasi_filter.reports import Report
from maasi_planner.team import Decision


@dataclass(frozen=True)
class Fact:
    """An event, with the time since the first step [s]."""

    time: float


@dataclass(frozen=True)
class Present(Fact):
    """The robots of the team from a step on."""

    robots: Sequence[str]
    step: int


@dataclass(frozen=True)
class Joined(Fact):
    """A robot joined the team."""

    robot: str


@dataclass(frozen=True)
class Left(Fact):
    """A robot left the team."""

    robot: str


@dataclass(frozen=True)
class RobotAt(Fact):
    """Odometry pose of a robot: x, y, z [m], yaw [rad].

    battery: 0 to 1, negative if unknown; status: constant of `AgentState`; step: -1 if unknown.
    """

    robot: str
    pose: tuple[float, ...]
    battery: float = -1.0
    status: int = 1
    reason: str = ''
    step: int = -1


@dataclass(frozen=True)
class Decided(Fact):
    """A joint decision of a team; `indices` number the decisions of each robot."""

    team: str
    decision: Decision
    indices: Mapping[str, int]
    explored: float
    planner: str = ''
    duration: float = 0.0  # computation [s]


@dataclass(frozen=True)
class PathPlanned(Fact):
    """The planned path of a robot, (n, 3) [m]."""

    robot: str
    positions: Sequence[Sequence[float]] | FloatArray


@dataclass(frozen=True)
class Measured(Fact):
    """A measurement from a position [m]; pose: None if its attitude is unusable.

    values: range [m], bearing and elevation [rad] of each detection; covariances: of each, or
    None.
    """

    robot: str
    position: Sequence[float] | FloatArray
    pose: Pose | None
    values: Sequence[Any] | FloatArray
    covariances: Sequence[FloatArray | None] | FloatArray | None
    index: int
    batch: int = 1  # 0: not requested

    @classmethod
    def of(cls, time: float, item: AgentMeasurement) -> Measured:
        """Return the fact of a measurement for a filter."""
        values, covariances, pose = item.values, item.covariances, item.pose
        return cls(time, item.robot, pose.position, pose, values, covariances, item.index)


@dataclass(frozen=True)
class Photographed(Fact):
    """The image message with the detections of a measurement."""

    measured: Measured
    image: Any


@dataclass(frozen=True)
class Found(Fact):
    """All targets that a filter itself has found, up to its update with a batch."""

    team: str
    targets: Sequence[FoundTarget]
    batch: int


@dataclass(frozen=True)
class Updated(Fact):
    """An update of a filter: robots and indices of their measurements."""

    step: int
    team: str
    members: Sequence[tuple[str, int]]
    found: Sequence[FoundTarget] | None  # of this filter, all of them; None: unchanged
    expected: float = 0.0
    clusters: Sequence[Cluster] = ()
    duration: float = 0.0  # computation [s]
    #: True positions of all robots, (3,) [m], in a search in one process.
    positions: Mapping[str, FloatArray] = field(default_factory=dict)
    new: Sequence[FoundTarget] = ()  # newly found, if `found` has its own message
    batch: int = 0


@dataclass(frozen=True)
class Explored(Fact):
    """Exploration function of a planner on a grid: values, or letters of `shades`.

    Values below 0 are cells where no target can be. share: explored share, None if unknown;
    rounded: from a message with one cell size for both axes.
    """

    team: str
    lower: FloatArray
    step: FloatArray
    values: Any
    share: float | None = None
    rounded: bool = False


@dataclass(frozen=True)
class KeepOutsChanged(Fact):
    """The keep-out zones from now on [m, map]."""

    shapes: Sequence[BaseGeometry]


@dataclass(frozen=True)
class Reported(Fact):
    """A statement of a person that a filter has used; None: earlier ones no longer count."""

    team: str
    report: Report | None


@dataclass(frozen=True)
class Truth(Fact):
    """The true targets, (n, d) [m]."""

    targets: FloatArray


@dataclass(frozen=True)
class SceneFound(Fact):
    """Parts of a scene that a message contains."""

    parts: Mapping[str, Any]


@dataclass(frozen=True)
class Said(Fact):
    """A log line: level ('team', 'warning', 'fault', ...), source, text."""

    source: str
    level: str
    text: str


@dataclass(frozen=True)
class Modes(Fact):
    """The modes of the robots of a planner node, as it describes them."""

    node: str
    text: str


@dataclass(frozen=True)
class Shown(Fact):
    """A page event of one mission: kind, owner and content."""

    kind: str
    owner: str
    content: Sequence[Any]


@dataclass(frozen=True)
class Ended(Fact):
    """The end of a run: a key of `END_REASONS`, and its text."""

    reason: str
    text: str = ''
