"""Run a scenario: its nodes as processes, watched, recorded, and reported on."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from maasi_sim.run.run_options import Options, parse

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from maasi_sim.buildings.observer import CuboidObserver
    from maasi_sim.buildings.scenario import AnyScenario
    from maasi_sim.run.arming import Arming
    from maasi_sim.run.bag import BagWriter
    from maasi_sim.run.node_plan import NodePlan
    from maasi_sim.run.observer import RunObserver
    from maasi_sim.run.processes import Domain, NodeProcess
    from maasi_sim.run.recorder_node import Recorder

DONE, NOT_ALL_FOUND, WRONG_INPUT, NODE_FAILED, NOT_WRITTEN, INTERRUPTED = 0, 1, 2, 3, 4, 130

# Bytes that may wait for the disk when the recorder says that it is done with a step.
_BACKLOG = 8 * 2**20
# Longest wall time until the next look at processes and topics [s].
_POLL = 0.02
# Wall time between two looks at processes, where steps come in quick succession [s].
_LOOK_PERIOD = 0.05
# Between two looks at whether somebody follows the clock [s].
_FOLLOWERS_PERIOD = 0.5
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


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    interruption = Interruption()
    # Before NumPy is loaded; the nodes inherit it.
    for key, value in _NODE_ENVIRONMENT.items():
        os.environ.setdefault(key, value)
    options = parse(arguments)
    from maasi_sim.run.bag import BagError, BagWriteError
    from maasi_sim.run.processes import ProcessError
    from maasi_sim.run.run_folder import ResultsError
    from maasi_sim.scenario.layering import ScenarioError

    try:
        if options.replay is not None:
            from maasi_sim.run.replay import replay

            stop_asked = interruption.__bool__
            return replay(options.replay, options.out, options.domain_id, stop_asked)
        return ScenarioRun(options, interruption).execute()
    except (ScenarioError, ProcessError, BagError, ResultsError) as error:
        with contextlib.suppress(OSError):
            for line in str(error).splitlines():
                print(f'error: {line}', file=sys.stderr)
        return NOT_WRITTEN if isinstance(error, (ResultsError, BagWriteError)) else WRONG_INPUT


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
        from maasi_sim.buildings.scenario import load_any_scenario
        from maasi_sim.run.node_watch import NodeWatch
        from maasi_sim.run.progress import ProgressDisplay
        from maasi_sim.scenario.loading import find_scenario

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
        self._check_namespace()
        self.display = ProgressDisplay()
        self.events: list[dict[str, Any]] = []
        self.processes: dict[str, NodeProcess] = {}
        self.plans: list[NodePlan] = []
        self._begun: float | None = None
        self._ended: float | None = None
        self._failed: set[str] = set()
        self._looked = 0.0
        limits = self.scenario.limits
        self.watch = NodeWatch(limits.heartbeat, limits.start)
        self._clocks: set[str] = set()
        # What could not be written, and why.
        self._unwritten: list[str] = []

    def _check_namespace(self) -> None:
        from maasi_sim.scenario.layering import ScenarioError

        # A node in the namespace of a robot belongs to that robot.
        last = self.options.namespace.rpartition('/')[2]
        if last in self.scenario.names():
            raise ScenarioError(
                f"--namespace: read '{self.options.namespace}', allowed is a name that is none of "
                'a robot of the scenario'
            )

    def execute(self) -> int:
        """Run it and return the exit code."""
        from maasi_sim.run.processes import Domain
        from maasi_sim.run.run_folder import make_folder

        options = self.options
        with Domain(
            options.domain_id, team=options.namespace, shared=options.follow_clock
        ) as domain:
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
        from maasi_sim.emulators.linked_robots import with_addresses
        from maasi_sim.run.node_plan import (
            in_team,
            plan_nodes,
            with_followed_clock,
            with_saved_state,
        )
        from maasi_sim.run.processes import NodeProcess, find_executable
        from maasi_sim.run.run_folder import ResultsError, write_text
        from maasi_sim.run.rviz_view import view_text
        from maasi_sim.scenario.schema import Scenario

        if isinstance(self.scenario, Scenario):
            self.scenario = with_addresses(self.scenario)
        team = self.options.namespace
        file = self.folder / 'scenario.yaml'
        write_text(file, self.scenario.text())
        write_text(self.folder / 'view.rviz', view_text(self.scenario, team))
        self.plans = plan_nodes(
            self.scenario,
            seed=self.seed,
            lockstep=self.options.lockstep,
            rate=self.options.rate,
            recorder=True,
            file=file,
        )
        self.plans = [in_team(plan, team) for plan in self.plans]
        if self.options.follow_clock:
            self.plans = [with_followed_clock(plan) for plan in self.plans]
        if self.scenario.on_exit == 'respawn':
            self.plans = [with_saved_state(plan, self.folder / 'state') for plan in self.plans]
        self._beside = {
            plan.full_name for plan in self.plans if not plan.says_done and not plan.is_clock
        }
        self._clocks = {plan.full_name for plan in self.plans if plan.is_clock}
        parameters = self.folder / 'parameters'
        try:
            parameters.mkdir(exist_ok=True)
        except OSError as error:
            raise ResultsError(f'{parameters}: {error.strerror}') from error
        for plan in self.plans:
            path = parameters / f'{plan.file_name}.yaml'
            write_text(path, plan.parameter_text())
            self.processes[plan.full_name] = NodeProcess(
                plan.full_name,
                plan.command(
                    find_executable(plan.package, plan.executable), path, self.options.log_level
                ),
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
        from maasi_sim.run.processes import stop

        bag: BagWriter | None = None
        recorder: Recorder | None = None
        try:
            # Before all that takes time, and while there is a single thread.
            if not self.interruption:
                for process in self.processes.values():
                    process.start()
                    self.watch.begin(process.name, process.pid, time.monotonic())
            from maasi_sim.run.arming import Arming
            from maasi_sim.run.bag import BagWriter, load_types
            from maasi_sim.run.recorder_node import Recorder

            types = load_types()
            observer = make_observer(self.name, self.scenario, self.seed, types)
            if self.options.record:
                bag = BagWriter(self.folder / 'bag', types, self.scenario.record.images)
                bag.write_scenario(self._facts_text(), {'seed': str(self.seed)})
            recorder = Recorder(domain.number, observer, bag, self.options.namespace)
            arming = Arming(recorder.context, self._taking_off())
            ready = self._wait_until_ready(recorder, arming)
            threading.Thread(target=self._warn, daemon=True).start()
            ending = ready or self._follow(recorder, observer, arming)
            arming.close()
            self._ended = time.monotonic()
            self._end(recorder, ending)
            if self._is_followed(recorder):
                if bag is not None:
                    self._close(bag)
                code = self._report(ending, recorder, observer)
                self._keep_clock(recorder)
                return code
        finally:
            stop(list(self.processes.values()))
            if recorder is not None:
                recorder.close()
            if bag is not None:
                self._close(bag)
            self.display.close()
        return self._report(ending, recorder, observer)

    def _close(self, bag: BagWriter) -> None:
        from maasi_sim.run.bag import BagError

        try:
            bag.close()
        except BagError as error:
            self._unwritten.append(str(error))

    def _warn(self) -> None:
        from maasi_sim.scenario.schema import Scenario
        from maasi_sim.scenario.visibility import never_seen

        warning = never_seen(self.scenario) if isinstance(self.scenario, Scenario) else ''
        if warning:
            self.display.say(f'warning: {warning}')

    def _facts_text(self) -> str:
        """Return all that a replay needs, as YAML."""
        from maasi_sim.scenario.layering import to_yaml

        facts = {
            'name': self.name,
            'seed': self.seed,
            'lockstep': self.options.lockstep,
            'rate': self.options.rate,
            'namespace': self.options.namespace,
            'follow_clock': self.options.follow_clock,
            'scenario': self.scenario.content(),
            'nodes': {
                self._without_team(plan.full_name): {
                    'package': plan.package,
                    'executable': plan.executable,
                    'parameters': plan.parameters,
                }
                for plan in self.plans
            },
        }
        return to_yaml(facts)

    def _wait_until_ready(self, recorder: Recorder, arming: Arming) -> Ending | None:
        """Wait until every node takes part, the recorder last; return an ending if one does not."""
        begin = time.monotonic()
        patience = _START_PATIENCE
        team = self.options.namespace
        where = f' --namespace {team}' if team else ''
        for name in self._external():
            self.display.say(
                f'{name} is external: it takes off when you call its service arm (search_command '
                f'arm --robot {name}{where}, with ROS_DOMAIN_ID={recorder.context.get_domain_id()})'
            )
        expected = [plan.full_name for plan in self.plans if plan.says_ready]
        needed = [topic for plan in self.plans for topic in plan.topics]
        while True:
            ending = self._look_after(recorder)
            if ending is not None:
                return ending
            recorder.discover()
            # What they say while they start is recorded as it comes.
            recorder.drain()
            ready = recorder.take_ready()
            arming.call(ready)
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
        # Their executors run, also where no heartbeat has been heard so far.
        for name in expected:
            self.watch.beat(name, time.monotonic())
        recorder.publish_ready()
        return None

    def _follow(
        self, recorder: Recorder, observer: RunObserver | CuboidObserver, arming: Arming
    ) -> Ending:
        """Follow the run until it ends, and return how."""
        from maasi_sim.run.bag import BagError

        lockstep = self.options.lockstep
        limit = round(self.scenario.limits.time * 1e9)
        moved = time.monotonic()
        last: tuple[int | None, int] = (None, 0)
        while True:
            recorder.wait(_POLL)
            recorder.drain(limit)
            arming.call(recorder.ready)
            ending = self._look_after(recorder) or self._goal(recorder, observer)
            if ending is not None:
                return ending
            now = (recorder.step, recorder.time)
            if now != last:
                last, moved = now, time.monotonic()
                self._begun = self._begun or moved
                if recorder.bag is not None:
                    with contextlib.suppress(BagError):
                        recorder.bag.wait(_BACKLOG)
                if lockstep and recorder.step is not None:
                    recorder.publish_done(recorder.step)
            elif any(self.processes[name].restarts for name in self.watch.starting()):
                # A restarted node may have to compile: `limits.start` counts.
                moved = time.monotonic()
            elif time.monotonic() - moved > self.scenario.limits.silence:
                return self._hung(recorder)
            if self.display.due or observer.news:
                self._show(recorder, observer)

    def _goal(self, recorder: Recorder, observer: RunObserver | CuboidObserver) -> Ending | None:
        """Return the ending that the scenario asks for, if it has come."""
        if observer.completed is not None:
            return Ending('all_found', DONE)
        if recorder.bag is not None and recorder.bag.failed:
            return Ending('not_recorded', NOT_WRITTEN)
        if observer.settled is not None:
            if self.scenario.stop == 'planner_done':
                return Ending('planner_done', DONE, observer.settled)
            return Ending('planner_done', NOT_ALL_FOUND, observer.settled)
        if recorder.elapsed >= self.scenario.limits.time:
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
        for name, beat in recorder.heartbeats.items():
            self.watch.beat(name, beat)
        recorder.heartbeats.clear()
        ending = self._look_for_hung(recorder)
        if ending is not None:
            return ending
        for name, process in self.processes.items():
            if process.running:
                continue
            text = f'{name} {process.how_it_ended()}'
            event = {'time': recorder.elapsed, 'node': name, 'event': 'died'}
            robot = self._robot_of(name)
            if robot is not None and name.endswith(('/driver', '/cuboid_planner')):
                recorder.stop_robots([robot])
            tries = self.scenario.limits.restarts
            # Another sim would begin with another time.
            if name in self._clocks:
                tries = 0
            if self.scenario.on_exit == 'respawn' and process.restarts < tries:
                self.events.append({**event, 'event': 'restarted'})
                recorder.ready.discard(name)
                process.restart()
                self.watch.begin(name, process.pid, self._looked)
                self.display.say(f'{text}; it is started again')
                continue
            self.events.append(event)
            self._failed.add(name)
            if process.restarts:
                text += f', after {process.restarts} restarts'
            return Ending('node_died', NODE_FAILED, text)
        return None

    def _look_for_hung(self, recorder: Recorder) -> Ending | None:
        """End the run, or kill and restart, where a node hangs or does not get ready."""
        now = self._looked
        # Before the first step `_wait_until_ready` looks after those that start.
        late = [] if self._begun is None else self.watch.late(now)
        if late:
            self._failed.update(late)
            text = f'{", ".join(late)} not ready {self.scenario.limits.start:g} s after the start'
            return Ending('not_ready', NODE_FAILED, text)
        hung = self.watch.hung(now)
        for name, silent in hung.items():
            # In lockstep a step may take long: `limits.silence` counts for those that it awaits.
            awaited = self.options.lockstep and name not in self._beside
            if self._begun is None or awaited or not self.processes[name].running:
                continue
            text = f'{name} hangs: no heartbeat for {silent:.1f} s'
            self.events.append({'time': recorder.elapsed, 'node': name, 'event': 'hung'})
            robot = self._robot_of(name)
            if robot is not None:
                recorder.stop_robots([robot])
            if self.scenario.on_exit == 'respawn' and name not in self._clocks:
                self.display.say(f'{text}; it is killed')
                self.processes[name].signal(signal.SIGKILL)
                continue
            self._failed.add(name)
            return Ending('node_hung', NODE_FAILED, text)
        return None

    def _hung(self, recorder: Recorder) -> Ending:
        """Return the ending of a run in which nothing moves any more."""
        silence = f'for {self.scenario.limits.silence:g} s'
        if self.options.follow_clock:
            text = f'/clock, which this run follows, stands still {silence}'
            return Ending('clock_stopped', NODE_FAILED, text)
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

    def _taking_off(self) -> list[str]:
        """Return the robots, with namespace, whose drivers take off, all of them simulated."""
        robots = getattr(self.scenario, 'robots', {})
        team = f'{self.options.namespace}/'.lstrip('/')
        return [team + name for name, robot in robots.items() if getattr(robot, 'takes_off', False)]

    def _external(self) -> list[str]:
        """Return the robots that another program moves, and that take off."""
        robots = getattr(self.scenario, 'robots', {})
        return [
            name
            for name, robot in robots.items()
            if getattr(robot, 'external', False) and robot.link != 'topics'
        ]

    def _without_team(self, name: str) -> str:
        team = self.options.namespace
        return name.removeprefix(f'/{team}') if team else name

    def _robot_of(self, node: str) -> str | None:
        name = self._without_team(node).strip('/').partition('/')[0]
        return name if name in self.scenario.robots else None

    def _show(self, recorder: Recorder, observer: RunObserver | CuboidObserver) -> None:
        from maasi_sim.run.progress import Status

        observer.news = False
        seconds = recorder.elapsed
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
        from maasi_sim.run.processes import stop

        recorder.finish()
        drivers = [
            plan.full_name
            for plan in self.plans
            if plan.package == 'maasi_drivers' or plan.executable == 'cuboid_planner_node'
        ]
        kept = self._clocks if self._is_followed(recorder) else set()
        others = [name for name in self.processes if name not in kept.union(drivers)]
        # Drivers stop their robots: the sim, or the robot, must still be there to hear it. One that
        # hangs does not, and may have a command on its way when it is killed: before and after.
        recorder.stop_robots(self.scenario.names())
        stubborn = stop([self.processes[name] for name in drivers])
        recorder.stop_robots(self.scenario.names())
        recorder.wait(_POLL)
        recorder.drain()
        stubborn += stop([self.processes[name] for name in others])
        recorder.drain()
        if stubborn:
            self.display.say(f'had to be killed: {", ".join(stubborn)}')

    def _is_followed(self, recorder: Recorder) -> bool:
        """Return whether another run needs the clock of this one, and may have it."""
        running = all(self.processes[name].running for name in self._clocks)
        follows = self.options.follow_clock or self.scenario.external_clock
        own = running and not (follows or self.options.lockstep)
        return bool(own and not self.interruption and recorder.followers())

    def _keep_clock(self, recorder: Recorder) -> None:
        """Let the time go on until nobody follows it any more."""
        teams = ', '.join(recorder.followers())
        self.display.say(f'the clock goes on for {teams} (Ctrl-C ends it)')
        while self._is_followed(recorder):
            recorder.wait(_FOLLOWERS_PERIOD)
            recorder.drain()

    def _report(
        self, ending: Ending, recorder: Recorder, observer: RunObserver | CuboidObserver
    ) -> int:
        """Write the report, say how it went, and return the exit code."""
        from maasi_sim.run.run_folder import store_report

        wall = 0.0
        if self._begun is not None and self._ended is not None:
            wall = self._ended - self._begun
        record = observer.record(ending.reason, recorder.elapsed, wall, self.events)
        stored = store_report(record, self.folder)
        self.display.say(stored.words)
        if ending.text:
            self.display.say(f'ended: {ending.text}')
        if ending.code == NODE_FAILED:
            self._show_logs()
        unwritten = self._unwritten + ([stored.problem] if stored.problem else [])
        for problem in unwritten:
            self.display.say(f'error: {problem}')
        place = 'nowhere'
        if stored.folder is not None:
            place = _short(stored.folder / 'report.json')
        self.display.say(f'report: {place}')
        code = ending.code
        if ending.reason == 'planner_done' and stored.report['missed'] == 0:
            code = DONE
        return NOT_WRITTEN if unwritten and code in (DONE, NOT_ALL_FOUND) else code

    def _show_logs(self) -> None:
        for process in self.processes.values():
            if process.name in self._failed:
                self.display.say(f'--- {_short(process.log)}\n{process.last_words()}')


def make_observer(
    name: str, scenario: AnyScenario, seed: int, types: Typestore
) -> RunObserver | CuboidObserver:
    """Return who gathers what the report of a scenario needs."""
    from maasi_sim.buildings.observer import CuboidObserver
    from maasi_sim.buildings.scenario import CuboidScenario
    from maasi_sim.run.observer import RunObserver

    if isinstance(scenario, CuboidScenario):
        return CuboidObserver(name, scenario, seed, types)
    return RunObserver(name, scenario, seed, types)


def _short(path: Path) -> str:
    """Return a path from here, if it is below."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)


if __name__ == '__main__':
    sys.exit(main())
