"""Run a scenario: its nodes as processes, watched, recorded, and reported on."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from maasi_sim.bag import BagWriter
    from maasi_sim.cuboid_observer import CuboidObserver, CuboidRecord
    from maasi_sim.cuboid_scenario import AnyScenario
    from maasi_sim.node_plan import NodePlan
    from maasi_sim.observer import RunObserver, RunRecord
    from maasi_sim.processes import Domain, NodeProcess
    from maasi_sim.recorder_node import Recorder

DONE, NOT_ALL_FOUND, WRONG_INPUT, NODE_FAILED, INTERRUPTED = 0, 1, 2, 3, 130

# Bytes that may wait for the disk when the recorder says that it is done with a step.
_BACKLOG = 8 * 2**20
# Longest wall time until the next look at processes and topics [s].
_POLL = 0.02
# Wall time between two looks at processes, where steps come in quick succession [s].
_LOOK_PERIOD = 0.05
# Wall time after which it says whom it waits for, again and again [s].
_START_PATIENCE = 10.0
# One thread for each linear algebra: there is a process for each node already.
_NODE_ENVIRONMENT = {
    'PYTHONUNBUFFERED': '1',
    'OMP_NUM_THREADS': '1',
    'OPENBLAS_NUM_THREADS': '1',
    'MKL_NUM_THREADS': '1',
}


class Interruption:
    """Ctrl-C and termination as something to look at, so that nothing is cut short by them."""

    def __init__(self) -> None:
        self.count = 0
        self._at_once = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if self._at_once:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def at_once(self) -> Iterator[None]:
        """Let it cut short what takes long and leaves nothing behind."""
        self._at_once = True
        try:
            yield
        finally:
            self._at_once = False

    def __bool__(self) -> bool:
        """Tell whether it came."""
        return self.count > 0


@dataclass(frozen=True)
class Ending:
    """Why a run ended, its exit code, and what to say about it."""

    reason: str
    code: int
    text: str = ''


@dataclass(frozen=True)
class Options:
    """What the command line says about a run."""

    scenario: str
    out: Path | None = None
    seed: int | None = None
    lockstep: bool = False
    rate: float | None = None
    record: bool = True
    planner: str | None = None
    time_limit: float | None = None
    domain_id: int | None = None


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog='run_scenario',
        description='Run a scenario as separate ROS 2 processes, or replay a recording of one.',
        epilog='Exit codes: 0 all targets found (or, with stop: planner_done, ended as meant), '
        '1 not all found, 2 wrong input, 3 a node died or hung, 130 interrupted.',
    )
    parser.add_argument(
        'scenario', nargs='?', metavar='FILE', help='scenario file, or name of one in config'
    )
    parser.add_argument(
        '--out', type=Path, metavar='DIR', help='folder of the run (default: runs/<time>)'
    )
    parser.add_argument('--seed', type=_whole, metavar='N', help="instead of the scenario's")
    parser.add_argument(
        '--lockstep',
        action='store_true',
        help='step by step, as fast as it goes: the same seed gives the same run, to the bit',
    )
    parser.add_argument(
        '--rate', type=_positive, metavar='X', help='simulated over wall time (default: 1)'
    )
    parser.add_argument('--no-record', action='store_true', help='write no recording')
    parser.add_argument('--planner', metavar='NAME', help="instead of the scenario's")
    parser.add_argument(
        '--time-limit', type=_positive, metavar='S', help='simulated time [s], instead of its own'
    )
    parser.add_argument(
        '--domain-id', type=_whole, metavar='N', help='ROS domain (default: one of its own)'
    )
    parser.add_argument(
        '--replay',
        type=Path,
        metavar='BAG',
        help='feed the filter the recorded measurements, and compare what it finds',
    )
    return parser


def _whole(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f'read {text}, allowed are whole numbers from 0')
    return value


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'read {text}, allowed are finite numbers above 0')
    return value


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    interruption = Interruption()
    # Before NumPy is loaded; the nodes inherit it.
    for key, value in _NODE_ENVIRONMENT.items():
        os.environ.setdefault(key, value)
    parser = build_parser()
    options = parser.parse_args(arguments)
    if (options.replay is None) == (options.scenario is None):
        parser.error('give either a scenario or --replay BAG')
    from maasi_sim.bag import BagError
    from maasi_sim.processes import ProcessError
    from maasi_sim.yaml_files import ScenarioError

    try:
        if options.replay is not None:
            from maasi_sim.replay import replay

            stop_asked = interruption.__bool__
            return replay(options.replay, options.out, options.domain_id, stop_asked)
        chosen = Options(
            scenario=options.scenario,
            out=options.out,
            seed=options.seed,
            lockstep=options.lockstep,
            rate=options.rate,
            record=not options.no_record,
            planner=options.planner,
            time_limit=options.time_limit,
            domain_id=options.domain_id,
        )
        return ScenarioRun(chosen, interruption).execute()
    except (ScenarioError, ProcessError, BagError) as error:
        for line in str(error).splitlines():
            print(f'error: {line}', file=sys.stderr)
        return WRONG_INPUT


def make_folder(out: Path | None, suffix: str = '') -> Path:
    """Return a new folder of a run: `out`, or one named by the time in `runs`.

    Raises
    ------
    ScenarioError
        If it cannot be made, or holds a run already.
    """
    from maasi_sim.yaml_files import ScenarioError

    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            if (out / 'bag').exists() or (out / 'report.json').exists():
                raise ScenarioError(f'--out: {out} holds a run already, allowed is another folder')
            return out.resolve()
        stamp = datetime.now().strftime('%Y%m%d_%H%M%S') + suffix
        for number in range(1, 1000):
            folder = Path('runs') / (stamp if number == 1 else f'{stamp}_{number}')
            try:
                folder.mkdir(parents=True)
            except FileExistsError:
                continue
            return folder.resolve()
    except OSError as error:
        raise ScenarioError(f'--out: {error.filename}: {error.strerror}') from None
    raise ScenarioError(f'--out: runs/{stamp} exists a thousand times')


class ScenarioRun:
    """One run of a scenario, from the file to the report.

    Parameters
    ----------
    options : Options
        From the command line.
    interruption : Interruption
        Ends the run when it becomes true.

    Raises
    ------
    ScenarioError
        If the scenario or the options are wrong.
    """

    def __init__(self, options: Options, interruption: Interruption) -> None:
        from maasi_sim.cuboid_scenario import load_any_scenario
        from maasi_sim.progress import ProgressDisplay
        from maasi_sim.scenario import find_scenario

        self.options = options
        self.interruption = interruption
        path = find_scenario(options.scenario)
        self.name = path.stem
        overrides: dict[str, tuple[tuple[str, ...], Any]] = {}
        if options.planner is not None:
            overrides['--planner'] = (('planner', 'name'), options.planner)
        if options.time_limit is not None:
            overrides['--time-limit'] = (('limits', 'time'), options.time_limit)
        if options.seed is not None:
            overrides['--seed'] = (('seed',), options.seed)
        self.scenario: AnyScenario = load_any_scenario(path, overrides)
        self.seed = self.scenario.seed
        self.display = ProgressDisplay()
        self.events: list[dict[str, Any]] = []
        self.processes: dict[str, NodeProcess] = {}
        self.plans: list[NodePlan] = []
        self._begun: float | None = None
        self._ended: float | None = None
        self._failed: set[str] = set()
        self._looked = 0.0
        self._clocks: set[str] = set()

    def execute(self) -> int:
        """Run it and return the exit code."""
        from maasi_sim.processes import Domain

        with Domain(self.options.domain_id) as domain:
            self.folder = make_folder(self.options.out)
            os.environ.update(domain.environment())
            self._prepare()
            self.display.say(
                f'{self.name}: seed {self.seed}, {len(self.processes)} nodes in ROS domain '
                f'{domain.number}, results in {_short(self.folder)}'
            )
            # What comes then says that it was interrupted.
            with contextlib.suppress(KeyboardInterrupt), self.interruption.at_once():
                self._load()
            return self._execute(domain)

    def _prepare(self) -> None:
        """Write down what is run, and find the nodes' executables."""
        from maasi_sim.linked_robots import with_addresses
        from maasi_sim.node_plan import plan_nodes
        from maasi_sim.processes import NodeProcess, find_executable
        from maasi_sim.scenario import Scenario

        if isinstance(self.scenario, Scenario):
            self.scenario = with_addresses(self.scenario)
        file = self.folder / 'scenario.yaml'
        file.write_text(self.scenario.text(), encoding='utf-8')
        self.plans = plan_nodes(
            self.scenario,
            seed=self.seed,
            lockstep=self.options.lockstep,
            rate=self.options.rate,
            recorder=True,
            file=file,
        )
        self._clocks = {plan.full_name for plan in self.plans if plan.is_clock}
        parameters = self.folder / 'parameters'
        parameters.mkdir(exist_ok=True)
        for plan in self.plans:
            path = parameters / f'{plan.file_name}.yaml'
            path.write_text(plan.parameter_text(), encoding='utf-8')
            self.processes[plan.full_name] = NodeProcess(
                plan.full_name,
                plan.command(find_executable(plan.package, plan.executable), path),
                self.folder / f'{plan.file_name}.log',
            )

    def _load(self) -> None:
        """Load once what the nodes share, where they can be copies of this process."""
        from maasi_sim.warm_up import main_of, warm_up_all

        for plan in self.plans:
            self.processes[plan.full_name].main = main_of(plan.package, plan.executable)
        if any(process.main is not None for process in self.processes.values()):
            warm_up_all()

    def _execute(self, domain: Domain) -> int:
        from maasi_sim.processes import stop

        bag: BagWriter | None = None
        recorder: Recorder | None = None
        try:
            # Before all that takes time, and while there is a single thread.
            if not self.interruption:
                for process in self.processes.values():
                    process.start()
            from maasi_sim.bag import BagWriter, load_types
            from maasi_sim.recorder_node import Recorder

            types = load_types()
            observer = make_observer(self.name, self.scenario, self.seed, types)
            if self.options.record:
                bag = BagWriter(self.folder / 'bag', types, self.scenario.record.images)
                bag.write_scenario(self._facts_text(), {'seed': str(self.seed)})
            recorder = Recorder(domain.number, observer, bag)
            ready = self._wait_until_ready(recorder)
            threading.Thread(target=self._warn, daemon=True).start()
            ending = ready or self._follow(recorder, observer)
            self._ended = time.monotonic()
            self._end(recorder, ending)
        finally:
            stop(list(self.processes.values()))
            if recorder is not None:
                recorder.close()
            if bag is not None:
                bag.close()
            self.display.close()
        return self._report(ending, recorder, observer)

    def _warn(self) -> None:
        from maasi_sim.scenario import Scenario, never_seen

        warning = never_seen(self.scenario) if isinstance(self.scenario, Scenario) else ''
        if warning:
            self.display.say(f'warning: {warning}')

    def _facts_text(self) -> str:
        """Return all that a replay needs, as YAML."""
        from maasi_sim.yaml_files import to_yaml

        facts = {
            'name': self.name,
            'seed': self.seed,
            'lockstep': self.options.lockstep,
            'rate': self.options.rate,
            'scenario': self.scenario.content(),
            'nodes': {
                plan.full_name: {
                    'package': plan.package,
                    'executable': plan.executable,
                    'parameters': plan.parameters,
                }
                for plan in self.plans
            },
        }
        return to_yaml(facts)

    def _wait_until_ready(self, recorder: Recorder) -> Ending | None:
        """Wait until every node takes part, the recorder last; return an ending if one does not."""
        begin = time.monotonic()
        patience = _START_PATIENCE
        expected = [plan.full_name for plan in self.plans if plan.says_ready]
        needed = [topic for plan in self.plans for topic in plan.topics]
        while True:
            ending = self._look_after(recorder)
            if ending is not None:
                return ending
            recorder.discover()
            ready = recorder.take_ready()
            late = [name for name in expected if name not in ready]
            missing = recorder.missing(needed)
            if not late and not missing:
                break
            waited = time.monotonic() - begin
            what = ', '.join(
                [f'{name} is not ready' for name in late]
                or [f'nobody publishes {topic}' for topic in missing]
            )
            if waited > self.scenario.limits.start:
                self._failed.update(late)
                text = f'{what} after {self.scenario.limits.start:g} s'
                return Ending('not_ready', NODE_FAILED, text)
            if waited > patience:
                self.display.say(f'waiting: {what}')
                patience += _START_PATIENCE
            recorder.wait(_POLL)
        for complaint in recorder.complaints:
            self.display.say(f'warning: {complaint}')
        recorder.publish_ready()
        return None

    def _follow(self, recorder: Recorder, observer: RunObserver | CuboidObserver) -> Ending:
        """Follow the run until it ends, and return how."""
        lockstep = self.options.lockstep
        limit = round(self.scenario.limits.time * 1e9)
        moved = time.monotonic()
        last: tuple[int | None, int] = (None, 0)
        while True:
            recorder.wait(_POLL)
            recorder.drain(limit)
            ending = self._look_after(recorder) or self._goal(recorder, observer)
            if ending is not None:
                return ending
            now = (recorder.step, recorder.time)
            if now != last:
                last, moved = now, time.monotonic()
                self._begun = self._begun or moved
                if recorder.bag is not None:
                    recorder.bag.wait(_BACKLOG)
                if lockstep and recorder.step is not None:
                    recorder.publish_done(recorder.step)
            elif time.monotonic() - moved > self.scenario.limits.silence:
                return self._hung(recorder)
            if self.display.due or observer.news:
                self._show(recorder, observer)

    def _goal(self, recorder: Recorder, observer: RunObserver | CuboidObserver) -> Ending | None:
        """Return the ending that the scenario asks for, if it has come."""
        if observer.completed is not None:
            return Ending('all_found', DONE)
        if observer.settled is not None:
            if self.scenario.stop == 'planner_done':
                return Ending('planner_done', DONE, observer.settled)
            return Ending('planner_done', NOT_ALL_FOUND, observer.settled)
        if recorder.time >= self.scenario.limits.time * 1e9:
            return Ending('time_limit', NOT_ALL_FOUND)
        return None

    def _look_after(self, recorder: Recorder) -> Ending | None:
        """Return an ending if the run was interrupted or a node has died for good."""
        if self.interruption:
            return Ending('interrupted', INTERRUPTED)
        # Asking the system about each process takes longer than a step may.
        if time.monotonic() - self._looked < _LOOK_PERIOD:
            return None
        self._looked = time.monotonic()
        for name, process in self.processes.items():
            if process.running:
                continue
            text = f'{name} {process.how_it_ended()}'
            event = {'time': recorder.time / 1e9, 'node': name, 'event': 'died'}
            robot = self._robot_of(name)
            if robot is not None and name.endswith(('/driver', '/cuboid_planner')):
                recorder.stop_robot(robot)
            tries = self.scenario.limits.restarts
            # Another sim would begin with another time.
            if name in self._clocks:
                tries = 0
            if self.scenario.on_exit == 'respawn' and process.restarts < tries:
                self.events.append({**event, 'event': 'restarted'})
                process.restart()
                self.display.say(f'{text}; it is started again')
                continue
            self.events.append(event)
            self._failed.add(name)
            if process.restarts:
                text += f', after {process.restarts} restarts'
            return Ending('node_died', NODE_FAILED, text)
        return None

    def _hung(self, recorder: Recorder) -> Ending:
        """Return the ending of a run in which nothing moves any more."""
        silence = f'for {self.scenario.limits.silence:g} s'
        if recorder.step is None:
            return Ending('node_hung', NODE_FAILED, f'the simulated time stands still {silence}')
        steps = recorder.done_steps()
        late = [
            plan.full_name
            for plan in self.plans
            if plan.says_done and steps.get(plan.full_name, -1) < recorder.step
        ]
        self._failed.update(late)
        who = ', '.join(late) or next(plan.full_name for plan in self.plans if plan.is_clock)
        return Ending(
            'node_hung', NODE_FAILED, f'step {recorder.step}: nothing from {who} {silence}'
        )

    def _robot_of(self, node: str) -> str | None:
        name = node.strip('/').partition('/')[0]
        return name if name in self.scenario.robots else None

    def _show(self, recorder: Recorder, observer: RunObserver | CuboidObserver) -> None:
        from maasi_sim.progress import Status

        observer.news = False
        seconds = recorder.time / 1e9
        wall = time.monotonic() - (self._begun or time.monotonic())
        self.display.show(
            Status(
                time=seconds,
                measurements=observer.total_measurements,
                found=observer.found,
                targets=len(observer.truth),
                explored=observer.explored,
                word='found' if hasattr(observer, 'measurements') else 'visited',
                factor=seconds / wall if wall > 0.0 else 0.0,
            )
        )

    def _end(self, recorder: Recorder, ending: Ending) -> None:
        """Stop the robots, end the nodes, and record what they still say."""
        from maasi_sim.processes import stop

        recorder.finish()
        drivers = [
            plan.full_name
            for plan in self.plans
            if plan.package == 'maasi_drivers' or plan.executable == 'cuboid_planner_node'
        ]
        others = [name for name in self.processes if name not in drivers]
        if ending.reason == 'node_hung':
            for name in self.scenario.names():
                recorder.stop_robot(name)
        # Drivers stop their robots: the sim, or the robot, must still be there to hear it.
        stubborn = stop([self.processes[name] for name in drivers])
        recorder.wait(_POLL)
        recorder.drain()
        stubborn += stop([self.processes[name] for name in others])
        recorder.drain()
        if stubborn:
            self.display.say(f'had to be killed: {", ".join(stubborn)}')

    def _report(
        self, ending: Ending, recorder: Recorder, observer: RunObserver | CuboidObserver
    ) -> int:
        """Write the report, say how it went, and return the exit code."""
        wall = 0.0
        if self._begun is not None and self._ended is not None:
            wall = self._ended - self._begun
        record = observer.record(ending.reason, recorder.time / 1e9, wall, self.events)
        report, words = report_on(record, self.folder)
        self.display.say(words)
        if ending.text:
            self.display.say(f'ended: {ending.text}')
        if ending.code == NODE_FAILED:
            self._show_logs()
        self.display.say(f'report: {_short(self.folder / "report.json")}')
        if ending.reason == 'planner_done' and ending.code == NOT_ALL_FOUND:
            return DONE if report['missed'] == 0 else NOT_ALL_FOUND
        return ending.code

    def _show_logs(self) -> None:
        for process in self.processes.values():
            if process.name in self._failed:
                self.display.say(f'--- {_short(process.log)}\n{process.last_words()}')


def make_observer(
    name: str, scenario: AnyScenario, seed: int, types: Typestore
) -> RunObserver | CuboidObserver:
    """Return who gathers what the report of a scenario needs."""
    from maasi_sim.cuboid_observer import CuboidObserver
    from maasi_sim.cuboid_scenario import CuboidScenario
    from maasi_sim.observer import RunObserver

    if isinstance(scenario, CuboidScenario):
        return CuboidObserver(name, scenario, seed, types)
    return RunObserver(name, scenario, seed, types)


def report_on(record: RunRecord | CuboidRecord, folder: Path) -> tuple[dict[str, Any], str]:
    """Write a report into a folder; return it, and what to say of it."""
    from maasi_sim.cuboid_observer import CuboidRecord
    from maasi_sim.cuboid_report import cuboid_summary, write_cuboid_report
    from maasi_sim.report import summary, write_report

    if isinstance(record, CuboidRecord):
        report = write_cuboid_report(record, folder)
        return report, cuboid_summary(report)
    report = write_report(record, folder)
    return report, summary(report)


def _short(path: Path) -> str:
    """Return a path from here, if it is below."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)


if __name__ == '__main__':
    sys.exit(main())
