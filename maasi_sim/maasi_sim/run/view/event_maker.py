"""Makes the events of a page from facts."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maasi_filter.arrays import FloatArray
from maasi_filter.records import FoundTarget
from maasi_filter.reports import SEARCHED
from maasi_filter.wording import point
from maasi_sim.run import facts
from maasi_sim.run.scores import Scoreboard
from maasi_sim.run.view.event_log import STATE_PERIOD, Event, Listener, Scene, Thinning, shades
from maasi_sim.run.view.pictures import cut_out, picture
from maasi_sim.run.view.scene import zones_as

_NOT_ALLOWED = -1e29  # candidates with an objective below this are not allowed
# Status of a robot: constants of AgentState, and further ones of observers.
MOVING, UNAVAILABLE, LEFT, SILENT, ENDED = 1, 5, 6, 7, 8
_SILENCE = 3.0  # a robot is silent after this long without a state, if others send theirs [s]
_MOST_POINTS = 40  # shown points of a planned path
_PHOTOGRAPHS = 4  # kept images of a robot
_MOST_UNSEEN = 100  # found targets that wait for a picture
_MOST_WAYPOINTS = 400  # shown points of a tour


def padded(values: ArrayLike) -> FloatArray:
    """Return a position or covariance with three axes; the third is 0 in 2D."""
    given = np.asarray(values, dtype=float)
    whole = np.zeros((3,) * given.ndim)
    whole[tuple(map(slice, given.shape))] = given
    return whole


def significant(value: float) -> float:
    """Return a number with five significant digits, or 0 if it is not finite."""
    return float(f'{value:.5g}') if math.isfinite(value) else 0.0


def _upper(covariance: ArrayLike) -> list[float]:
    return [significant(value) for value in padded(covariance)[np.triu_indices(3)]]


class EventMaker:
    """Makes the events of a run with a scene (`scene_of`) and passes each to a listener."""

    def __init__(self, scene: Scene, listener: Listener) -> None:
        self.scene, self._listener = scene, listener
        bounds = np.asarray(scene.get('bounds') or [[0.0, 1.0]], dtype=float)
        extent = float((bounds[:, 1] - bounds[:, 0]).max())
        # Changes below a ten-thousandth of the environment are invisible.
        self._digits = max(0, 4 - math.floor(math.log10(max(extent, 1e-6))))
        self._thinning = Thinning(STATE_PERIOD)
        self._last: dict[tuple[str, str], float] = {}
        order = scene.get('scoring_order', 2.0)
        self._board = Scoreboard(scene.get('scoring_radius'), order, None)
        self._team: set[str] | None = None
        self._status: dict[str, int] = {}
        # Last time, position and battery of each robot.
        self._states: dict[str, tuple[float, list[float], float]] = {}
        self._modes: dict[str, str] = {}
        # The last images of measurements, by robot.
        self._photographs: dict[str, deque[facts.Photographed]] = {}
        # Positions of found targets without a picture, by filter and id.
        self._unseen: dict[tuple[str, int], Sequence[float]] = {}
        self._measured: set[tuple[str, str, int]] = set()
        self.latest = 0.0  #: latest time of an event [s]

    def add(self, fact: facts.Fact) -> None:
        """Add the events of a fact."""
        time = fact.time
        match fact:
            case facts.RobotAt():
                self._add_state(fact)
            case facts.Present():
                self._team = set(fact.robots)
            case facts.Joined():
                self._team = {*(self._team or ()), fact.robot}
                self._say(time, fact.robot, 'team', 'joined')
            case facts.Left():
                self._add_left(fact)
            case facts.Measured():
                self._add_measurement(fact)
            case facts.Photographed():
                self._add_picture(fact)
            case facts.Found():
                self._add_found(time, fact.team, fact.targets)
            case facts.Updated():
                if fact.found is not None:
                    self._add_found(time, fact.team, fact.found)
                self._add_update(fact)
            case facts.Decided():
                self._add_decision(fact)
            case facts.PathPlanned():
                self._add_path(time, fact.robot, fact.positions)
            case facts.Explored():
                self._add_map(fact)
            case facts.KeepOutsChanged():
                zones = [zone for zone in self.scene.get('zones', []) if zone['kind'] != 'keep_out']
                self._put(time, 'zones', '', [*zones, *zones_as('keep_out', fact.shapes)])
            case facts.Reported():
                self._add_report(fact)
            case facts.Truth():
                self._add_truth(time, np.asarray(fact.targets, dtype=float))
            case facts.SceneFound():
                # The scenario's values are better.
                self._add_to_scene({k: v for k, v in fact.parts.items() if k not in self.scene})
            case facts.Said():
                self._say(time, fact.source, fact.level, fact.text)
            case facts.Modes() if self._modes.get(fact.node) != fact.text:
                self._modes[fact.node] = fact.text
                self._put(time, 'mode', fact.node, fact.text)
            case facts.Shown():
                self._put(time, fact.kind, fact.owner, *map(self._plain, fact.content))
            case facts.Ended():
                self.end(fact.reason, fact.text)

    def _put(self, time: float, kind: str, owner: str, *content: Any) -> None:
        key = kind, owner
        # Times of a kind and owner increase, for binary search.
        rising = max(round(time, 3), self._last.get(key, 0.0))
        self._last[key] = rising
        self.latest = max(self.latest, rising)
        event: Event = [rising, kind, owner, *content]
        if kind != 'robot' or self._thinning.keeps(event):
            self._listener(event)

    def _rounded(self, position: ArrayLike) -> list[float]:
        values = np.asarray(position, dtype=float).tolist()
        return [*(round(value, self._digits) for value in values), 0.0, 0.0][:3]

    def _plain(self, content: Any) -> Any:
        if isinstance(content, np.ndarray):
            return self._rounded(content)
        if isinstance(content, (list, tuple)):
            return [self._plain(item) for item in content]
        return content

    def starting(self, ready: int, total: int) -> None:
        """Add the number of ready nodes before the first step."""
        self._put(0.0, 'start', '', ready, total)

    def end(self, reason: str = '', text: str = '') -> None:
        """Add the end of the run and its reason."""
        if reason:
            self._put(self.latest, 'end', '', reason, text)
        for name in self._states:
            if self._status[name] < UNAVAILABLE:
                self._set_status(self.latest, name, ENDED, '')

    def _add_state(self, fact: facts.RobotAt) -> None:
        # The driver of a robot that left may publish for a while.
        away = self._team is not None and fact.robot not in self._team
        if away or not all(map(math.isfinite, fact.pose)):
            return
        time, name = max(fact.time, 0.0), fact.robot
        position = [*self._rounded(fact.pose[:3]), round(float(fact.pose[3]), 3)]
        # After a jump of the clock, other robots may not have sent yet.
        until = self._states[name][0] if name in self._states else time
        self._states[name] = time, position, round(float(fact.battery), 3)
        self._set_status(time, name, fact.status, fact.reason)
        for other, (last, *_) in self._states.items():
            if until - last > _SILENCE and self._status[other] < LEFT:
                self._set_status(time, other, SILENT, f'no state for {_SILENCE:g} s')

    def _add_left(self, fact: facts.Left) -> None:
        if self._team is not None:
            self._team.discard(fact.robot)
        self._say(fact.time, fact.robot, 'team', 'left')
        if fact.robot in self._states:
            self._set_status(fact.time, fact.robot, LEFT, '')

    def _set_status(self, time: float, name: str, status: int, reason: str) -> None:
        _, position, battery = self._states[name]
        self._put(time, 'robot', name, position, battery, status, reason)
        before, self._status[name] = self._status.get(name), status
        words = {UNAVAILABLE: 'unavailable: ', SILENT: ''}
        if status in words and status != before:
            self._say(time, name, 'fault', words[status] + (reason or 'unknown reason'))
        elif before in words and status < UNAVAILABLE:
            self._say(time, name, 'team', 'available again')

    def _add_measurement(self, fact: facts.Measured) -> None:
        rows = []
        for index, detection in enumerate(fact.values):
            own = None if fact.covariances is None else fact.covariances[index]
            if own is None:
                deviations = self._robot(fact.robot).get('deviations', [0.0])
            else:
                deviations = np.sqrt(np.maximum(np.diag(np.asarray(own, dtype=float)), 0.0))
            row = (*padded(detection), *padded(deviations))
            rows.append([significant(value) for value in row])
        self._put(fact.time, 'seen', fact.robot, self._rounded(fact.position), rows)

    def _add_picture(self, fact: facts.Photographed) -> None:
        item = fact.measured
        assert item.pose is not None
        try:
            content = picture(fact.image, self._robot(item.robot), item.pose, item.values)
        except ValueError:
            # Images that cannot be decoded are not shown.
            return
        kept = self._photographs.setdefault(item.robot, deque(maxlen=_PHOTOGRAPHS))
        kept.append(fact)
        for team, number in list(self._unseen):
            if self._add_cut_out(fact, team, number, self._unseen[team, number]):
                del self._unseen[team, number]
        self._put(fact.time, 'picture', item.robot, *content)

    def _robot(self, name: str) -> dict[str, Any]:
        facts: dict[str, Any] = self.scene.get('robots', {}).get(name, {})
        return facts

    def _add_update(self, fact: facts.Updated) -> None:
        team = fact.team
        self._measured.update((team, name, index) for name, index in fact.members)
        rows = [
            [*self._rounded(item.position), significant(item.mass), *_upper(item.covariance)]
            for item in fact.clusters
        ]
        content = significant(fact.expected), rows, len(self._measured)
        self._put(fact.time, 'filter', team, *content)

    def _add_found(self, time: float, team: str, targets: Sequence[FoundTarget]) -> None:
        before = {item.id for item in self._board.found.get(team, ())}
        rows = []
        for item in targets:
            position, when = self._rounded(item.position), round(max(item.time, 0.0), 3)
            rows.append([item.id, *position, _upper(item.covariance), item.robot, when])
            if item.id not in before:
                self._say(time, item.robot, 'found', f'target {item.id} at {point(position)} m')
                self._find_picture(team, item, position)
        self._board.found[team] = targets
        self._put(time, 'found', team, rows)
        self._score(time)

    def _find_picture(self, team: str, target: FoundTarget, position: Sequence[float]) -> None:
        """Add the part of an image that shows a target, of its finder or else of a later image."""
        kept = self._photographs.get(target.robot, ())
        # First the measurement of the find, then the newest.
        own = [item for item in kept if item.measured.index == target.measurement]
        for fact in (*own, *reversed(kept)):
            if self._add_cut_out(fact, team, target.id, position):
                return
        if len(self._unseen) < _MOST_UNSEEN:
            self._unseen[team, target.id] = position

    def _add_cut_out(
        self, fact: facts.Photographed, team: str, number: int, position: Sequence[float]
    ) -> bool:
        item = fact.measured
        assert item.pose is not None
        try:
            data = cut_out(fact.image, self._robot(item.robot), item.pose, position)
        except ValueError:
            return False
        if data is not None:
            self._put(max(self.latest, fact.time), 'crop', team, number, data)
        return data is not None

    def _add_report(self, fact: facts.Reported) -> None:
        report = fact.report
        if report is None:
            self._put(fact.time, 'report', fact.team, 'cleared')
            return
        zones = zones_as('searched', [report.shape]) if report.kind == SEARCHED else []
        numbers = significant(report.radius), significant(report.weight)
        content = report.target, self._rounded(report.position), *numbers, zones
        self._put(fact.time, 'report', fact.team, report.kind, *content)
        self._say(fact.time, report.source or 'a person', 'team', str(report))

    def _add_decision(self, fact: facts.Decided) -> None:
        time, decision = fact.time, fact.decision
        planner = fact.planner or self.scene.get('planner', '')
        rows = []
        for name, robot in sorted(decision.robots.items()):
            terms = robot.control_cost, robot.target_refinement, robot.exploration, robot.objective
            columns = [robot.candidates, *terms, robot.lengths, robot.measurements]
            candidates = [
                [
                    *self._rounded(values[:3]),
                    *map(significant, values[3:6]),
                    self._objective(values[6]),
                    *map(int, values[7:]),
                ]
                for values in np.column_stack(columns).tolist()
            ]
            waypoint, number = self._rounded(robot.waypoint), fact.indices[name]
            row = [name, number, robot.chosen, waypoint, candidates, robot.reason]
            rows.append([*row, list(map(self._rounded, robot.tour[:_MOST_WAYPOINTS]))])
            words = f'to {point(waypoint)}'
            if robot.stays:
                words = f'stays: {robot.reason or decision.reason or "no candidate"}'
            self._say(time, name, 'decision', f'decision {number}: {words}')
        if not rows and decision.reason:
            self._say(time, fact.team or planner, 'decision', decision.reason)
        total, share = self._objective(decision.objective), round(fact.explored, 4)
        self._put(time, 'plan', fact.team, planner, share, total, decision.reason, rows)
        for name, robot in sorted(decision.robots.items()):
            if len(robot.positions):
                self._add_path(time, name, robot.positions)

    @staticmethod
    def _objective(value: float) -> float | None:
        allowed = math.isfinite(value) and value > _NOT_ALLOWED
        return significant(value) if allowed else None

    def _add_path(self, time: float, robot: str, positions: Sequence[Any] | FloatArray) -> None:
        count = len(positions)
        chosen = np.linspace(0, count - 1, min(count, _MOST_POINTS)).round().astype(int)
        self._put(time, 'way', robot, [self._rounded(positions[item]) for item in chosen])

    def _add_map(self, fact: facts.Explored) -> None:
        lower, step, values = fact.lower, fact.step, fact.values
        shape = np.array(values.shape)
        if 'bounds' not in self.scene:
            bounds = np.round(np.stack([lower, lower + step * (shape - 1)], axis=1), 4)
            self._add_to_scene({'bounds': bounds.tolist()})
        if fact.rounded:
            # Nodes of the map lie on all bounds.
            low, high = np.array(self.scene['bounds'])[:2].T
            exact = (high - low) / np.maximum(shape - 1, 1)
            if np.allclose(exact, step, rtol=0.05):
                lower, step = low, exact
        share = None if fact.share is None else round(fact.share, 4)
        text = values.tobytes().decode() if values.dtype.kind == 'S' else shades(values)
        steps = [significant(value) for value in padded(step)]
        content = self._rounded(lower), steps, [*values.shape, 1][:3], text, share
        self._put(fact.time, 'map', fact.team, *content)

    def _add_truth(self, time: float, truth: FloatArray) -> None:
        before, self._board.truth = self._board.truth, truth
        if before is None or not np.array_equal(before, truth):
            self._put(time, 'truth', '', [self._rounded(item) for item in truth])
            self._score(time)

    def _add_to_scene(self, parts: Scene) -> None:
        if parts:
            self.scene.update(parts)
            self._listener([round(self.latest, 3), 'scene', '', parts])

    def _say(self, time: float, source: str, level: str, text: str) -> None:
        self._put(time, 'log', '', level, source, ' '.join(text.split())[:400])

    def _score(self, time: float) -> None:
        scores = self._board.scores()
        if scores is not None:
            match = scores.match
            rmse = significant(match.rmse) if math.isfinite(match.rmse) else None
            numbers = match.true_found, match.missed, match.false_found
            self._put(time, 'score', '', *map(int, numbers), rmse, significant(scores.gospa.total))
