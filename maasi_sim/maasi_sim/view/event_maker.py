"""Makes the events of a run from what its filter, planner and robots say, as plain values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maasi_filter.arrays import FloatArray
from maasi_sim.targets.scoring import score
from maasi_sim.view.event_log import STATE_PERIOD, Event, Listener, Scene, Thinning

# Objectives below this stand for candidates that are not allowed.
_NOT_ALLOWED = -1e29
# Status of a robot: of AgentState, and what only those who watch know.
MOVING, UNAVAILABLE, LEFT, SILENT, ENDED = 1, 5, 6, 7, 8
# A robot is silent when others say where they are for so long without it [s].
_SILENCE = 3.0
_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])


@dataclass(frozen=True)
class RobotChoice:
    """The decision of one robot.

    `decision` is its index d, `chosen` that of a candidate (negative: none). Candidates are x, y, z
    [m], C, T, E, J, K, M; the reason is empty where it is the objective.
    """

    robot: str
    decision: int
    chosen: int
    waypoint: ArrayLike
    candidates: Iterable[Sequence[float]]
    reason: str = ''


def padded(position: ArrayLike) -> FloatArray:
    """Return a position with three coordinates, the third 0 in a planar search."""
    place = np.zeros(3)
    given = np.asarray(position, dtype=float).reshape(-1)
    place[: len(given)] = given
    return place


def upper(covariance: ArrayLike) -> list[float]:
    """Return the upper triangle of a covariance with three axes: xx, xy, xz, yy, yz, zz."""
    given = np.asarray(covariance, dtype=float)
    whole = np.zeros((3, 3))
    whole[: len(given), : len(given)] = given
    return [significant(value) for value in whole[_UPPER]]


def significant(value: float) -> float:
    """Return a number with five significant digits; one that is not finite becomes 0."""
    return float(f'{value:.5g}') if math.isfinite(value) else 0.0


def _explored(values: FloatArray) -> float:
    """Return 1 - mean of e; nodes at the ends of an axis stand for half a step."""
    for count in values.shape:
        weights = np.ones(count)
        weights[[0, -1]] = 0.5
        values = np.average(values, axis=0, weights=weights)
    return 1.0 - float(values)


class EventMaker:
    """Makes the events of a run with a scene, see `scene_of`, and hands each to a listener."""

    def __init__(self, scene: Scene, listener: Listener) -> None:
        self.scene = scene
        self._listener = listener
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
        self._measured: set[tuple[str, str, int]] = set()
        #: Latest time of an event [s].
        self.latest = 0.0

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
        place = [round(float(value), self._digits) for value in np.ravel(position)]
        return [*place, 0.0, 0.0][:3]

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

    def end(self) -> None:
        """Add that the run has ended: nobody is on the way any more."""
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
        detections: Iterable[tuple[Sequence[float], ArrayLike | None]],
    ) -> None:
        """Add a measurement: detections (range, bearing, elevation) with covariance or None."""
        preset = self.scene.get('robots', {}).get(robot, {}).get('deviations') or [0.0, 0.0, 0.0]
        rows = []
        for values, covariance in detections:
            deviations = list(preset)
            if covariance is not None:
                own = np.sqrt(np.maximum(np.diag(np.asarray(covariance, dtype=float)), 0.0))
                deviations = [*own.tolist(), 0.0][:3]
            rows.append([significant(value) for value in (*padded(values), *deviations)])
        self._put(time, 'seen', robot, self._place(position), rows)

    def filter(
        self,
        time: float,
        space: str,
        expected: float,
        clusters: Iterable[tuple[ArrayLike, float, ArrayLike]],
        members: Iterable[tuple[str, int]],
    ) -> None:
        """Add an update: clusters (position, mass, covariance), members (robot, measurement)."""
        self._measured.update((space, name, index) for name, index in members)
        rows = [
            [*self._place(position), significant(mass), *upper(covariance)]
            for position, mass, covariance in clusters
        ]
        self._put(time, 'filter', space, significant(expected), rows, len(self._measured))

    def found(
        self,
        time: float,
        space: str,
        targets: Iterable[tuple[int, ArrayLike, ArrayLike, str, float]],
    ) -> None:
        """Add all found targets of a filter: id, position, covariance, robot, time [s]."""
        shared = space in self.scene.get('robots', {})
        before = self._found.get(space, {})
        now: dict[int, FloatArray] = {}
        rows = []
        # A filter that knows what others found counts only what it found itself.
        for number, position, covariance, robot, when in targets:
            if shared and robot != space:
                continue
            now[number] = padded(position)
            rows.append([number, *self._place(position), upper(covariance), robot, round(when, 3)])
            if number not in before:
                where = ', '.join(f'{value:g}' for value in rows[-1][1:4])
                self.message(time, robot, 'found', f'target {number} at ({where}) m')
        self._found[space] = now
        self._put(time, 'found', space, rows)
        self._score(time)

    def plan(
        self,
        time: float,
        space: str,
        choices: Iterable[RobotChoice],
        planner: str,
        explored: float,
        objective: float,
        reason: str,
    ) -> None:
        """Add a joint decision."""
        rows = []
        for choice in choices:
            candidates = []
            for values in choice.candidates:
                x, y, z, *terms, length, measurements = (float(value) for value in values)
                allowed = math.isfinite(terms[3]) and terms[3] > _NOT_ALLOWED
                *numbers, objective_of = map(significant, terms)
                candidates.append(
                    [
                        *self._place([x, y, z]),
                        *numbers,
                        objective_of if allowed else None,
                        int(length),
                        int(measurements),
                    ]
                )
            waypoint = self._place(choice.waypoint)
            numbers = [int(choice.decision), int(choice.chosen)]
            rows.append([choice.robot, *numbers, waypoint, candidates, choice.reason])
            where = ', '.join(f'{value:g}' for value in waypoint)
            words = f'stays: {choice.reason or reason or "no candidate"}'
            if choice.chosen >= 0:
                words = f'to ({where})'
            self.message(time, choice.robot, 'decision', f'decision {choice.decision}: {words}')
        if not rows and reason:
            self.message(time, space or planner, 'decision', reason)
        total = significant(objective) if objective > _NOT_ALLOWED else None
        self._put(time, 'plan', space, planner, round(explored, 4), total, reason, rows)

    def way(self, time: float, robot: str, positions: ArrayLike, most: int = 40) -> None:
        """Add the planned way of a robot, (n, 3) [m]."""
        points = np.asarray(positions, dtype=float).reshape(-1, 3)
        count = len(points)
        chosen = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
        self._put(time, 'way', robot, [self._place(points[item]) for item in chosen])

    def map(
        self,
        time: float,
        space: str,
        corner: ArrayLike,
        spacing: ArrayLike,
        values: NDArray[Any],
        explored: float | None = None,
    ) -> None:
        """Add e on a grid (nx, ny) or (nx, ny, nz), 1 is unseen, or its ninths as bytes.

        The explored share follows from e where it is not given.
        """
        shape = [*values.shape, 1][:3]
        ninths = values if values.dtype == np.uint8 else np.clip(np.rint(9.0 * values), 0, 9)
        text = (ninths.astype(np.uint8) + ord('0')).tobytes().decode('ascii')
        steps = [significant(value) for value in padded(spacing)]
        share = round(_explored(values) if explored is None else explored, 4)
        self._put(time, 'map', space, self._place(corner), steps, shape, text, share)

    def truth(self, time: float, targets: ArrayLike) -> None:
        """Add the true targets, (n, 2 or 3) [m]."""
        rows = [padded(item) for item in np.asarray(targets, dtype=float)]
        now = np.array(rows).reshape(-1, 3)
        if self._truth is not None and np.array_equal(self._truth, now):
            return
        self._truth = now
        self._put(time, 'truth', '', [self._place(item) for item in rows])
        self._score(time)

    def cuboid(
        self,
        time: float,
        robot: str,
        choice: tuple[str, str, ArrayLike],
        heard: Sequence[str],
        planned: Sequence[int],
        snapshots: Iterable[tuple[int, ArrayLike, float]],
        done: bool,
    ) -> None:
        """Add a decision in a search of buildings; choice is activity, how, target."""
        activity, how, target = choice
        shots = [
            [int(number), *self._place(position), round(float(chance), 3)]
            for number, position, chance in snapshots
        ]
        before, self._activity[robot] = self._activity.get(robot), activity
        if before not in (None, activity):
            self.message(time, robot, 'team', activity)
        for shot in shots:
            self.message(time, robot, 'found', f'snapshot of cuboid {shot[0]}')
        lists = list(heard), [int(item) for item in planned], shots
        self._put(time, 'cuboid', robot, activity, how, self._place(target), *lists, bool(done))

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
        rmse = float(match.rmse)
        error = significant(rmse) if math.isfinite(rmse) else None
        numbers = [match.true_found, match.missed, len(found) - match.true_found]
        total = significant(float(scores.gospa.total))
        self._put(time, 'score', '', *map(int, numbers), error, total)
