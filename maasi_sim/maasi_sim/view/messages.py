"""Makes events from the messages of a run: of a recording, of a run, or of any ROS graph.

Topics are known by their types, and by the last part of their names where a type says too little,
so that recordings of `ros2 bag record -a` and teams in a namespace are read as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maasi_sim.run.topics import seconds
from maasi_sim.view.event_maker import EventMaker, RobotChoice

FloatArray = NDArray[np.float64]

_ACTIVITIES = ('searching', 'returning', 'recharging')
# Levels of rcl_interfaces/msg/Log and of diagnostic_msgs/msg/DiagnosticStatus.
_WARNING, _ERROR = 30, 40
_FINE, _STALE = 0, 3
_DIAGNOSTIC_WORDS = {0: 'well again', 1: 'warning', 2: 'error', 3: 'stale'}
# A stamp that is earlier than the topic's last one by more than this begins another run [s].
_REWIND = 10.0
# From type to the last parts that the name may have; empty: any.
TOPICS: dict[str, tuple[str, ...]] = {
    'maasi_msgs/msg/LockstepStep': (),
    'maasi_msgs/msg/AgentState': (),
    'maasi_msgs/msg/DetectionArray': (),
    'maasi_msgs/msg/FilterUpdate': (),
    'maasi_msgs/msg/FoundTargetArray': ('found_targets',),
    'maasi_msgs/msg/PlanDecision': (),
    'maasi_msgs/msg/CuboidDecision': (),
    'nav_msgs/msg/Path': ('plan',),
    'nav_msgs/msg/OccupancyGrid': ('exploration',),
    'sensor_msgs/msg/PointCloud2': ('exploration',),
    'geometry_msgs/msg/PoseArray': ('ground_truth/targets',),
    'visualization_msgs/msg/MarkerArray': ('ground_truth/markers', 'search_area', 'markers'),
    'rcl_interfaces/msg/Log': ('rosout',),
    'diagnostic_msgs/msg/DiagnosticArray': ('diagnostics',),
}


def is_shown(topic: str, type_name: str) -> bool:
    """Return whether messages of a topic are shown."""
    if type_name not in TOPICS or '/_' in topic:
        return False
    names = TOPICS[type_name]
    return not names or any(topic.endswith(f'/{name}') for name in names)


class MessageEvents:
    """Take messages, of `rosbags` or of ROS, and hand their events to a maker.

    Parameters
    ----------
    maker : EventMaker
        Makes the events.
    begin : float, optional
        Time of the first step [s]; that of the first state if not given.
    on_restart : callable, optional
        Called when the time jumps back, as a bag that is played again does; nothing is then kept.
    """

    def __init__(
        self,
        maker: EventMaker,
        begin: float | None = None,
        on_restart: Callable[[], EventMaker] | None = None,
    ) -> None:
        self.maker = maker
        self._begin = begin
        self._on_restart = on_restart
        self._team: set[str] | None = None
        # Time of the last message of each topic with the time of the run [s].
        self._last: dict[str, float] = {}
        self._levels: dict[str, int] = {}
        self._takers: dict[str, Callable[[str, Any], None]] = {
            'LockstepStep': self._take_step,
            'AgentState': self._take_state,
            'DetectionArray': self._take_detections,
            'FilterUpdate': self._take_update,
            'FoundTargetArray': self._take_found,
            'PlanDecision': self._take_plan,
            'CuboidDecision': self._take_cuboid,
            'Path': self._take_path,
            'OccupancyGrid': self._take_grid,
            'PointCloud2': self._take_cloud,
            'PoseArray': self._take_truth,
            'MarkerArray': self._take_markers,
            'Log': self._take_log,
            'DiagnosticArray': self._take_diagnostics,
        }

    def take(self, topic: str, type_name: str, message: Any) -> None:
        """Take a message of a topic for which `is_shown` is true."""
        self._takers[type_name.rpartition('/')[2]](topic, message)

    def _now(self, topic: str, message: Any) -> float:
        """Return the time of a message with the time of the run; begin again if it jumps back.

        Of each topic by itself, as messages of a bag that is played fast overtake each other.
        """
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
        """Return the time of any other message: a latched one may be old [s]."""
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
        place = (*_point(pose.position), yaw)
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

    def _take_detections(self, _: str, message: Any) -> None:
        detections = []
        for item in message.detections:
            own = np.asarray(item.covariance, dtype=float)
            size = round(len(own) ** 0.5)
            covariance = own.reshape(size, size) if size in (2, 3) and size**2 == len(own) else None
            detections.append(((item.range, item.bearing, item.elevation), covariance))
        self.maker.seen(
            self._time(message),
            message.robot,
            _point(message.pose.pose.position),
            detections,
        )

    def _take_update(self, topic: str, message: Any) -> None:
        self.maker.filter(
            self._time(message),
            _space(topic),
            message.expected_number,
            [
                (_point(item.position), item.mass, _matrix(item.covariance))
                for item in message.clusters
            ],
            [(item.robot, int(item.measurement)) for item in message.members],
        )

    def _take_found(self, topic: str, message: Any) -> None:
        time = self._time(message)
        self.maker.found(
            time,
            _space(topic),
            [
                (
                    int(item.id),
                    _point(item.position),
                    _matrix(item.covariance),
                    item.robot,
                    max(seconds(item.stamp) - (self._begin or 0.0), 0.0),
                )
                for item in message.targets
            ],
        )

    def _take_plan(self, topic: str, message: Any) -> None:
        choices = [
            RobotChoice(
                robot.robot,
                int(robot.decision),
                int(robot.chosen),
                _point(robot.waypoint),
                [
                    (
                        *_point(item.position),
                        item.control_cost,
                        item.target_refinement,
                        item.exploration,
                        item.objective,
                        item.length,
                        item.measurements,
                    )
                    for item in robot.candidates
                ],
            )
            for robot in message.robots
        ]
        self.maker.plan(
            self._time(message),
            _space(topic),
            choices,
            message.planner,
            message.explored,
            message.objective,
            message.reason,
        )

    def _take_cuboid(self, _: str, message: Any) -> None:
        activity = min(int(message.activity), len(_ACTIVITIES) - 1)
        self.maker.cuboid(
            self._time(message),
            message.robot,
            (_ACTIVITIES[activity], message.how, _point(message.target)),
            list(message.heard),
            [int(item) for item in message.planned],
            [
                (int(shot.cuboid), _point(shot.position), shot.detection_probability)
                for shot in message.snapshots
            ],
            bool(message.done),
        )

    def _take_path(self, topic: str, message: Any) -> None:
        points = [_point(item.pose.position) for item in message.poses]
        self.maker.way(self._time(message), _owner(topic), np.array(points))

    def _take_grid(self, topic: str, message: Any) -> None:
        info = message.info
        values = np.asarray(message.data, dtype=float).reshape(info.height, info.width).T / 100.0
        step = float(info.resolution)
        corner = np.add(_point(info.origin.position), (0.5 * step, 0.5 * step, 0.0))
        self._learn_bounds(corner[:2], corner[:2] + step * (np.array(values.shape) - 1))
        self.maker.map(self._time(message), _space(topic), corner, [step, step], values)

    def _take_cloud(self, topic: str, message: Any) -> None:
        rows = np.frombuffer(bytes(message.data), dtype='<f4').reshape(-1, message.point_step // 4)
        axes = [np.unique(rows[:, axis]) for axis in range(3)]
        shape = [len(axis) for axis in axes]
        if np.prod(shape) != len(rows) or min(shape) < 2:
            return
        corner = np.array([axis[0] for axis in axes], dtype=float)
        last = np.array([axis[-1] for axis in axes], dtype=float)
        self._learn_bounds(corner, last)
        self.maker.map(
            self._time(message),
            _space(topic),
            corner,
            (last - corner) / (np.array(shape) - 1),
            rows[:, 3].reshape(shape).astype(float),
        )

    def _learn_bounds(self, lower: FloatArray, upper: FloatArray) -> None:
        if 'bounds' not in self.maker.scene:
            bounds = np.round(np.stack([lower, upper], axis=1), 4)
            self.maker.add_to_scene({'bounds': bounds.tolist()})

    def _take_truth(self, _: str, message: Any) -> None:
        size = len(self.maker.scene.get('bounds') or [0, 0, 0])
        points = [_point(item.position) for item in message.poses]
        self.maker.truth(self.maker.latest, np.array(points).reshape(-1, 3)[:, :size])

    def _take_markers(self, topic: str, message: Any) -> None:
        """Take obstacles and buildings of a run without scenario."""
        scene = self.maker.scene
        # Of a scenario both are known, and its obstacles, empty or not.
        if 'obstacles' in scene and topic.endswith('ground_truth/markers'):
            return
        obstacles, boxes = [], {'objects': [], 'obstacles': []}  # type: ignore[var-annotated]
        cuboids = []
        for item in message.markers:
            place, size = np.array(_point(item.pose.position)), item.scale
            box = np.stack([place, place], axis=1) + np.outer([size.x, size.y, size.z], [-0.5, 0.5])
            if topic.endswith('ground_truth/markers') and item.ns == 'obstacles':
                obstacles.append([*place[:2].tolist(), 0.5 * float(size.x)])
            elif topic.endswith('search_area') and item.ns in boxes:
                boxes[item.ns].append(box.tolist())
            elif item.ns.endswith('/cuboids'):
                cuboids.append(box.tolist())
        if obstacles:
            self.maker.add_to_scene({'obstacles': obstacles})
        if boxes['objects'] and 'objects' not in scene:
            self.maker.add_to_scene({'objects': boxes['objects'], 'blocks': boxes['obstacles']})
        if cuboids and 'cuboids' not in scene:
            self.maker.add_to_scene({'cuboids': cuboids})

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


def _point(point: Any) -> tuple[float, float, float]:
    return float(point.x), float(point.y), float(point.z)


def _matrix(values: Any) -> FloatArray:
    return np.asarray(values, dtype=float).reshape(3, 3)


def _space(topic: str) -> str:
    """Return the namespace of a topic, without slashes at its ends."""
    return topic.rpartition('/')[0].strip('/')


def _owner(topic: str) -> str:
    """Return the last part of a topic's namespace: its robot."""
    return _space(topic).rpartition('/')[2]
