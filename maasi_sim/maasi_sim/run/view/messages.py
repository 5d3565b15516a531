"""Makes events from the messages of a bag or ROS graph, by type or name."""

import contextlib
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maasi_filter.arrays import FloatArray
from maasi_filter.geometry.area import level_shape
from maasi_filter.geometry.environment import Zone
from maasi_filter.models.pose import Pose
from maasi_filter.records import Cluster
from maasi_planner.team import Decision, RobotDecision
from maasi_sim.run.bag import Bag, BagError
from maasi_sim.run.targets.record import found_target
from maasi_sim.run.topics import point, seconds
from maasi_sim.run.view.event_log import Event, EventLog
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.pictures import IMAGES, Pictures, picture
from maasi_sim.run.view.scene import empty_scene, scene_of_facts, zones_as

STEP = 'maasi_msgs/msg/LockstepStep'
MARKERS = 'visualization_msgs/msg/MarkerArray'
_PROGRESS = 1000  # messages between two words on the progress
# Fields of a `RobotDecision`, and of the message of a candidate.
_SAME = ('control_cost', 'target_refinement', 'exploration', 'objective', 'measurements')
_COLUMNS = {**dict(zip(_SAME, _SAME)), 'lengths': 'length'}
# Parts of a scene, by the last part of a topic of markers and of their namespace.
_PARTS = {
    ('markers', 'obstacles'): 'obstacles',
    ('search_area', 'obstacles'): 'blocks',
    ('search_area', 'objects'): 'objects',
    ('markers', 'cuboids'): 'cuboids',
}
# Levels of rcl_interfaces/msg/Log and of diagnostic_msgs/msg/DiagnosticStatus.
_WARNING, _ERROR = 30, 40
_FINE, _STALE = 0, 3
_DIAGNOSTIC_WORDS = {0: 'well again', 1: 'warning', 2: 'error', 3: 'stale'}
# A stamp that is earlier than the topic's last one by more than this begins another run [s].
_REWIND = 10.0
# By type: the method that takes it, and the last parts that the name may have; none: any.
TOPICS: dict[str, tuple[str, ...]] = {
    STEP: ('_take_step',),
    'maasi_msgs/msg/AgentState': ('_take_state',),
    'maasi_msgs/msg/DetectionArray': ('_take_detections',),
    'maasi_msgs/msg/FilterUpdate': ('_take_update',),
    'maasi_msgs/msg/FoundTargetArray': ('_take_found', 'found_targets'),
    'maasi_msgs/msg/KeepOuts': ('_take_keep_outs',),
    'maasi_msgs/msg/PlanDecision': ('_take_plan',),
    'maasi_msgs/msg/CuboidDecision': ('_take_cuboid',),
    'nav_msgs/msg/Path': ('_take_path', 'plan'),
    'nav_msgs/msg/OccupancyGrid': ('_take_grid', 'exploration'),
    'sensor_msgs/msg/PointCloud2': ('_take_cloud', 'exploration'),
    'geometry_msgs/msg/PoseArray': ('_take_truth', 'ground_truth/targets'),
    'std_msgs/msg/String': ('_take_end', 'ending'),
    MARKERS: ('_take_markers', 'ground_truth/markers', 'search_area', 'markers'),
    'rcl_interfaces/msg/Log': ('_take_log', 'rosout'),
    'diagnostic_msgs/msg/DiagnosticArray': ('_take_diagnostics', 'diagnostics'),
    **{kind: ('_take_image', name) for kind, name in IMAGES.items()},
}


def is_shown(topic: str, type_name: str) -> bool:
    """Return whether messages of a topic are shown."""
    if type_name not in TOPICS or '/_' in topic:
        return False
    names = TOPICS[type_name][1:]
    return not names or any(topic.endswith(f'/{name}') for name in names)


class MessageEvents:
    """Take messages, of `rosbags` or of ROS, and hand their events to a maker.

    The run begins at its first step where it `waits`, else with the first state. `on_restart` is
    called when the time jumps back, as in a bag that is played again: nothing is then kept.
    """

    def __init__(
        self,
        maker: EventMaker,
        waits: bool = False,
        on_restart: Callable[[], EventMaker] | None = None,
    ) -> None:
        self.maker, self._waits, self._on_restart = maker, waits, on_restart
        self._early: list[tuple[str, str, Any]] = []
        self._begin: float | None = None
        self._team: set[str] | None = None
        # Time of the last message of each topic with the time of the run [s].
        self._last: dict[str, float] = {}
        self._levels: dict[str, int] = {}
        self.pictures = Pictures()  #: images that wait for their detections

    def take(self, topic: str, type_name: str, message: Any) -> None:
        """Take a message of a topic for which `is_shown` is true."""
        if self._waits and type_name != STEP:
            self._early.append((topic, type_name, message))
            return
        self._waits = False
        getattr(self, TOPICS[type_name][0])(topic, message)
        early, self._early = self._early, []
        for item in early:
            self.take(*item)

    def _now(self, topic: str, message: Any) -> float:
        """Return the run's time of a message; begin again if time jumps back on its topic."""
        now = seconds(message.stamp if hasattr(message, 'stamp') else message.header.stamp)
        if self._begin is None:
            self._begin = now
        if now < self._last.get(topic, now) - _REWIND and self._on_restart is not None:
            self.maker = self._on_restart()
            self._begin, self._team = now, None
            self._last.clear()
        self._last[topic] = now
        return max(now - self._begin, 0.0)

    def _time(self, message: Any) -> float:
        if self._begin is None:
            return 0.0
        return max(seconds(message.header.stamp) - self._begin, 0.0)

    def _take_step(self, topic: str, message: Any) -> None:
        time = self._now(topic, message)
        before, self._team = self._team, set(message.robots)
        if before is not None:
            for name in sorted(before - self._team):
                self.maker.leave(time, name)
            for name in sorted(self._team - before):
                self.maker.message(time, name, 'team', 'joined')

    def _take_state(self, topic: str, message: Any) -> None:
        pose = message.pose.pose
        turn = pose.orientation
        yaw = math.atan2(
            2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y**2 + turn.z**2)
        )
        place = (*point(pose.position), yaw)
        if all(map(math.isfinite, place)):
            time = self._now(topic, message)
            # The driver of a robot that left may publish for a while.
            if self._team is not None and message.robot not in self._team:
                return
            self.maker.robot(
                time,
                message.robot,
                place,
                message.battery if math.isfinite(message.battery) else -1.0,
                message.goal_status,
                message.reason,
            )

    def _take_image(self, topic: str, message: Any) -> None:
        self.pictures.keep(topic, seconds(message.header.stamp), lambda: message)

    def _take_detections(self, topic: str, message: Any) -> None:
        values, covariances = [], []
        for item in message.detections:
            own = np.asarray(item.covariance, dtype=float)
            size = round(len(own) ** 0.5)
            usable = size in (2, 3) and size**2 == len(own)
            covariances.append(own.reshape(size, size) if usable else None)
            values.append((item.range, item.bearing, item.elevation))
        place, turn = point(message.pose.pose.position), message.pose.pose.orientation
        time, robot = self._time(message), message.robot
        self.maker.seen(time, robot, place, values, covariances)
        image = self.pictures.at(topic.rpartition('/')[0], seconds(message.header.stamp))
        if image is not None:
            facts = self.maker.scene['robots'].get(robot, {})
            # One that cannot be decoded is not shown.
            with contextlib.suppress(ValueError):
                pose = Pose(np.array(place), np.array([turn.w, turn.x, turn.y, turn.z]))
                self.maker.picture(time, robot, picture(image, facts, pose, values))

    def _take_update(self, topic: str, message: Any) -> None:
        clusters = []
        for item in message.clusters:
            covariance = np.asarray(item.covariance, dtype=float).reshape(3, 3)
            place = np.array(point(item.position))
            clusters.append(Cluster(place, covariance, item.radius, item.mass))
        members = [(item.robot, int(item.measurement)) for item in message.members]
        space, expected = _space(topic), message.expected_number
        self.maker.filter(self._time(message), space, expected, clusters, members)

    def _take_found(self, topic: str, message: Any) -> None:
        targets = [found_target(item, self._begin or 0.0) for item in message.targets]
        self.maker.found(self._time(message), _space(topic), targets)

    def _take_keep_outs(self, _: str, message: Any) -> None:
        shapes = [level_shape(Zone.model_validate(text)) for text in message.zones]
        zones = [zone for zone in self.maker.scene.get('zones', []) if zone['kind'] != 'keep_out']
        self.maker.zones(self._time(message), [*zones, *zones_as('keep_out', shapes)])

    def _take_plan(self, topic: str, message: Any) -> None:
        robots, reasons = {}, _reasons(message)
        for item in message.robots:
            columns = {
                name: np.array([getattr(row, field) for row in item.candidates])
                for name, field in _COLUMNS.items()
            }
            places = np.array([point(row.position) for row in item.candidates]).reshape(-1, 3)
            # Planned ways are messages of their own.
            way, waypoint = np.zeros((0, 3)), np.array(point(item.waypoint))
            # Recordings of earlier versions have no tours.
            tour = np.array([point(place) for place in getattr(item, 'tour', ())]).reshape(-1, 3)
            robots[item.robot] = RobotDecision(
                int(item.chosen),
                waypoint,
                way,
                way[:, 0],
                places,
                **columns,
                reason=reasons.get(item.robot, ''),
                tour=tour,
            )
        indices = {item.robot: int(item.decision) for item in message.robots}
        decision = Decision(message.step, robots, message.objective, reason=message.reason)
        time, space = self._time(message), _space(topic)
        self.maker.plan(time, space, message.planner, decision, indices, message.explored)

    def _take_cuboid(self, _: str, message: Any) -> None:
        self.maker.cuboid(self._time(message), message)

    def _take_path(self, topic: str, message: Any) -> None:
        points = [point(item.pose.position) for item in message.poses]
        self.maker.way(self._time(message), _space(topic).rpartition('/')[2], points)

    def _take_grid(self, topic: str, message: Any) -> None:
        info = message.info
        values = np.asarray(message.data, dtype=float).reshape(info.height, info.width).T / 100.0
        values[values < 0.0] = -1.0
        step = float(info.resolution)
        steps = np.array([step, step])
        corner = np.add(point(info.origin.position)[:2], 0.5 * step)
        self._learn_bounds(corner, corner + step * (np.array(values.shape) - 1))
        # A grid has one resolution; nodes of the map are on all bounds.
        low, high = np.array(self.maker.scene['bounds'])[:2].T
        exact = (high - low) / np.maximum(np.array(values.shape) - 1, 1)
        if np.allclose(exact, step, rtol=0.05):
            corner, steps = low, exact
        self.maker.map(self._time(message), _space(topic), corner, steps, values)

    def _take_cloud(self, topic: str, message: Any) -> None:
        rows = np.frombuffer(bytes(message.data), dtype='<f4').reshape(-1, message.point_step // 4)
        axes = [np.unique(rows[:, axis]).astype(float) for axis in range(3)]
        shape = [len(axis) for axis in axes]
        if np.prod(shape) != len(rows) or min(shape) < 2:
            return
        corner, last = (np.array([axis[end] for axis in axes]) for end in (0, -1))
        self._learn_bounds(corner, last)
        step = (last - corner) / (np.array(shape) - 1)
        values = np.nan_to_num(rows[:, 3].reshape(shape).astype(float), nan=-1.0)
        self.maker.map(self._time(message), _space(topic), corner, step, values)

    def _learn_bounds(self, lower: FloatArray, upper: FloatArray) -> None:
        if 'bounds' not in self.maker.scene:
            bounds = np.round(np.stack([lower, upper], axis=1), 4)
            self.maker.add_to_scene({'bounds': bounds.tolist()})

    def _take_truth(self, _: str, message: Any) -> None:
        size = len(self.maker.scene.get('bounds') or [0, 0, 0])
        points = [point(item.position) for item in message.poses]
        self.maker.truth(self.maker.latest, np.array(points).reshape(-1, 3)[:, :size])

    def _take_markers(self, topic: str, message: Any) -> None:
        parts: dict[str, list[Any]] = {}
        for item in message.markers:
            part = _PARTS.get((topic.rpartition('/')[2], item.ns.rpartition('/')[2]), '')
            place, size = point(item.pose.position), np.array(point(item.scale))
            if part == 'obstacles':
                parts.setdefault(part, []).append([*place[:2], 0.5 * float(size[0])])
            elif part:
                box = np.stack([place - 0.5 * size, place + 0.5 * size], axis=1)
                parts.setdefault(part, []).append(box.tolist())
        # What a scenario says is better.
        news = {part: items for part, items in parts.items() if part not in self.maker.scene}
        if news:
            self.maker.add_to_scene(news)

    def _take_log(self, _: str, message: Any) -> None:
        level = int(message.level)
        if level >= _WARNING:
            word = 'fault' if level >= _ERROR else 'warning'
            self.maker.message(self.maker.latest, message.name, word, message.msg)

    def _take_diagnostics(self, _: str, message: Any) -> None:
        for status in message.status:
            raw = status.level
            level = raw[0] if isinstance(raw, bytes) else int(raw)
            before = self._levels.get(status.name, _FINE)
            self._levels[status.name] = level
            if level != before and _FINE <= level <= _STALE:
                word = 'fault' if level > 1 else 'warning' if level else 'team'
                text = f'{_DIAGNOSTIC_WORDS[level]}: {status.message}'
                self.maker.message(self.maker.latest, status.name, word, text)
            for item in status.values:
                if item.key == 'search':
                    self.maker.modes(self.maker.latest, status.name, item.value)

    def _take_end(self, _: str, message: Any) -> None:
        reason, _, text = message.data.partition('\n')
        self.maker.end(reason, text)


def _reasons(message: Any) -> dict[str, str]:
    """Return the reasons of a decision by robot, as `decision_to_ros` joins them."""
    names = '|'.join(re.escape(item.robot) for item in message.robots)
    parts = re.split(rf'(?:^|; )({names}): ', message.reason)[1:] if names else []
    return dict(zip(parts[::2], parts[1::2]))


def _space(topic: str) -> str:
    return topic.rpartition('/')[0].strip('/')


def read_events(path: Path, progress: Callable[[float], None] | None = None) -> EventLog:
    """Return the event log of a recording or a run's folder; `progress` takes the share read."""
    with Bag(path) as bag:
        shown = {topic: kind for topic, kind in bag.types.items() if is_shown(topic, kind)}
        if not any(kind.startswith('maasi_msgs/') for kind in shown.values()):
            raise BagError(f'{path}: holds no topic of a search')
        try:
            scene = scene_of_facts(bag.scenario())
        except (BagError, ValueError, KeyError):
            scene = empty_scene(bag.path.name)
        events: list[Event] = []
        maker = EventMaker(scene, events.append)
        takes = MessageEvents(
            maker, waits=STEP in {shown[topic] for topic in shown if bag.counts[topic]}
        )
        # Markers hold what a scenario says better.
        known = 'bounds' in scene
        topics = [topic for topic, kind in shown.items() if not (known and kind == MARKERS)]
        total = sum(bag.counts[topic] for topic in topics)
        for index, item in enumerate(bag.messages(topics)):
            if progress is not None and index % _PROGRESS == 0:
                progress(index / total)
            takes.take(item.topic, item.type, item.message)
        maker.end()
    # Parts that became known later belong to the scene of a replay.
    return EventLog(maker.scene, [event for event in events if event[1] != 'scene'])
