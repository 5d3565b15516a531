"""Searches of random fields, checked by the true positions of the robots at each step.

`python test/sim/random_fields.py FIRST LAST` runs the fields FIRST to LAST - 1 of a block of seeds,
prints what is wrong in one line each, and a table of it. `--write` keeps the scenario of each
field that fails.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'benchmarks'))

from field_checker import Fault, Ground, SearchChecker, Track
from field_maker import Field, draw_zone, make_field
from quality_conditions import SEEDS

from maasi_drivers.agent.waypoint_follower import GoalStatus
from maasi_filter.geometry.area import Area
from maasi_filter.ros.keep_outs import with_keep_outs
from maasi_planner.motion import RobotState
from maasi_sim.scenario.layering import ScenarioWarning
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.search import _Search


class FieldSearch(_Search):
    """A search in one process whose keep-outs change, and which notes what truly happens."""

    def __init__(self, made: Field, scenario: Any) -> None:
        super().__init__(scenario, made.seed, None)
        self.made, self.notes = made, []
        self.track = Track(sorted(self.simulation.robots), scenario.step)
        self._drawn: dict[int, str] = {}  # zones by the number of their change
        self._grounded(self.world.area)
        self._note()
        advance = self.simulation.advance

        def watched() -> None:
            self._change()
            advance()
            self._note()

        self.simulation.advance = watched  # type: ignore[method-assign]
        for name, robot in self.simulation.robots.items():
            robot.sweep = self._measuring(name, robot)  # type: ignore[method-assign]

    def _measuring(self, name: str, robot: Any) -> Any:
        sweep = robot.sweep

        def watched(step: int) -> Any:
            self.track.measured.append((name, np.array(robot.state.pose.position)))
            return sweep(step)

        return watched

    def _note(self) -> None:
        robots = [self.simulation.robots[name] for name in self.track.names]
        self.track.positions.append(np.array([robot.state.pose.position for robot in robots]))
        self.track.speeds.append(
            np.array([np.linalg.norm(robot.state.velocity) for robot in robots])
        )
        self.track.charges.append(np.array([robot.battery.charge for robot in robots]))

    def _grounded(self, area: Area) -> None:
        step = len(self.track.positions)
        if self.track.grounds and self.track.grounds[-1].step == step:
            self.track.grounds.pop()
        self.track.grounds.append(Ground(step, area, len(self._drawn)))

    def _change(self) -> None:
        """Draw and remove the zones that are due."""
        now, before = self.time, dict(self._drawn)
        for number, change in enumerate(self.made.changes):
            begin = self.made.changes[number].at
            if begin <= now < begin + 0.99 * self.scenario.step:
                zone = self._zone(change)
                if zone is not None:
                    self._drawn[number] = zone
            elif now >= begin + change.lasts:
                self._drawn.pop(number, None)
        if self._drawn != before:
            environment = self.scenario.environment
            fixed = [str(zone) for zone in environment.keep_outs]
            self.adopt_area(with_keep_outs(environment, [*fixed, *self._drawn.values()]))

    def _zone(self, change: Any) -> str | None:
        """Return a zone as text, if robots can leave it, and enough of the area is left."""
        ground = self.track.grounds[-1]
        robots = {n: r.state.pose.position for n, r in self.simulation.robots.items()}
        chargers = [
            np.array(home)
            for robot in self.scenario.robots.values()
            if robot.endurance
            for home in robot.endurance.chargers or [robot.start]
        ]
        drawn = draw_zone(change, ground.free, robots, chargers)
        environment = self.scenario.environment
        settings = type(environment).model_validate(
            {'bounds': environment.bounds, 'keep_outs': [drawn]}
        )
        left = ground.free.difference(Ground(0, Area(settings), 0).shapes[0])
        border = self.world.area.border
        parts = getattr(border, 'geoms', [border])
        rooms = [left.intersection(part).buffer(-2.5) for part in parts]
        if left.area < 0.25 * border.area or any(room.is_empty for room in rooms):
            self.notes.append(f'{change.kind}@{change.at:g} leaves too little')
            return None
        return str(settings.keep_outs[0])

    def adopt_area(self, area: Area) -> None:
        """Take another area in planners, filters and drivers, as their nodes do."""
        self._grounded(area)
        for group in self._groups:
            group.coordinator.adopt_area(area)
            group.filter.adopt_area(area)
        for robot in self._robots.values():
            follower, motion = robot.follower, robot.follower.motion
            goal, ways = follower.current, None
            if goal is not None:
                state = RobotState(
                    robot.pose.pose, robot.pose.velocity, robot.pose.angular_velocity
                )
                ways = motion.predict(state, goal.waypoint[None, :], self.scenario.step).positions
            motion.adopt_area(area, robot.body.settings.radius)
            free = [] if ways is None else [motion.keep_out.is_free(place) for place in ways[0]]
            # The part on which it leaves a zone does not count.
            if not all(free[free.index(True) if True in free else 0 :]):
                follower.end(GoalStatus.ABORTED, 'path blocked by a keep-out zone')


@dataclass
class Outcome:
    """A field, and what was wrong with its search."""

    made: Field
    faults: list[Fault]
    end: str
    seconds: float
    slowest: float  # decision but the first [s]


def run_field(seed: int) -> Outcome:
    """Search the field of a seed, and check it."""
    made, begin = make_field(seed), time.perf_counter()
    running, result, faults, end = None, None, [], ''
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', ScenarioWarning)
            scenario = scenario_from_values(made.values, f'field {seed}')
        running = FieldSearch(made, scenario)
        result = running.run(None)
        end = result.end_reason
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f'{Path(last.filename).name}:{last.lineno}'
        kind = 'refused' if running is None else 'exception'
        step = 0 if running is None else running.step
        text = f'{type(error).__name__} in {where}: {error}'.replace('\n', ' ')
        faults.append(Fault(kind, step, text))
        end = kind
    if running is not None:
        finished = next((g.coordinator.finished for g in running._groups), None) or '-'
        faults += SearchChecker(made, scenario, running.track, result, finished).faults()
    slowest = max(result.planning_times[1:], default=0.0) if result else 0.0
    return Outcome(made, faults, end, time.perf_counter() - begin, slowest)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('first', type=int, help='first field of the block')
    parser.add_argument('last', type=int, help='the one after the last')
    parser.add_argument('--seeds', choices=sorted(SEEDS), default='development')
    parser.add_argument('--every', action='store_true', help='print each field')
    parser.add_argument('--write', type=Path, help='folder for the scenarios of fields that fail')
    options = parser.parse_args()
    base = SEEDS[options.seeds].start
    kinds: Counter[str] = Counter()
    by_planner: Counter[tuple[str, str]] = Counter()
    ends: Counter[str] = Counter()
    failed, total, slowest, begin = 0, 0, 0.0, time.perf_counter()
    for number in range(options.first, options.last):
        outcome = run_field(base + number)
        made, total = outcome.made, total + 1
        ends[outcome.end] += 1
        slowest = max(slowest, outcome.slowest)
        if outcome.faults or options.every:
            print(f'{number} {outcome.end} {outcome.seconds:.1f} s {made.describe()}', flush=True)
        for fault in outcome.faults:
            print(f'  {number} {fault.kind} @{fault.step}: {fault.text}', flush=True)
        for kind in {fault.kind.split(' (')[0] for fault in outcome.faults}:
            kinds[kind] += 1
            by_planner[kind, made.planner] += 1
        failed += bool(outcome.faults)
        if outcome.faults and options.write:
            import yaml

            options.write.mkdir(parents=True, exist_ok=True)
            text = yaml.safe_dump(made.values, sort_keys=False)
            (options.write / f'{number}.yaml').write_text(text, encoding='utf-8')
    print(f'\n{failed} of {total} fields fail, {time.perf_counter() - begin:.0f} s')
    print(f'slowest decision but the first {slowest:.2f} s; ends: {dict(ends)}')
    for kind, count in kinds.most_common():
        planners = ', '.join(f'{p} {n}' for (k, p), n in by_planner.most_common() if k == kind)
        print(f'| {kind} | {count} | {planners} |')
    return int(failed > 0)


if __name__ == '__main__':
    sys.exit(main())
