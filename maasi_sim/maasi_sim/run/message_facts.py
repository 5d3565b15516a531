"""Facts from the messages of a run, of a bag or a ROS graph."""

import contextlib
import importlib
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from maasi_filter.geometry.area import level_shape
from maasi_filter.geometry.environment import Zone
from maasi_filter.models.pose import Pose
from maasi_filter.records import Cluster, FoundTarget, Label
from maasi_filter.reports import KINDS, Report
from maasi_planner.team import Decision, RobotDecision
from maasi_sim.run import facts
from maasi_sim.run.topics import finite_numbers, place, point, seconds
from maasi_sim.run.view.pictures import IMAGES, Pictures

STEP = 'maasi_msgs/msg/LockstepStep'
MARKERS = 'visualization_msgs/msg/MarkerArray'
# Fields of a `RobotDecision`, and of the message of a candidate.
_SAME = ('control_cost', 'target_refinement', 'exploration', 'objective', 'measurements')
_COLUMNS = {**dict(zip(_SAME, _SAME)), 'lengths': 'length'}
# Levels of rcl_interfaces/msg/Log and of diagnostic_msgs/msg/DiagnosticStatus.
_WARNING, _ERROR = 30, 40
_FINE, _STALE = 0, 3
_DIAGNOSTIC_WORDS = {0: 'recovered', 1: 'warning', 2: 'error', 3: 'stale'}
# Parts of a scene, by the last part of a marker topic and by the markers' namespace.
_PARTS = {
    ('markers', 'obstacles'): 'obstacles',
    ('search_area', 'obstacles'): 'blocks',
    ('search_area', 'objects'): 'objects',
}
# An earlier stamp on a topic by more than this begins another run [s].
_REWIND = 10.0


class MessageFacts:
    """Turns messages, of `rosbags` or of ROS, into facts.

    waits: the run begins at its first step, else with the first robot state. teams: robots with
    their own filter, whose messages contain targets of others. dimension: 2 or 3. on_restart:
    called if the time jumps back, as in a bag that is played again.
    """

    def __init__(
        self,
        waits: bool = False,
        teams: Collection[str] = (),
        dimension: int = 3,
        on_restart: Callable[[], object] | None = None,
    ) -> None:
        self._waits, self._teams, self._dimension = waits, teams, dimension
        self._on_restart = on_restart
        self._early: list[tuple[str, str, Any]] = []
        self.begin: float | None = None  #: time of the first step, or state [s]
        self._team: set[str] | None = None
        self._latest = 0.0
        # Time of the last message of each topic with the time of the run [s].
        self._last: dict[str, float] = {}
        self._levels: dict[str, int] = {}
        # Explored share by team, as last reported by its planner.
        self._shares: dict[str, float] = {}
        self.dropped = Counter[str]()  #: number of unusable messages by topic
        self.pictures = Pictures()  #: images without detections yet
        self.notes: dict[Any, Any] = {}  #: memory of readers of other missions

    def of(self, topic: str, kind: str, message: Any) -> Iterator[facts.Fact]:
        """Return the facts of a message of a topic, for which `is_read` is true.

        Unusable messages are dropped; the first one is reported as a fact.
        """
        if self._waits and kind != STEP:
            self._early.append((topic, kind, message))
            return
        self._waits = False
        try:
            for fact in READERS[kind][0](self, topic, message):
                self._latest = max(self._latest, fact.time)
                yield fact
        except (ValueError, ArithmeticError) as error:
            yield from self.drop(topic, str(error))
        early, self._early = self._early, []
        for item in early:
            yield from self.of(*item)

    def drop(self, topic: str, why: str) -> Iterator[facts.Fact]:
        """Count an unusable message; report the first one."""
        self.dropped[topic] += 1
        if self.dropped[topic] == 1:
            yield facts.Said(
                self._latest, topic, 'warning', f'dropping unusable messages; first problem: {why}'
            )

    def _now(self, topic: str, message: Any) -> float:
        """Return the run's time of a message; restart if time jumps back on its topic."""
        now = seconds(message.stamp if hasattr(message, 'stamp') else message.header.stamp)
        if self.begin is None:
            self.begin = now
        if now < self._last.get(topic, now) - _REWIND and self._on_restart is not None:
            self._on_restart()
            self.begin, self._team, self._latest = now, None, 0.0
            self._last.clear()
            self.notes.clear()
            self._shares.clear()
        self._last[topic] = now
        return now - self.begin

    def time(self, message: Any) -> float:
        """Return the run's time of a message with a header [s]; 0 before the run begins."""
        return 0.0 if self.begin is None else seconds(message.header.stamp) - self.begin

    def _step(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        time = self._now(topic, message)
        before, self._team = self._team, set(message.robots)
        if before != self._team:
            for name in sorted((before or set()) - self._team):
                yield facts.Left(time, name)
            for name in sorted(self._team - (self._team if before is None else before)):
                yield facts.Joined(time, name)
            yield facts.Present(time, sorted(self._team), int(message.step))

    def _state(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        turn = message.pose.pose.orientation
        yaw = math.atan2(
            2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y**2 + turn.z**2)
        )
        # A robot without a usable pose has a status, too.
        pose = (math.nan,) * 4
        with contextlib.suppress(ValueError):
            pose = (*place('pose', message.pose.pose.position), yaw)
        battery = float(message.battery)
        yield facts.RobotAt(
            self._now(topic, message),
            message.robot,
            pose,
            battery if math.isfinite(battery) else -1.0,
            int(message.goal_status),
            message.reason,
            int(message.step),
        )

    def _image(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        self.pictures.keep(topic, seconds(message.header.stamp), lambda: message)
        return iter(())

    def _detections(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        values, covariances = [], []
        for item in message.detections:
            own = np.asarray(item.covariance, dtype=float)
            size = round(len(own) ** 0.5)
            usable = size in (2, 3) and size**2 == len(own)
            covariances.append(own.reshape(size, size) if usable else None)
            values.append((item.range, item.bearing, item.elevation))
        at, turn = place('pose', message.pose.pose.position), message.pose.pose.orientation
        pose = None
        with contextlib.suppress(ValueError):
            pose = Pose(np.array(at), np.array([turn.w, turn.x, turn.y, turn.z]))
        index, batch = int(message.measurement), int(message.batch_id)
        measured = facts.Measured(
            self.time(message), message.robot, at, pose, values, covariances, index, batch
        )
        yield measured
        image = self.pictures.at(topic.rpartition('/')[0], seconds(message.header.stamp))
        if image is not None and pose is not None:
            yield facts.Photographed(measured.time, measured, image)

    def _update(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        clusters = []
        for item in message.clusters:
            numbers = finite_numbers('clusters.covariance', *map(float, item.covariance))
            middle = np.array(place('clusters.position', item.position))
            clusters.append(Cluster(middle, np.reshape(numbers, (3, 3)), item.radius, item.mass))
        team = _space(topic)
        yield facts.Updated(
            self.time(message),
            int(message.step),
            team,
            [(item.robot, int(item.measurement)) for item in message.members],
            None,
            message.expected_number,
            clusters,
            new=self._targets(team, message.newly_found),
            batch=int(message.batch_id),
        )

    def _found(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        team = _space(topic)
        targets = self._targets(team, message.targets)
        yield facts.Found(self.time(message), team, targets, int(message.batch_id))

    def _targets(self, team: str, messages: Iterable[Any]) -> list[FoundTarget]:
        """Return the targets that a filter found itself, without those of others."""
        return [
            self._target(item) for item in messages if team not in self._teams or item.robot == team
        ]

    def _target(self, item: Any) -> FoundTarget:
        size = self._dimension
        position = np.array(place('position', item.position))[:size]
        covariance = np.reshape(finite_numbers('covariance', *map(float, item.covariance)), (3, 3))
        return FoundTarget(
            int(item.id),
            position,
            covariance[:size, :size],
            item.robot,
            int(item.measurement),
            seconds(item.stamp) - (self.begin or 0.0),
            label=Label(item.class_id, item.score, item.identity),
        )

    def _keep_outs(self, _: str, message: Any) -> Iterator[facts.Fact]:
        shapes = [level_shape(Zone.model_validate(text)) for text in message.zones]
        yield facts.KeepOutsChanged(self.time(message), shapes)

    def _report(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        time, team = self.time(message), _space(topic)
        known = self.notes.setdefault(('reports', team), set())
        key = int(message.id), seconds(message.header.stamp)
        if not message.kind:
            known.clear()
            yield facts.Reported(time, team, None)
        # A restarted filter repeats those that it knows.
        elif key not in known:
            known.add(key)
            if message.kind >= len(KINDS):
                raise ValueError(f'kind: read {message.kind}, allowed are 0 to {len(KINDS) - 1}')
            weight, radius = finite_numbers('weight, radius', message.weight, message.radius)
            report = Report(
                KINDS[message.kind],
                weight,
                message.source,
                int(message.target),
                list(place('position', message.position))[: self._dimension],
                radius,
                message.zone,
                int(message.id),
                time,
                int(message.batch_id),
            )
            report.check()
            yield facts.Reported(time, team, report)

    def _plan(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        robots, reasons = {}, _reasons(message)
        for item in message.robots:
            columns = {
                name: np.array([getattr(row, field) for row in item.candidates])
                for name, field in _COLUMNS.items()
            }
            places = [place('candidates.position', row.position) for row in item.candidates]
            # Planned paths have their own messages.
            path, waypoint = np.zeros((0, 3)), np.array(place('waypoint', item.waypoint))
            # Recordings of earlier versions contain no tours.
            tour = [place('tour', corner) for corner in getattr(item, 'tour', ())]
            robots[item.robot] = RobotDecision(
                int(item.chosen),
                waypoint,
                path,
                path[:, 0],
                np.reshape(places, (-1, 3)),
                **columns,
                reason=reasons.get(item.robot, ''),
                tour=np.reshape(tour, (-1, 3)),
            )
        indices = {item.robot: int(item.decision) for item in message.robots}
        decision = Decision(int(message.step), robots, message.objective, reason=message.reason)
        team, (share,) = _space(topic), finite_numbers('explored', float(message.explored))
        self._shares[team] = share
        yield facts.Decided(self.time(message), team, decision, indices, share, message.planner)

    def _path(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        points = [place('poses', item.pose.position) for item in message.poses]
        yield facts.PathPlanned(self.time(message), _space(topic).rpartition('/')[2], points)

    def _grid(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        info, step = message.info, float(message.info.resolution)
        values = np.asarray(message.data, dtype=float).reshape(info.height, info.width).T / 100.0
        values[values < 0.0] = -1.0
        lower = np.add(place('info.origin', info.origin.position)[:2], 0.5 * step)
        share = self._shares.get(team := _space(topic))
        steps = np.array([step, step])
        yield facts.Explored(self.time(message), team, lower, steps, values, share, rounded=True)

    def _cloud(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        rows = np.frombuffer(bytes(message.data), dtype='<f4').reshape(-1, message.point_step // 4)
        axes = [np.unique(rows[:, axis]).astype(float) for axis in range(3)]
        shape = [len(axis) for axis in axes]
        if np.prod(shape) != len(rows) or min(shape) < 2:
            return
        lower, upper = (np.array([axis[end] for axis in axes]) for end in (0, -1))
        step = (upper - lower) / (np.array(shape) - 1)
        values = np.nan_to_num(rows[:, 3].reshape(shape).astype(float), nan=-1.0)
        share = self._shares.get(team := _space(topic))
        yield facts.Explored(self.time(message), team, lower, step, values, share)

    def _truth(self, _: str, message: Any) -> Iterator[facts.Fact]:
        points = [place('poses', item.position) for item in message.poses]
        yield facts.Truth(self._latest, np.array(points).reshape(-1, 3)[:, : self._dimension])

    def _scenery(self, topic: str, message: Any) -> Iterator[facts.Fact]:
        parts: dict[str, list[Any]] = {}
        for item in message.markers:
            part = _PARTS.get((topic.rpartition('/')[2], item.ns.rpartition('/')[2]), '')
            at, size = point(item.pose.position), np.array(point(item.scale))
            if part == 'obstacles':
                parts.setdefault(part, []).append([*at[:2], 0.5 * float(size[0])])
            elif part:
                box = np.stack([at - 0.5 * size, at + 0.5 * size], axis=1)
                parts.setdefault(part, []).append(box.tolist())
        if parts:
            yield facts.SceneFound(self._latest, parts)

    def _log(self, _: str, message: Any) -> Iterator[facts.Fact]:
        level = int(message.level)
        if level >= _WARNING:
            word = 'fault' if level >= _ERROR else 'warning'
            yield facts.Said(self._latest, message.name, word, message.msg)

    def _diagnostics(self, _: str, message: Any) -> Iterator[facts.Fact]:
        for status in message.status:
            raw = status.level
            level = raw[0] if isinstance(raw, bytes) else int(raw)
            before = self._levels.get(status.name, _FINE)
            self._levels[status.name] = level
            if level != before and _FINE <= level <= _STALE:
                word = 'fault' if level > 1 else 'warning' if level else 'team'
                text = f'{_DIAGNOSTIC_WORDS[level]}: {status.message}'
                yield facts.Said(self._latest, status.name, word, text)
            for item in status.values:
                if item.key == 'search':
                    yield facts.Modes(self._latest, status.name, item.value)
                elif item.key == 'explored':
                    with contextlib.suppress(ValueError):
                        self._shares[_space(status.name)] = float(item.value)

    def _end(self, _: str, message: Any) -> Iterator[facts.Fact]:
        reason, _, text = message.data.partition('\n')
        yield facts.Ended(self._latest, reason, text)


Reader = Callable[[MessageFacts, str, Any], Iterator[facts.Fact]]
# Reader and allowed last parts of the topic's name (none: any), by type.
READERS: dict[str, tuple[Reader, tuple[str, ...]]] = {
    STEP: (MessageFacts._step, ()),
    'maasi_msgs/msg/AgentState': (MessageFacts._state, ()),
    'maasi_msgs/msg/DetectionArray': (MessageFacts._detections, ()),
    'maasi_msgs/msg/FilterUpdate': (MessageFacts._update, ()),
    'maasi_msgs/msg/FoundTargetArray': (MessageFacts._found, ('found_targets',)),
    'maasi_msgs/msg/KeepOuts': (MessageFacts._keep_outs, ()),
    'maasi_msgs/msg/Report': (MessageFacts._report, ('reports',)),
    'maasi_msgs/msg/PlanDecision': (MessageFacts._plan, ()),
    'nav_msgs/msg/Path': (MessageFacts._path, ('plan',)),
    'nav_msgs/msg/OccupancyGrid': (MessageFacts._grid, ('exploration',)),
    'sensor_msgs/msg/PointCloud2': (MessageFacts._cloud, ('exploration',)),
    'geometry_msgs/msg/PoseArray': (MessageFacts._truth, ('ground_truth/targets',)),
    'std_msgs/msg/String': (MessageFacts._end, ('ending',)),
    MARKERS: (MessageFacts._scenery, ('ground_truth/markers', 'search_area', 'markers')),
    'rcl_interfaces/msg/Log': (MessageFacts._log, ('rosout',)),
    'diagnostic_msgs/msg/DiagnosticArray': (MessageFacts._diagnostics, ('diagnostics',)),
    **{kind: (MessageFacts._image, (name,)) for kind, name in IMAGES.items()},
}
# Those of other missions are in their folders.
for path in sorted(Path(__file__).parent.glob('*/facts.py')):
    module = importlib.import_module(f'{__package__}.{path.parent.name}.facts')
    READERS |= module.READERS
    _PARTS |= module.PARTS


def is_read(topic: str, kind: str) -> bool:
    """Return whether messages of this topic and type contain facts."""
    if kind not in READERS or '/_' in topic:
        return False
    _, names = READERS[kind]
    return not names or any(topic.endswith(f'/{name}') for name in names)


def _reasons(message: Any) -> dict[str, str]:
    """Return the reasons of a decision by robot (inverse of `decision_to_ros`)."""
    names = '|'.join(re.escape(item.robot) for item in message.robots)
    parts = re.split(rf'(?:^|; )({names}): ', message.reason)[1:] if names else []
    return dict(zip(parts[::2], parts[1::2]))


def _space(topic: str) -> str:
    return topic.rpartition('/')[0].strip('/')
