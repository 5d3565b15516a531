"""One run of a scenario: its nodes are started, monitored and stopped, and reported on."""

import contextlib
import os
import signal
import threading
import time
from typing import Any

from maasi_sim.run.bag import ENDING_TOPIC, BagError, BagWriter, load_types
from maasi_sim.run.domain import Domain
from maasi_sim.run.ending import (
    DONE,
    INTERRUPTED,
    LEAST_EXPLORED,
    NODE_FAILED,
    NOT_ALL_FOUND,
    NOT_WRITTEN,
    Ending,
    Interruption,
    end_of_planners,
)
from maasi_sim.run.mission import RunEnd
from maasi_sim.run.missions import checked_mission, send_warning
from maasi_sim.run.processes import beside, stop, wait_for_server
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.recorder_node import Recorder
from maasi_sim.run.report_files import store_report
from maasi_sim.run.run_folder import make_folder, write_text
from maasi_sim.run.run_options import Options, short
from maasi_sim.run.rviz_view import view_text
from maasi_sim.run.supervisor import Supervisor
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.live_view import RunPage
from maasi_sim.run.view.page_file import REPLAY
from maasi_sim.run.view.scene import scene_of
from maasi_sim.run.view.view_run import send_replay
from maasi_sim.scenario.layering import ScenarioError, to_yaml

# Between two checks of processes and topics; while the nodes start, and while they run [s].
_START_POLL, _POLL = 0.02, 0.05
# Longest wait for a publisher of others, which may not fit the recorder [s].
_CONNECTION_PATIENCE = 5.0
_START_PATIENCE = 10.0  # wall time between two messages about missing nodes [s]


class ScenarioRun:
    """One run of a scenario, from the file to the report; ends when `interruption` is true."""

    def __init__(self, options: Options, interruption: Interruption) -> None:
        self.options, self.interruption = options, interruption
        self.display = ProgressDisplay()
        self.mission, doubts = checked_mission(options.scenario, options.overrides())
        forecast = self.mission.preflight()
        for line in forecast.lines:
            self.display.say(line)
        self._warn(*doubts, *forecast.warnings)
        # A node in the namespace of a robot belongs to that robot.
        if options.namespace.rpartition('/')[2] in self.mission.scenario.names():
            raise ScenarioError(
                f"--namespace: read '{options.namespace}', allowed is a name that is none of "
                'a robot of the scenario'
            )
        self._bag: BagWriter | None = None
        self._page: RunPage | None = None
        self.unwritten: list[str] = []  #: errors of writing
        # Wall time when all nodes were ready, and of the first step.
        self._complete: float | None = None
        self._begun: float | None = None

    def execute(self) -> int:
        """Run it and return the exit code; in a terminal its page stays until it is read."""
        with contextlib.ExitStack() as served:
            code = self._execute(served)
            if self._page is not None and not self.interruption:
                with self.interruption.at_once():
                    self._page.wait_for_reader(self.display.say)
            return code

    def _execute(self, served: contextlib.ExitStack) -> int:
        options = self.options
        number, team = options.domain_id, options.namespace
        # Teams of robots that another program moves have its clock in common.
        shared = self.mission.scenario.external_clock and number is not None
        with Domain(number, team=team, shared=shared) as domain, contextlib.ExitStack() as ends:
            self.folder = make_folder(options.out)
            self.mission.prepare()
            self._scenario = self.mission.scenario
            self._limits = self._scenario.limits
            write_text(self.folder / 'scenario.yaml', self._scenario.text())
            write_text(self.folder / 'view.rviz', view_text(self.mission, team))
            ends.callback(self.display.close)
            # Nodes start while this process makes what is its own.
            self.supervisor = Supervisor(self.mission, options, self.folder, self.display)
            processes = list(self.supervisor.processes.values())
            os.environ.update(domain.environment(len(processes) + 1))
            self.display.say(
                f'{self.mission.name}: seed {self._scenario.seed}, {len(processes)} nodes in ROS '
                f'domain {domain.number}, results in {short(self.folder)}'
            )
            ends.callback(stop, processes)
            types = load_types()
            # Ctrl-C ends the wait at once; the run reports it.
            with self.interruption.at_once():
                wait_for_server()
            if not self.interruption:
                for process in processes:
                    process.start()
            self.observer = self.mission.observer(types)
            if options.record:
                self._bag = BagWriter(self.folder / 'bag', types, self._scenario.record.images)
                ends.callback(self._close_bag)
            step = self._scenario.step
            self.recorder = Recorder(
                domain.number, self.observer, step, self._bag, team, options.lockstep
            )
            ends.callback(self.recorder.close)
            self.supervisor.recorder = self.recorder
            if self._bag is not None:
                self._bag.write_scenario(self._facts(), {'seed': str(self._scenario.seed)})
            self._page = self._serve(domain.number)
            if self._page is not None:
                served.callback(self._page.close)
                ends.callback(self._page.end)
                self.recorder.listener = self._page.put_message
            self._monitor()
            self._note_ending()
            self._close_bag()
            # Beside the report; never before the server of the nodes is there.
            ran = options.record and processes[0].pid is not None
            self._replay = beside(send_replay, self.folder) if ran else iter(())
            ends.close()
            return self._report()

    def _facts(self) -> str:
        options = self.options
        facts = {
            'name': self.mission.name,
            'seed': self._scenario.seed,
            'command': options.command(self._scenario.seed),
            'lockstep': options.lockstep,
            'rate': options.rate,
            'namespace': options.namespace,
            'scenario': self._scenario.content(),
            'nodes': {
                plan.full_name: {
                    'package': plan.package,
                    'executable': plan.executable,
                    'parameters': plan.parameters,
                }
                for plan in self.supervisor.plans.values()
            },
        }
        return to_yaml(facts)

    def _serve(self, domain: int) -> RunPage | None:
        options = self.options.view
        if options is None:
            return None
        try:
            scene = scene_of(self.mission.name, self._scenario)
            scene['command'] = self.options.command(self._scenario.seed)
            if self.options.record:
                scene['replay'] = short(self.folder / REPLAY)
            page = RunPage(scene, options, domain, self.options.namespace)
        except OSError as error:
            self._warn(f'no view: {options.host}: {error.strerror or error}')
            return None
        page.announce(self.display.say, options.browser)
        return page

    def _note_ending(self) -> None:
        reason, text = self.ending.reason, self.ending.text
        if self._bag is not None:
            # An error is reported where the recording is closed.
            with contextlib.suppress(BagError):
                self._bag.write_text(ENDING_TOPIC, self.recorder.time, f'{reason}\n{text}')
        if self._page is not None:
            self._page.put(EventMaker.end, reason, text)

    def _warn(self, *texts: str) -> None:
        for text in filter(None, texts):
            self.display.say(f'warning: {text}')

    def _monitor(self) -> None:
        self._name_external_robots()
        self.ending = self._wait_until_ready() or self._follow()
        now = time.monotonic()
        self.wall_time = now - (self._begun or now)
        self.recorder.finish()
        self._check_recording()
        self.supervisor.stop()

    def _wait_until_ready(self) -> Ending | None:
        """Wait until every node is ready, the recorder last; return an ending if one is not."""
        nodes = list(self.supervisor.processes.values())
        expected = [node.name for node in nodes]
        begin, patience = time.monotonic(), _START_PATIENCE
        while (ending := self._turn()) is None and (lacks := self._lacks(expected)):
            what = ', '.join(f'{name} {lack}' for name, lack in lacks.items())
            waited = time.monotonic() - begin
            if waited > self._limits.start:
                text = f'{what} after {self._limits.start:g} s'
                return Ending('not_ready', NODE_FAILED, text, lacks)
            if waited > patience:
                self.display.say(f'waiting: {what}')
                patience += _START_PATIENCE
        # Their executors run, even if no heartbeat has arrived so far.
        for node in nodes:
            node.beat(time.monotonic())
        if ending is None:
            loose = self.recorder.unmatched()
            self._warn(*(f'{topic} has a publisher that is not recorded' for topic in loose))
            self.recorder.publish_ready()
            # It takes a while.
            news = beside(send_warning, self.mission)
            threading.Thread(target=lambda: self._warn(*news), daemon=True).start()
        return ending

    def _lacks(self, expected: list[str]) -> dict[str, str]:
        """Return the nodes, else the topics, else the nodes again that lack something, and what."""
        recorder = self.recorder
        # Nodes report last, so that all topics of one that has reported are discovered.
        ready = set(recorder.take_ready())
        recorder.discover()
        late = [name for name in expected if name not in ready]
        nodes = self.supervisor.processes
        done = len(ready & nodes.keys())
        self.display.update(f'starting: {done} of {len(nodes)} nodes are ready', quiet=True)
        if self._page is not None:
            self._page.starting(done, len(nodes))
        if late:
            return dict.fromkeys(late, 'is not ready')
        self._complete = self._complete or time.monotonic()
        unmatched = recorder.unmatched()
        if unmatched and time.monotonic() - self._complete <= _CONNECTION_PATIENCE:
            return dict.fromkeys(unmatched, 'has a publisher that is not connected')
        return dict.fromkeys(recorder.unanswered(expected), 'does not know the recorder')

    def _name_external_robots(self) -> None:
        team = self.options.namespace
        where = f' --namespace {team}' if team else ''
        domain = self.recorder.context.get_domain_id()
        for name, robot in self._scenario.robots.items():
            if robot.external and robot.link != 'topics':
                self.display.say(
                    f'{name} is external: it takes off when you call its service arm '
                    f'(team_command arm {name}{where}, with ROS_DOMAIN_ID={domain})'
                )

    def _follow(self) -> Ending:
        recorder, self.supervisor.running = self.recorder, True
        last: tuple[int | None, int] = (None, 0)
        while (ending := self._turn()) is None:
            now = (recorder.step, recorder.time)
            if now != last:
                last = now
                self._begun = self._begun or time.monotonic()
                if self.options.lockstep and recorder.step is not None:
                    recorder.publish_done(recorder.step)
            self._warn(*recorder.take_complaints())
            if self.display.due or self.observer.news:
                self._show()
        return ending

    def _turn(self) -> Ending | None:
        recorder, observer, limit = self.recorder, self.observer, self._limits.time
        time.sleep(_POLL if self.supervisor.running else _START_POLL)
        recorder.drain(round(limit * 1e9))
        recorder.arm(name for name, robot in self._scenario.robots.items() if robot.takes_off)
        if self.interruption:
            return Ending('interrupted', INTERRUPTED)
        if failure := self.supervisor.check():
            return failure
        if observer.completed is not None:
            return Ending('all_found', DONE)
        if self._bag is not None and self._bag.failed:
            return Ending('not_recorded', NOT_WRITTEN)
        if observer.settled is not None:
            meant = self._scenario.stop == 'planner_done'
            return end_of_planners(observer.settled, self._explored, meant)
        if recorder.elapsed >= limit:
            return Ending('time_limit', NOT_ALL_FOUND)
        return None

    @property
    def _explored(self) -> float:
        """Share that is explored, by the planner that reports most of it."""
        return max(self.observer.explored, self.recorder.explored)

    def _show(self) -> None:
        observer = self.observer
        observer.news = False
        seconds = self.recorder.elapsed
        wall = time.monotonic() - (self._begun or time.monotonic())
        targets = f' of {observer.total}' if observer.total else ''
        targets += f' ({observer.false_found} false)' if observer.false_found else ''
        self.display.show(
            f'{seconds:7.1f} s   {observer.measurements:4d} measurements   '
            f'{observer.found} {self.mission.found_word}{targets}   '
            f'{100.0 * self._explored:3.0f} % explored   '
            f'{seconds / wall if wall > 0.0 else 0.0:.1f} x real time',
            observer.found,
        )

    def _check_recording(self) -> None:
        if not self.options.record or self.ending.code not in (DONE, NOT_ALL_FOUND):
            return
        patience = _CONNECTION_PATIENCE * (self.options.rate or 1.0)
        for gap in self.recorder.gaps(self._scenario.external_clock, patience):
            self.unwritten.append(gap)
            self.supervisor.note('recorder', 'gap', reason=gap)

    def _close_bag(self) -> None:
        try:
            if self._bag is not None:
                self._bag.close()
        except BagError as error:
            self.unwritten.append(str(error))

    def _report(self) -> int:
        ending = self.ending
        elapsed, events = self.recorder.elapsed, self.supervisor.events
        end = RunEnd(ending.reason, elapsed, self.wall_time, events)
        report: dict[str, Any] = {}
        place, problem = None, ''
        with self.interruption.at_once(signal.SIGINT):
            self.display.say('writing report and replay (Ctrl-C skips each)')
            record = self.observer.record(end)
            report, place, problem = store_report(self.mission, record, self.folder)
        self.display.say(self.mission.summary(report) if report else 'report: skipped')
        if ending.text:
            self.display.say(f'ended: {ending.text}')
        for name in ending.nodes:
            if process := self.supervisor.processes.get(name):
                self.display.say(f'--- {short(process.log)}\n{process.last_words()}')
        if problem:
            self.unwritten.append(problem)
        for text in self.unwritten:
            self.display.say(f'error: {text}')
        if report:
            where = 'nowhere' if place is None else short(place / 'report.json')
            self.display.say(f'report: {where}')
        with self.interruption.at_once(signal.SIGINT):
            self._leave_replay()
        self.display.close()
        code = ending.code
        none_missed = ending.reason == 'planner_done' and report.get('missed') == 0
        if none_missed and self._explored >= LEAST_EXPLORED:
            code = DONE
        return NOT_WRITTEN if self.unwritten and code in (DONE, NOT_ALL_FOUND) else code

    def _leave_replay(self) -> None:
        if not self.options.record:
            return
        problem = 'it was not written'
        for news in self._replay:
            if isinstance(news, float):
                self.display.share(REPLAY, news)
            else:
                problem = news
        if problem:
            self._warn(f'no {REPLAY}: {problem}')
        else:
            self.display.say(f'replay: {short(self.folder / REPLAY)}', instead=True)
