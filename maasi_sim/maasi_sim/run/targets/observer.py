"""Writes the log of a target search from node messages and detects its end."""

from dataclasses import replace
from typing import Any

from rosbags.typesys.store import Typestore

from maasi_sim.run.facts import Decided, Fact, Found, Measured, Present, RobotAt, Updated
from maasi_sim.run.log import RunEnd, RunLog
from maasi_sim.run.mission import Observer
from maasi_sim.run.topics import DECISIONS, FOUND, REPORTS, UPDATE, within
from maasi_sim.scenario.schema import Scenario


class TargetObserver(Observer):
    """See `Observer`."""

    log: RunLog

    def __init__(self, name: str, scenario: Scenario, seed: int, types: Typestore) -> None:
        spaces = scenario.namespaces()
        self._detections = {f'/{name}/detections' for name in scenario.names()}
        kinds = dict.fromkeys(self._detections, 'DetectionArray')
        for space in spaces:
            kinds[within(space, UPDATE)] = 'FilterUpdate'
            kinds[within(space, FOUND)] = 'FoundTargetArray'
            kinds[within(space, DECISIONS)] = 'PlanDecision'
            kinds[within(space, REPORTS)] = 'Report'
        world = scenario.world(seed)
        super().__init__(RunLog(scenario, seed, world, name, keeps=False), types, kinds)
        self.update_topics = [within(space, UPDATE) for space in spaces]
        self.total = len(world.targets)
        self._spaces = spaces
        self._new_updates: list[Updated] = []
        self._new_found: dict[str, list[Found]] = {space: [] for space in spaces}
        # Updates of several filters, with all that each has found.
        self._history: list[Updated] = []
        # Step and reason of planners that have finished.
        self._settled: dict[str, tuple[int, str]] = {}
        # Step at which all planners had finished.
        self._ending: int | None = None
        # Robot and index of arrived measurements; steps of measurements that updates used.
        self._arrived: set[tuple[str, int]] = set()
        self._used: dict[tuple[str, int], int] = {}

    def handle(self, fact: Fact) -> None:
        """See `Observer.handle`; updates are counted by `settle`."""
        match fact:
            case Updated():
                self._new_updates.append(fact)
                for member in fact.members:
                    self._used.setdefault(member, fact.step)
            case Found():
                self._new_found[fact.team].append(fact)
            case _:
                self.log.add(fact)
        match fact:
            case Measured():
                self._arrived.add((fact.robot, fact.index))
            case Decided(decision=decision):
                self.explored = self.log.explored
                # From a planner that has finished.
                if decision.reason and not decision.robots:
                    self._settled.setdefault(fact.team, (decision.step, decision.reason))
                    self._note_ending(decision.step)
            case RobotAt(step=step) | Present(step=step):
                self._note_ending(step)

    def rests_on(self, topic: str, data: bytes, last_step: int) -> bool:
        """See `Observer.rests_on`."""
        if topic not in self._detections:
            return False
        message: Any = self._types.deserialize_cdr(data, self._kinds[topic])
        key = topic.split('/')[1], int(message.measurement)
        return self._used.get(key, last_step + 1) <= last_step

    def lacking(self, last_step: int) -> list[str]:
        """See `Observer.lacking`."""
        used = {key for key, step in self._used.items() if step <= last_step}
        return [f'measurement {index} of {name}' for name, index in sorted(used - self._arrived)]

    def settle(self) -> None:
        """See `Observer.settle`; a filter publishes found targets before their update."""
        updates, self._new_updates = self._new_updates, []
        several = len(self._spaces) > 1
        log = self.log
        for update in updates:
            if self._ending is not None and update.step > self._ending:
                continue
            # Updates of the same step from other filters may still arrive.
            if self.completed and not (several and update.step <= self.completed.step):
                continue
            found, waiting = None, self._new_found[update.team]
            while waiting and waiting[0].batch <= update.batch:
                found = waiting.pop(0).targets
            known = log.found_by(update.team) if found is None else found
            ids = {item.id for item in known}
            new = [item for item in update.new if item.id not in ids]
            if new or found is not None:
                found = sorted([*known, *new], key=lambda item: item.id)
            update = replace(update, found=found, clusters=(), new=())
            if several:
                self._history.append(update)
            log.add(update)
            now = log.progress[-1]
            self.news |= len(log.progress) == 1 or now.found != self.found + self.false_found
            self.found, self.false_found = now.true_found, now.found - now.true_found
            self.measurements, self.completed = now.measurements, log.completed
            if self.completed is not None:
                self.end_step = self.completed.step

    def _note_ending(self, step: int) -> None:
        """Note the end of the search: all planners that have a robot are settled."""
        if self._ending is not None or not self._settled:
            return
        searching = {
            space for space, names in self._spaces.items() if any(map(self.log.takes_part, names))
        }
        # Without any robot left, the finished planners decide.
        if self._settled.keys() >= (searching or self._spaces.keys()):
            last, self.settled = max(self._settled.values())
            self._ending = max(step, last)
            if self.completed is None:
                self.end_step = self._ending

    def record(self, end: RunEnd) -> RunLog:
        """See `Observer.record`; several filters by step instead of arrival."""
        if self._history:
            self.log.recount(self._history)
        self.log.close(end, end.time)
        return self.log
