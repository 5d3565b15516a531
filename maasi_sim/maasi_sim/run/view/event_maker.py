"""Makes the events of a run from what its filter, planner and robots say, as their records."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_filter.arrays import FloatArray
from maasi_filter.records import Cluster, FoundTarget
from maasi_planner.team import Decision
from maasi_sim.run.log import Decided, Explored, Fact, Left, Measured, RobotAt, Truth, Updated
from maasi_sim.run.scores import score
from maasi_sim.run.topics import point
from maasi_sim.run.view.event_log import STATE_PERIOD, Event, Listener, Scene, Thinning, shades

_NOT_ALLOWED = -1e29  # objectives below this stand for candidates that are not allowed
# Status of a robot: of AgentState, and what only those who watch know.
MOVING, UNAVAILABLE, LEFT, SILENT, ENDED = 1, 5, 6, 7, 8
_ACTIVITIES = ('searching', 'returning', 'recharging')  # of a `CuboidDecision`
_SILENCE = 3.0  # a robot is silent when others say where they are for so long without it [s]
_MOST_POINTS = 40  # points of a planned way that are shown
_MOST_PLACES = 400  # of a tour


def padded(values: ArrayLike) -> FloatArray:
    """Return a place, or a covariance, of three axes; the third is 0 in a planar search."""
    given = np.asarray(values, dtype=float)
    whole = np.zeros((3,) * given.ndim)
    whole[tuple(map(slice, given.shape))] = given
    return whole


def significant(value: float) -> float:
    """Return a number with five significant digits; one that is not finite becomes 0."""
    return float(f'{value:.5g}') if math.isfinite(value) else 0.0


def _upper(covariance: ArrayLike) -> list[float]:
    return [significant(value) for value in padded(covariance)[np.triu_indices(3)]]


def _words(place: Sequence[float]) -> str:
    return f'({", ".join(f"{value:.3g}" for value in place)})'


class EventMaker:
    """Makes the events of a run with a scene, see `scene_of`, and hands each to a listener."""

    def __init__(self, scene: Scene, listener: Listener) -> None:
        self.scene, self._listener = scene, listener
        bounds = np.asarray(scene.get('bounds') or [[0.0, 1.0]], dtype=float)
        extent = float((bounds[:, 1] - bounds[:, 0]).max())
        # A ten-thousandth of the environment is not seen.
        self._digits = max(0, 4 - math.floor(math.log10(max(extent, 1e-6))))
        self._thinning = Thinning(STATE_PERIOD)
        self._last: dict[tuple[str, str], float] = {}
        self._truth: FloatArray | None = None
        self._found: dict[str, dict[int, FloatArray]] = {}
        self._status: dict[str, int] = {}
        # Last time, place and battery of each robot.
        self._heard: dict[str, tuple[float, list[float], float]] = {}
        self._activity: dict[str, str] = {}
        self._modes: dict[str, str] = {}
        self._planned: dict[str, list[int]] = {}
        self._measured: set[tuple[str, str, int]] = set()
        self.latest = 0.0  #: latest time of an event [s]

    def take(self, fact: Fact) -> None:
        """Add the events of a fact of a search in one process."""
        match fact:
            case RobotAt():
                self.robot(fact.time, fact.robot, fact.pose)
            case Left():
                self.leave(fact.time, fact.robot)
            case Measured(time, item):
                self.seen(time, item.robot, item.pose.position, item.values, item.covariances)
            case Updated():
                if fact.found is not None:
                    self.found(fact.time, fact.team, fact.found)
                self.filter(fact.time, fact.team, fact.expected, fact.clusters, fact.members)
            case Decided():
                planner, decision = self.scene['planner'], fact.decision
                self.plan(fact.time, fact.team, planner, decision, fact.indices, fact.explored)
            case Explored():
                self.map(fact.time, fact.team, fact.lower, fact.step, fact.letters, fact.share)
            case Truth():
                self.truth(fact.time, fact.targets)

    def _put(self, time: float, kind: str, owner: str, *content: Any) -> None:
        key = kind, owner
        # Times of a kind and owner rise, so that the last one before a time can be searched.
        rising = max(round(time, 3), self._last.get(key, -math.inf))
        self._last[key] = rising
        self.latest = max(self.latest, rising)
        event: Event = [rising, kind, owner, *content]
        if kind != 'robot' or self._thinning.keeps(event):
            self._listener(event)

    def _place(self, position: ArrayLike) -> list[float]:
        place = np.asarray(position, dtype=float).tolist()
        return [*(round(value, self._digits) for value in place), 0.0, 0.0][:3]

    def robot(
        self,
        time: float,
        name: str,
        pose: Sequence[float],
        battery: float = -1.0,
        status: int = 1,
        reason: str = '',
    ) -> None:
        """Add the state of a robot; pose is x, y, z [m] and yaw [rad]."""
        place = [*self._place(pose[:3]), round(float(pose[3]), 3)]
        # Its last time: after a jump of the clock the others have their turn first.
        until = self._heard[name][0] if name in self._heard else time
        self._heard[name] = time, place, round(float(battery), 3)
        self._set_status(time, name, int(status), reason)
        for other, (heard, *_) in self._heard.items():
            if until - heard > _SILENCE and self._status[other] < LEFT:
                self._set_status(time, other, SILENT, f'not heard for {_SILENCE:g} s')

    def leave(self, time: float, name: str) -> None:
        """Add that a robot leaves the team."""
        self.message(time, name, 'team', 'left')
        if name in self._heard:
            self._set_status(time, name, LEFT, '')

    def starting(self, ready: int, total: int) -> None:
        """Add how many nodes are ready before the first step."""
        self._put(0.0, 'start', '', ready, total)

    def modes(self, time: float, node: str, words: str) -> None:
        """Add the modes of the robots of a planner node, as it describes them."""
        if self._modes.get(node) != words:
            self._modes[node] = words
            self._put(time, 'mode', node, words)

    def end(self, reason: str = '', text: str = '') -> None:
        """Add that the run has ended, and why: nobody is on the way any more."""
        if reason:
            self._put(self.latest, 'end', '', reason, text)
        for name in self._heard:
            if self._status[name] < UNAVAILABLE:
                self._set_status(self.latest, name, ENDED, '')

    def _set_status(self, time: float, name: str, status: int, reason: str) -> None:
        _, place, battery = self._heard[name]
        self._put(time, 'robot', name, place, battery, status, reason)
        before, self._status[name] = self._status.get(name), status
        words = {UNAVAILABLE: 'cannot go on: ', SILENT: ''}
        if status in words and status != before:
            self.message(time, name, 'fault', words[status] + (reason or 'no reason given'))
        elif before in words and status < UNAVAILABLE:
            self.message(time, name, 'team', 'takes part again')

    def seen(
        self,
        time: float,
        robot: str,
        position: ArrayLike,
        values: Iterable[ArrayLike],
        covariances: Sequence[ArrayLike | None] | FloatArray | None,
    ) -> None:
        """Add a measurement: range, bearing and elevation of detections, some with a covariance."""
        rows = []
        for index, detection in enumerate(values):
            own = None if covariances is None else covariances[index]
            if own is None:
                deviations = self.scene.get('robots', {}).get(robot, {}).get('deviations', [0.0])
            else:
                deviations = np.sqrt(np.maximum(np.diag(np.asarray(own, dtype=float)), 0.0))
            row = (*padded(detection), *padded(deviations))
            rows.append([significant(value) for value in row])
        self._put(time, 'seen', robot, self._place(position), rows)

    def picture(self, time: float, robot: str, content: Sequence[Any]) -> None:
        """Add what a camera saw as its robot measured, see `maasi_sim.run.view.messages`."""
        self._put(time, 'picture', robot, *content)

    def filter(
        self,
        time: float,
        space: str,
        expected: float,
        clusters: Iterable[Cluster],
        members: Iterable[tuple[str, int]],
    ) -> None:
        """Add an update of a filter; members are robots with the index of their measurement."""
        self._measured.update((space, name, index) for name, index in members)
        rows = [
            [*self._place(item.position), significant(item.mass), *_upper(item.covariance)]
            for item in clusters
        ]
        self._put(time, 'filter', space, significant(expected), rows, len(self._measured))

    def found(self, time: float, space: str, targets: Iterable[FoundTarget]) -> None:
        """Add all found targets of a filter."""
        # A filter that knows what others found counts only what it found itself.
        shared = space in self.scene.get('robots', {})
        own = [item for item in targets if not shared or item.robot == space]
        before = self._found.get(space, {})
        rows = []
        for item in own:
            place, when = self._place(item.position), round(max(item.time, 0.0), 3)
            rows.append([item.id, *place, _upper(item.covariance), item.robot, when])
            if item.id not in before:
                self.message(time, item.robot, 'found', f'target {item.id} at {_words(place)} m')
        self._found[space] = {item.id: padded(item.position) for item in own}
        self._put(time, 'found', space, rows)
        self._score(time)

    def plan(
        self,
        time: float,
        space: str,
        planner: str,
        decision: Decision,
        indices: Mapping[str, int],
        explored: float,
    ) -> None:
        """Add a joint decision; `indices` number the decisions of each robot."""
        rows = []
        for name, robot in sorted(decision.robots.items()):
            terms = robot.control_cost, robot.target_refinement, robot.exploration, robot.objective
            columns = [robot.candidates, *terms, robot.lengths, robot.measurements]
            candidates = [
                [
                    *self._place(values[:3]),
                    *map(significant, values[3:6]),
                    self._objective(values[6]),
                    *map(int, values[7:]),
                ]
                for values in np.column_stack(columns).tolist()
            ]
            waypoint = self._place(robot.waypoint)
            row = [name, indices[name], robot.chosen, waypoint, candidates, robot.reason]
            rows.append([*row, list(map(self._place, robot.tour[:_MOST_PLACES]))])
            words = f'to {_words(waypoint)}'
            if robot.stays:
                words = f'stays: {robot.reason or decision.reason or "no candidate"}'
            self.message(time, name, 'decision', f'decision {indices[name]}: {words}')
        if not rows and decision.reason:
            self.message(time, space or planner, 'decision', decision.reason)
        total = self._objective(decision.objective)
        self._put(time, 'plan', space, planner, round(explored, 4), total, decision.reason, rows)
        for name, robot in sorted(decision.robots.items()):
            if len(robot.positions):
                self.way(time, name, robot.positions)

    @staticmethod
    def _objective(value: float) -> float | None:
        allowed = math.isfinite(value) and value > _NOT_ALLOWED
        return significant(value) if allowed else None

    def way(self, time: float, robot: str, positions: Sequence[ArrayLike] | FloatArray) -> None:
        """Add the planned way of a robot: places [m]."""
        count = len(positions)
        chosen = np.linspace(0, count - 1, min(count, _MOST_POINTS)).round().astype(int)
        self._put(time, 'way', robot, [self._place(positions[item]) for item in chosen])

    def map(
        self,
        time: float,
        space: str,
        corner: Sequence[float] | FloatArray,
        spacing: Sequence[float] | FloatArray,
        values: NDArray[Any],
        explored: float | None = None,
    ) -> None:
        """Add e on a grid of two or three axes, below 0 where no target may be, or its `shades`.

        explored: the explored share, where it is known.
        """
        shape = [*values.shape, 1][:3]
        text = values.tobytes().decode() if values.dtype.kind == 'S' else shades(values)
        steps = [significant(value) for value in padded(spacing)]
        if explored is None:
            explored = 1.0 - self._unexplored(corner, spacing, values)
        share = round(explored, 4)
        self._put(time, 'map', space, self._place(corner), steps, shape, text, share)

    def _unexplored(self, corner: Any, spacing: Any, values: FloatArray) -> float:
        """Return the mean of e where targets may be, by the prior; ends of axes count half."""
        weights = (values >= 0.0).astype(float)
        for axis, count in enumerate(values.shape):
            ends = np.isin(np.arange(count), (0, count - 1))
            weights *= np.where(ends, 0.5, 1.0).reshape([-1] + [1] * (values.ndim - 1 - axis))
        if 'prior' in self.scene:
            low, step, shape, likely = self.scene['prior']
            rows, columns = (
                np.clip(
                    np.rint(
                        (corner[axis] + spacing[axis] * np.arange(count) - low[axis]) / step[axis]
                    ),
                    0,
                    shape[axis] - 1,
                ).astype(int)
                for axis, count in enumerate(values.shape[:2])
            )
            weighted = np.reshape(likely, shape)[np.ix_(rows, columns)]
            weights *= weighted.reshape(*weighted.shape, *[1] * (values.ndim - 2))
        return float((weights * np.maximum(values, 0.0)).sum() / max(weights.sum(), 1e-12))

    def zones(self, time: float, zones: list[dict[str, Any]]) -> None:
        """Add the zones of the area that hold from now on, see `scene.zones_of`."""
        self._put(time, 'zones', '', zones)

    def truth(self, time: float, targets: ArrayLike) -> None:
        """Add the true targets, (n, 2 or 3) [m]."""
        now = np.asarray(targets, dtype=float)
        if self._truth is not None and np.array_equal(self._truth, now):
            return
        self._truth = now
        self._put(time, 'truth', '', [self._place(item) for item in now])
        self._score(time)

    def cuboid(self, time: float, message: Any) -> None:
        """Add a `CuboidDecision` of a search of buildings."""
        robot = message.robot
        activity = _ACTIVITIES[min(int(message.activity), len(_ACTIVITIES) - 1)]
        shots = []
        for shot in message.snapshots:
            chance = round(float(shot.detection_probability), 3)
            shots.append([int(shot.cuboid), *self._place(point(shot.position)), chance])
            self.message(time, robot, 'found', f'snapshot of cuboid {shot.cuboid}')
        before, self._activity[robot] = self._activity.get(robot, activity), activity
        if before != activity:
            self.message(time, robot, 'team', activity)
        planned = [int(item) for item in message.planned]
        if self._planned.get(robot, []) != planned:
            self._planned[robot] = planned
            words = ', '.join(map(str, planned)) or 'none'
            self.message(time, robot, 'decision', f'cuboids that it plans to visit: {words}')
        lists = list(message.heard), planned, shots
        target = self._place(point(message.target))
        self._put(time, 'cuboid', robot, activity, message.how, target, *lists, bool(message.done))

    def add_to_scene(self, part: Scene) -> None:
        """Add to the scene what became known later."""
        self.scene.update(part)
        self._listener([round(self.latest, 3), 'scene', '', part])

    def message(self, time: float, source: str, level: str, text: str) -> None:
        """Add a line of the log."""
        self._put(time, 'log', '', level, source, ' '.join(text.split())[:400])

    def _score(self, time: float) -> None:
        radius = self.scene.get('scoring_radius')
        if self._truth is None or radius is None:
            return
        size = len(self.scene['bounds'])
        positions = [item for found in self._found.values() for item in found.values()]
        found = np.array(positions).reshape(-1, 3)[:, :size]
        scores = score(found, self._truth[:, :size], radius, self.scene.get('scoring_order', 2.0))
        match = scores.match
        rmse = significant(match.rmse) if math.isfinite(match.rmse) else None
        numbers = match.true_found, match.missed, match.false_found
        self._put(time, 'score', '', *map(int, numbers), rmse, significant(scores.gospa.total))
