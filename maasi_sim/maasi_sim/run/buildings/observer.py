"""Gathers the data of a search of buildings from its messages, and reports them."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.arrays import FloatArray
from maasi_planner.buildings.agent import Activity
from maasi_planner.buildings.preplanning import CoveragePlan
from maasi_sim.run.buildings.scenario import CuboidScenario
from maasi_sim.run.mission import Observer, RunEnd, RunRecord, rows
from maasi_sim.run.report_files import MISSION_REASONS, summary, whole_report

MISSION_REASONS['buildings', 'all_found'] = 'all cuboids visited'


class Moment(NamedTuple):
    """When a cuboid was visited: since the first step [s], and the step."""

    time: float
    step: int


@dataclass
class CuboidRecord(RunRecord):
    """The record of a search of buildings."""

    mission: CoveragePlan
    snapshots: list[dict[str, Any]] = field(default_factory=list)  # several may be of one cuboid
    choices: dict[str, int] = field(default_factory=dict)  # decisions by how they were made
    # Time [s] and robots that search.
    active: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    solve_times: FloatArray = field(default_factory=lambda: np.zeros(0))  # of decisions [s]
    most_heard: int = 0  # largest number of robots received at once
    completed: Moment | None = None


class CuboidObserver(Observer):
    """Gathers the data of a report from serialised messages, in the order of arrival."""

    def __init__(self, name: str, scenario: CuboidScenario, seed: int, types: Typestore) -> None:
        self._decisions: dict[str, list[Any]] = {
            f'/{name}/decision': [] for name in scenario.names()
        }
        super().__init__(name, scenario, seed, types, list(self._decisions))
        self.mission = scenario.mission()
        self.total = len(self.mission.cells)
        self._visited_at: dict[int, Moment] = {}
        self._done: dict[str, int] = {}

    def add(self, topic: str, data: bytes) -> None:
        """See `Observer.add`."""
        super().add(topic, data)
        if topic not in self._decisions:
            return
        decision = self.decode(data, 'CuboidDecision')
        self._decisions[topic].append(decision)
        moment = Moment(self.time(decision.header.stamp), int(decision.step))
        for shot in decision.snapshots:
            self.measurements += 1
            known = self._visited_at.get(int(shot.cuboid))
            self.news = self.news or known is None
            if known is None or moment.step < known.step:
                self._visited_at[int(shot.cuboid)] = moment
        self.found = len(self._visited_at)
        self.explored = self.found / self.total
        if decision.done:
            self._done.setdefault(topic, moment.step)
        if len(self._done) == len(self._decisions):
            self.settled = 'every planner knows that all cuboids are visited'
            self.end_step = max(self._done.values())
        if self.scenario.stop == 'all_found' and self.found == self.total:
            self.completed = max(self._visited_at.values())
            self.end_step = self.completed.step

    def record(self, end: RunEnd) -> CuboidRecord:
        """See `Observer.record`."""
        end_time = end.time if self.completed is None else self.completed.time
        record = CuboidRecord(self.name, self.scenario, self.seed, self.mission, end_time=end_time)
        if self.found == self.total:
            record.completed = max(self._visited_at.values())
        active: dict[float, int] = {}
        times = []
        for name, decisions in zip(self.scenario.names(), self._decisions.values()):
            activity = Activity.SEARCHING
            for item in decisions:
                time = self.time(item.header.stamp)
                if time > end_time:
                    continue
                record.choices[item.how] = record.choices.get(item.how, 0) + 1
                record.most_heard = max(record.most_heard, len(item.heard))
                times.append(float(item.solve_time))
                before, activity = activity, Activity(item.activity)
                active[time] = active.get(time, 0) + (activity is Activity.SEARCHING)
                if activity is not before:
                    word = activity.name.lower()
                    record.events.append({'time': time, 'agent': name, 'event': word})
                record.snapshots += [self._snapshot(shot, name, time) for shot in item.snapshots]
        record.snapshots.sort(key=lambda shot: (shot['time'], shot['agent'], shot['cuboid']))
        record.active = rows(sorted(active.items()), 2)
        record.solve_times = np.array(times)
        self._complete(record, end)
        return record

    def _snapshot(self, shot: Any, agent: str, time: float) -> dict[str, Any]:
        cell = self.mission.cells[int(shot.cuboid)]
        return {
            'cuboid': int(shot.cuboid),
            'object': cell.target,
            'face': cell.face,
            'agent': agent,
            'time': time,
            'position': [shot.position.x, shot.position.y, shot.position.z],
            'direction': [shot.direction.x, shot.direction.y, shot.direction.z],
            'distance': float(shot.distance),
            'detection_probability': float(shot.detection_probability),
        }


def build_cuboid_report(record: CuboidRecord) -> dict[str, Any]:
    """Return the report of a run as plain values; visited cuboids count as found."""
    mission, shots = record.mission, record.snapshots
    visited = {shot['cuboid'] for shot in shots}
    total = len(mission.cells)
    cuts = sum(
        mission.way_hits(begin, end)
        for path in record.trajectories.values()
        for begin, end in zip(path[:-1, 1:], path[1:, 1:])
    )
    times = record.solve_times
    complete = record.completed
    content = {
        'cuboids': {
            'total': total,
            'visited': len(visited),
            'missed': sorted(set(range(total)) - visited),
            'lost': [
                {'object': cell.target, 'face': cell.face, 'reason': reason}
                for cell, reason in mission.lost
            ],
        },
        'missed': total - len(visited),
        'coverage': mission.coverage * len(visited) / total,
        'snapshots': shots,
        'least_detection_probability': min(
            (shot['detection_probability'] for shot in shots), default=None
        ),
        'measurements': {
            name: sum(shot['agent'] == name for shot in shots) for name in record.scenario.names()
        },
        'measurements_to_find_all': len(shots) if complete else None,
        'time_to_find_all': complete.time if complete else None,
        'decisions': sum(record.choices.values()),
        'choices': dict(sorted(record.choices.items())),
        'solve_time': {'median': float(np.median(times)), 'largest': float(times.max())}
        if len(times)
        else None,
        'most_heard': record.most_heard,
        'collisions': int(cuts),
    }
    return whole_report(record, 'buildings', content)


def cuboid_summary(report: dict[str, Any]) -> str:
    """Return the report in a few lines."""
    cuboids = report['cuboids']
    counts = (
        f'{len(report["snapshots"])} snapshots, {report["decisions"]} decisions, '
        f'{report["collisions"]} collisions'
    )
    if report['time_to_find_all'] is not None:
        counts += f'; all visited after {report["time_to_find_all"]:.1f} s'
    return summary(report, f'{cuboids["visited"]} of {cuboids["total"]} cuboids visited', counts)
