"""Record and report of a search of buildings from its messages."""

from collections import Counter
from collections.abc import Mapping
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.store import Typestore

from maasi_filter.arrays import FloatArray
from maasi_filter.wording import counted
from maasi_planner.buildings.agent import Activity
from maasi_planner.buildings.preplanning import CoveragePlan
from maasi_sim.run.buildings.facts import CuboidsDecided
from maasi_sim.run.buildings.scenario import CuboidScenario
from maasi_sim.run.facts import Fact
from maasi_sim.run.log import RunEnd, RunRecord
from maasi_sim.run.mission import Observer
from maasi_sim.run.report_files import MISSION_REASONS, summary, whole_report
from maasi_sim.run.topics import point

MISSION_REASONS['buildings', 'all_found'] = 'all cuboids visited'


class Moment(NamedTuple):
    """Time since the first step [s] and step of a visit."""

    time: float
    step: int


class CuboidRecord(RunRecord):
    """Record of a search of buildings.

    mission: what is to be visited; snapshots: by time, several may show one cuboid; choices:
    number of decisions by method; active: time [s] and number of searching robots (n, 2);
    solve_times: of decisions [s]; most_heard: largest number of robots received at once;
    completed: when all was visited.
    """

    snapshots: list[dict[str, Any]]
    choices: Mapping[str, int]
    active: FloatArray
    solve_times: FloatArray
    most_heard: int
    completed: Moment | None = None

    def __init__(self, scenario: CuboidScenario, seed: int, name: str = '') -> None:
        super().__init__(scenario, seed, name)
        self.mission: CoveragePlan = scenario.mission()
        self.snapshots = []
        self._decisions: list[tuple[float, Any]] = []
        self.visited_at: dict[int, Moment] = {}

    def add(self, fact: Fact) -> None:
        """See `RunRecord.add`."""
        super().add(fact)
        if not isinstance(fact, CuboidsDecided):
            return
        time, decision = fact.time, fact.message
        self._decisions.append((time, decision))
        moment = Moment(time, int(decision.step))
        for shot in decision.snapshots:
            # From another mission.
            if int(shot.cuboid) >= len(self.mission.cells):
                continue
            self.snapshots.append(self._snapshot(shot, decision.robot, time))
            known = self.visited_at.get(int(shot.cuboid))
            if known is None or moment.step < known.step:
                self.visited_at[int(shot.cuboid)] = moment

    @property
    def complete(self) -> bool:
        """Whether all cuboids are visited."""
        return len(self.visited_at) == len(self.mission.cells)

    def close(self, end: RunEnd, until: float) -> None:
        """See `RunRecord.close`."""
        if self.complete:
            self.completed = max(self.visited_at.values())
        taken = [item for item in self._decisions if item[0] <= until]
        active: dict[float, int] = {}
        before: dict[str, Activity] = {}
        for time, item in sorted(taken, key=lambda pair: str(pair[1].robot)):
            activity = Activity(item.activity)
            active[time] = active.get(time, 0) + (activity is Activity.SEARCHING)
            if activity is not before.get(item.robot, Activity.SEARCHING):
                self._note(time, item.robot, activity.name.lower())
            before[item.robot] = activity
        self.choices = Counter(item.how for _, item in taken)
        self.most_heard = max((len(item.heard) for _, item in taken), default=0)
        self.active = np.array(sorted(active.items())).reshape(-1, 2)
        self.solve_times = np.array([float(item.solve_time) for _, item in taken])
        shots = [shot for shot in self.snapshots if shot['time'] <= until]
        self.snapshots = sorted(shots, key=itemgetter('time', 'agent', 'cuboid'))
        super().close(end, until)

    def _snapshot(self, shot: Any, agent: str, time: float) -> dict[str, Any]:
        cell = self.mission.cells[int(shot.cuboid)]
        return {
            'cuboid': int(shot.cuboid),
            'object': cell.target,
            'face': cell.face,
            'agent': agent,
            'time': time,
            'position': list(point(shot.position)),
            'direction': list(point(shot.direction)),
            'distance': float(shot.distance),
            'detection_probability': float(shot.detection_probability),
        }


class CuboidObserver(Observer):
    """See `Observer`; ends when all cuboids are visited, or all robots know that."""

    log: CuboidRecord

    def __init__(self, name: str, scenario: CuboidScenario, seed: int, types: Typestore) -> None:
        log = CuboidRecord(scenario, seed, name)
        decisions = [f'/{name}/decision' for name in scenario.names()]
        super().__init__(log, types, dict.fromkeys(decisions, 'CuboidDecision'))
        self.total = len(log.mission.cells)
        self._done: dict[str, int] = {}

    def handle(self, fact: Fact) -> None:
        """See `Observer.handle`."""
        log, found = self.log, self.found
        super().handle(fact)
        if not isinstance(fact, CuboidsDecided):
            return
        decision = fact.message
        self.found, self.measurements = len(log.visited_at), len(log.snapshots)
        self.news = self.news or self.found > found
        self.explored = self.found / self.total
        if decision.done:
            self._done.setdefault(decision.robot, int(decision.step))
        if len(self._done) == len(log.scenario.names()):
            self.settled = 'every planner knows that all cuboids are visited'
            self.end_step = max(self._done.values())
        if log.scenario.stop == 'all_found' and log.complete:
            self.completed = max(log.visited_at.values())
            self.end_step = self.completed.step

    def record(self, end: RunEnd) -> CuboidRecord:
        """See `Observer.record`."""
        self.log.close(end, end.time if self.completed is None else self.completed.time)
        return self.log


def build_cuboid_report(record: CuboidRecord) -> dict[str, Any]:
    """Return the report of a run as plain values; visited cuboids count as found."""
    mission, shots = record.mission, record.snapshots
    visited = {shot['cuboid'] for shot in shots}
    total = len(mission.cells)
    cuts = sum(
        mission.path_hits(begin, end)
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
        f'{counted(len(report["snapshots"]), "snapshot")}, '
        f'{counted(report["decisions"], "decision")}, '
        f'{counted(report["collisions"], "collision")}'
    )
    if report['time_to_find_all'] is not None:
        counts += f'; all visited after {report["time_to_find_all"]:.1f} s'
    return summary(report, f'{cuboids["visited"]} of {cuboids["total"]} cuboids visited', counts)
