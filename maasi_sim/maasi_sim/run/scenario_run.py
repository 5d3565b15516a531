"""One run of a scenario: its nodes are started, monitored and stopped, and reported on."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any

from maasi_sim.run.bag import BagError, BagWriter, load_types
from maasi_sim.run.domain import Domain
from maasi_sim.run.ending import (
    DONE,
    INTERRUPTED,
    NODE_FAILED,
    NOT_ALL_FOUND,
    NOT_WRITTEN,
    Ending,
    Interruption,
)
from maasi_sim.run.missions import load_mission
from maasi_sim.run.node_plan import (
    NodePlan,
    RunSettings,
    in_team,
    with_followed_clock,
    with_saved_state,
)
from maasi_sim.run.node_server import wait_for_server
from maasi_sim.run.processes import stop
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.recorder_node import Recorder
from maasi_sim.run.report_files import StoredReport, store_report
from maasi_sim.run.run_folder import ResultsError, make_folder, write_text
from maasi_sim.run.run_options import Options
from maasi_sim.run.run_record import RunEnd
from maasi_sim.run.rviz_view import view_text
from maasi_sim.run.supervisor import Supervisor
from maasi_sim.run.view.live_view import RunPage
from maasi_sim.run.view.messages import read_events
from maasi_sim.run.view.page_file import REPLAY, write_replay
from maasi_sim.run.view.scene import scene_of
from maasi_sim.scenario.layering import Key, ScenarioError, ScenarioWarning, to_yaml

# Bytes that may wait for the disk when the recorder reports a step done.
_BACKLOG = 8 * 2**20
# Longest wall time between two checks of processes and topics [s].
_POLL = 0.02
# Between two checks for runs that follow the clock [s].
_FOLLOWERS_PERIOD = 0.5
# Longest wait for a publisher of others, which may not fit the recorder [s].
_CONNECTION_PATIENCE = 5.0
# Between two calls to take off: the first may come before a driver is active [s].
_ARMING_PERIOD = 2.0
# Wall time between two messages about missing nodes [s].
_START_PATIENCE = 10.0


class ScenarioRun:
    """One run of a scenario, from the file to the report; ends when `interruption` is true."""

    supervisor: Supervisor
    recorder: Recorder
    ending: Ending

    def __init__(self, options: Options, interruption: Interruption) -> None:
        self.options = options
        self.interruption = interruption
        given: dict[str, tuple[Key, Any]] = {
            '--planner': (('planner', 'name'), options.planner),
            '--time-limit': (('limits', 'time'), options.time_limit),
            '--seed': (('seed',), options.seed),
        }
        overrides = {name: item for name, item in given.items() if item[1] is not None}
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter('always', ScenarioWarning)
            self.mission = load_mission(options.scenario, overrides)
        self._doubts = [str(item.message) for item in caught]
        # A node in the namespace of a robot belongs to that robot.
        if options.namespace.rpartition('/')[2] in self.mission.scenario.names():
            raise ScenarioError(
                f"--namespace: read '{options.namespace}', allowed is a name that is none of "
                'a robot of the scenario'
            )
        self.display = ProgressDisplay()
        self._bag: BagWriter | None = None
        #: Errors of writing.
        self.unwritten: list[str] = []
        # Planners whose present error was printed.
        self._told: set[str] = set()
        self._armed_at = 0.0
        # Wall time of the first step and of the end.
        self._begun: float | None = None
        self._ended: float | None = None

    def execute(self) -> int:
        """Run it and return the exit code."""
        options = self.options
        with Domain(
            options.domain_id, team=options.namespace, shared=options.follow_clock
        ) as domain:
            self.folder = make_folder(options.out)
            os.environ.update(domain.environment())
            self.mission.prepare()
            self._scenario = self.mission.scenario
            self._limits = self._scenario.limits
            self.supervisor = Supervisor(
                self._plan(), self.mission.scenario, options, self.folder, self.display
            )
            self.display.say(
                f'{self.mission.name}: seed {self.mission.scenario.seed}, '
                f'{len(self.supervisor.processes)} nodes in ROS domain {domain.number}, results in '
                f'{short(self.folder)}'
            )
            for text in self._doubts:
                self.display.say(f'warning: {text}')
            return self._execute(domain)

    def _plan(self) -> list[NodePlan]:
        """Write the scenario with all layers, and return its nodes."""
        options, scenario = self.options, self._scenario
        file = self.folder / 'scenario.yaml'
        write_text(file, scenario.text())
        write_text(self.folder / 'view.rviz', view_text(self.mission, options.namespace))
        run = RunSettings(scenario.seed, options.lockstep, options.rate, recorder=True, file=file)
        plans = [in_team(plan, options.namespace) for plan in self.mission.plan_nodes(run)]
        if options.follow_clock:
            plans = [with_followed_clock(plan) for plan in plans]
        if scenario.on_exit == 'respawn':
            plans = [with_saved_state(plan, self.folder / 'state') for plan in plans]
        return plans

    def _execute(self, domain: Domain) -> int:
        with contextlib.ExitStack() as ends:
            ends.callback(self.display.close)
            page = self._page(domain.number)
            if page is not None:
                ends.callback(page.end)
            types = load_types()
            self.observer = self.mission.observer(types)
            if self.options.record:
                self._bag = BagWriter(self.folder / 'bag', types, self._scenario.record.images)
                ends.callback(self._close_bag)
                self._bag.write_scenario(self._facts(), {'seed': str(self._scenario.seed)})
            step, team = self._scenario.step, self.options.namespace
            self.recorder = Recorder(domain.number, self.observer, step, self._bag, team)
            ends.callback(self.recorder.close)
            self.recorder.listener = None if page is None else page.put_message
            ends.callback(stop, list(self.supervisor.processes.values()))
            # Ctrl-C ends the wait at once; the run reports it.
            with self.interruption.at_once():
                wait_for_server()
            if not self.interruption:
                self.supervisor.start()
            self._monitor()
            if self.is_followed:
                self._close_bag()
                code = self._report()
                self._keep_clock()
                return code
        return self._report()

    def _close_bag(self) -> None:
        try:
            if self._bag is not None:
                self._bag.close()
        except BagError as error:
            self.unwritten.append(str(error))

    def _monitor(self) -> None:
        """Monitor the run from the start to the end of its nodes."""
        ending = self._wait_until_ready()
        threading.Thread(target=self._warn, daemon=True).start()
        self.ending = ending or self._follow()
        self._ended = time.monotonic()
        self._check_recording()
        self.recorder.finish()
        self.supervisor.stop(self.recorder, self.is_followed, _POLL)

    def _let_take_off(self) -> None:
        """Let simulated robots take off whose drivers do not take part yet."""
        if time.monotonic() - self._armed_at < _ARMING_PERIOD:
            return
        self._armed_at = time.monotonic()
        ready = set(map(self.supervisor.without_team, self.recorder.ready))
        names = [name for name, robot in self._scenario.robots.items() if robot.takes_off]
        self.recorder.arm([name for name in names if f'/{name}/driver' not in ready])

    def _check_recording(self) -> None:
        """Note which topics with a message at each step lack a recording of their beginning."""
        recorder, options = self.recorder, self.options
        if not options.record or self.ending.code not in (DONE, NOT_ALL_FOUND):
            return
        follows = options.follow_clock or self._scenario.external_clock
        for gap in recorder.gaps(follows, _CONNECTION_PATIENCE * (options.rate or 1.0)):
            self.unwritten.append(gap)
            self.supervisor.events.append(
                {'time': recorder.elapsed, 'node': 'recorder', 'event': 'gap', 'reason': gap}
            )

    @property
    def is_followed(self) -> bool:
        """Whether another run follows the clock of this one."""
        follows = self.options.follow_clock or self._scenario.external_clock
        if follows or self.options.lockstep or self.interruption:
            return False
        supervisor = self.supervisor
        running = all(supervisor.processes[name].running for name in supervisor.clocks)
        return running and bool(self.recorder.followers())

    def _keep_clock(self) -> None:
        """Keep the simulation running until no other run follows its clock."""
        teams = ', '.join(self.recorder.followers())
        self.display.say(f'the clock goes on for {teams} (Ctrl-C ends it)')
        while self.is_followed:
            self.recorder.wait(_FOLLOWERS_PERIOD)
            self.recorder.drain()

    def _facts(self) -> str:
        """Return the data for a replay, as YAML."""
        options = self.options
        facts = {
            'name': self.mission.name,
            'seed': self._scenario.seed,
            'lockstep': options.lockstep,
            'rate': options.rate,
            'namespace': options.namespace,
            'follow_clock': options.follow_clock,
            'scenario': self._scenario.content(),
            'nodes': {
                self.supervisor.without_team(plan.full_name): {
                    'package': plan.package,
                    'executable': plan.executable,
                    'parameters': plan.parameters,
                }
                for plan in self.supervisor.plans
            },
        }
        return to_yaml(facts)

    def _warn(self) -> None:
        warning = self.mission.warning()
        if warning:
            self.display.say(f'warning: {warning}')

    def _wait_until_ready(self) -> Ending | None:
        """Wait until every node is ready, the recorder last; return an ending if one is not."""
        recorder, supervisor = self.recorder, self.supervisor
        begin = time.monotonic()
        patience = _START_PATIENCE
        self._name_external_robots()
        expected = [plan.full_name for plan in supervisor.plans if plan.says_ready]
        complete: float | None = None
        while True:
            ending = self._check()
            if ending is not None:
                return ending
            # Nodes report last, so that all topics of one that has reported are discovered.
            ready = recorder.take_ready()
            recorder.discover()
            # Messages of starting nodes are recorded as they arrive.
            recorder.drain()
            self._let_take_off()
            late = [name for name in expected if name not in ready]
            what = [f'{name} is not ready' for name in late]
            if not late:
                complete = complete or time.monotonic()
                unmatched = recorder.unmatched()
                what = [f'{topic} has a publisher that is not connected' for topic in unmatched]
                if not unmatched or time.monotonic() - complete > _CONNECTION_PATIENCE:
                    late = recorder.unanswered(expected)
                    if not late:
                        break
                    what = [f'{name} does not know the recorder' for name in late]
            waited = time.monotonic() - begin
            if waited > self._limits.start:
                supervisor.failed.update(late)
                text = f'{", ".join(what)} after {self._limits.start:g} s'
                return Ending('not_ready', NODE_FAILED, text)
            if waited > patience:
                self.display.say(f'waiting: {", ".join(what)}')
                patience += _START_PATIENCE
            recorder.wait(_POLL)
        for complaint in recorder.complaints:
            self.display.say(f'warning: {complaint}')
        for topic in unmatched:
            self.display.say(f'warning: {topic} has a publisher that is not recorded')
        # Their executors run, even if no heartbeat has arrived so far.
        for name in expected:
            supervisor.watch.beat(name, time.monotonic())
        recorder.publish_ready()
        return None

    def _name_external_robots(self) -> None:
        team = self.options.namespace
        where = f' --namespace {team}' if team else ''
        domain = self.recorder.context.get_domain_id()
        for name, robot in self._scenario.robots.items():
            if robot.external and robot.link != 'topics':
                self.display.say(
                    f'{name} is external: it takes off when you call its service arm '
                    f'(search_command arm --robot {name}{where}, with ROS_DOMAIN_ID={domain})'
                )

    def _follow(self) -> Ending:
        """Monitor the run until it ends, and return its ending."""
        recorder, supervisor = self.recorder, self.supervisor
        limit = round(self._limits.time * 1e9)
        moved = time.monotonic()
        last: tuple[int | None, int] = (None, 0)
        while True:
            recorder.wait(_POLL)
            recorder.drain(limit)
            self._let_take_off()
            ending = self._check() or self._goal()
            if ending is not None:
                return ending
            now = (recorder.step, recorder.time)
            if now != last:
                last, moved = now, time.monotonic()
                self._begun = self._begun or moved
                supervisor.running = True
                self._finish_step()
            elif supervisor.restarting:
                # A restarted node may have to compile: `limits.start` applies.
                moved = time.monotonic()
            elif time.monotonic() - moved > self._limits.silence:
                if self.options.follow_clock:
                    return Ending(
                        'clock_stopped',
                        NODE_FAILED,
                        '/clock, which this run follows, stands still for '
                        f'{self._limits.silence:g} s',
                    )
                return supervisor.standstill(recorder)
            for name in recorder.faults.keys() - self._told:
                self.display.say(f'warning: {name}: {recorder.faults[name]}')
            self._told = set(recorder.faults)
            if self.display.due or self.observer.news:
                self._show()

    def _finish_step(self) -> None:
        """Report that the recorder is done with a step, once the disk keeps up."""
        if self._bag is not None:
            with contextlib.suppress(BagError):
                self._bag.wait(_BACKLOG)
        if self.options.lockstep and self.recorder.step is not None:
            self.recorder.publish_done(self.recorder.step)

    def _check(self) -> Ending | None:
        """Return an ending if the run was interrupted or a node has failed."""
        if self.interruption:
            return Ending('interrupted', INTERRUPTED)
        return self.supervisor.check(self.recorder)

    def _goal(self) -> Ending | None:
        """Return the ending that the scenario defines, if it is reached."""
        observer = self.observer
        if observer.completed is not None:
            return Ending('all_found', DONE)
        if self._bag is not None and self._bag.failed:
            return Ending('not_recorded', NOT_WRITTEN)
        if observer.settled is not None:
            meant = self._scenario.stop == 'planner_done'
            return Ending('planner_done', DONE if meant else NOT_ALL_FOUND, observer.settled)
        if self.recorder.elapsed >= self._limits.time:
            return Ending('time_limit', NOT_ALL_FOUND)
        return None

    def _show(self) -> None:
        observer = self.observer
        observer.news = False
        seconds = self.recorder.elapsed
        wall = time.monotonic() - (self._begun or time.monotonic())
        targets = f' of {observer.total}' if observer.total else ''
        explored = max(observer.explored, self.recorder.explored)
        self.display.show(
            f'{seconds:7.1f} s   {observer.measurements:4d} measurements   '
            f'{observer.found} {self.mission.found_word}{targets}   '
            f'{100.0 * explored:3.0f} % explored   '
            f'{seconds / wall if wall > 0.0 else 0.0:.1f} x real time',
            observer.found,
        )

    def _report(self) -> int:
        """Write the report, print a summary, and return the exit code."""
        ending = self.ending
        wall_time = 0.0 if self._begun is None or self._ended is None else self._ended - self._begun
        end = RunEnd(ending.reason, self.recorder.elapsed, wall_time, self.supervisor.events)
        stored = StoredReport({}, 'report: skipped', None)
        with self.interruption.at_once(signal.SIGINT):
            self.display.say('writing report and replay (Ctrl-C skips each)')
            stored = store_report(self.mission, self.observer.record(end), self.folder)
        self.display.say(stored.words)
        if ending.text:
            self.display.say(f'ended: {ending.text}')
        if ending.code == NODE_FAILED:
            for name, process in self.supervisor.processes.items():
                if name in self.supervisor.failed:
                    self.display.say(f'--- {short(process.log)}\n{process.last_words()}')
        unwritten = self.unwritten + ([stored.problem] if stored.problem else [])
        for problem in unwritten:
            self.display.say(f'error: {problem}')
        if stored.report:
            place = 'nowhere' if stored.folder is None else short(stored.folder / 'report.json')
            self.display.say(f'report: {place}')
        with self.interruption.at_once(signal.SIGINT):
            self._leave_replay()
        self.display.close()
        code = ending.code
        if ending.reason == 'planner_done' and stored.report.get('missed') == 0:
            code = DONE
        return NOT_WRITTEN if unwritten and code in (DONE, NOT_ALL_FOUND) else code

    def _page(self, domain: int) -> RunPage | None:
        """Serve the page of the run, if it is asked for; an error does not end the run."""
        options = self.options.view
        if options is None:
            return None
        try:
            scene = scene_of(self.mission.name, self.mission.scenario)
            page = RunPage(scene, options, domain, self.options.namespace)
        except OSError as error:
            self.display.say(f'warning: no view: {options.host}: {error.strerror or error}')
            return None
        page.announce(self.display.say)
        return page

    def _leave_replay(self) -> None:
        """Write the page that shows the run, from its recording."""
        if not self.options.record:
            return
        file = self.folder / REPLAY
        try:
            write_replay(read_events(self.folder, partial(self.display.share, REPLAY)), file)
        except (BagError, ResultsError) as error:
            self.display.say(f'warning: no {REPLAY}: {error}')
        else:
            self.display.say(f'replay: {short(file)}')


def short(path: Path) -> str:
    """Return a path relative to the working directory, if it is below."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
