"""A run of a scenario in three stages: prepared, running, and ended."""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from maasi_filter.records import FoundTarget
from maasi_filter.wording import counted, number
from maasi_sim.run.bag import ENDING_TOPIC, BagError, BagWriter, load_types
from maasi_sim.run.cot import CotSender
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
from maasi_sim.run.log import RunEnd, RunLog
from maasi_sim.run.mission import Mission
from maasi_sim.run.missions import checked_mission, send_warning
from maasi_sim.run.processes import in_background, stop, wait_for_server
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.recorder_node import Recorder
from maasi_sim.run.report_files import store_report
from maasi_sim.run.run_folder import make_folder, write_text
from maasi_sim.run.run_options import Options, short
from maasi_sim.run.rviz_view import view_text
from maasi_sim.run.supervisor import Supervisor
from maasi_sim.run.targets.mission import TargetMission
from maasi_sim.run.topics import CLOCK
from maasi_sim.run.view.event_maker import EventMaker
from maasi_sim.run.view.live_view import RunPage
from maasi_sim.run.view.page_file import REPLAY
from maasi_sim.run.view.scene import scene_of
from maasi_sim.run.view.view_run import send_replay
from maasi_sim.scenario.external import external_topics
from maasi_sim.scenario.layering import ScenarioError, to_yaml
from maasi_sim.scenario.schema import RobotSettings

# Wall time between checks of processes and topics, during the start and afterwards [s].
_START_POLL, _POLL = 0.02, 0.05
# Longest wait for a publisher of another program, whose QoS may not match [s].
_CONNECTION_PATIENCE = 5.0
# Difference between a run's time and the wall time up to which its times are those of the day,
# relative to the wall time.
_PACE = 0.02
_START_PATIENCE = 10.0  # wall time between messages about missing nodes [s]


def execute(options: Options, interruption: Interruption) -> int:
    """Run a scenario and return the exit code; the page is served until its reader closes it."""
    display = ProgressDisplay()
    mission = checked_mission(options, display)
    # Teams whose robots are moved by another program share its clock.
    cot = _cot_sender(mission, options, display)
    shared = mission.scenario.external_clock and options.domain_id is not None
    with contextlib.ExitStack() as served:
        with Domain(options.domain_id, team=options.namespace, shared=shared) as domain:
            folder = prepare(mission, options)
            running = RunningRun(mission, options, interruption, display, folder, domain)
            running.cot = cot
            with contextlib.closing(running):
                if running.page is not None:
                    served.callback(running.page.close)
                ended = running.finish()
        code = ended.report()
        if running.page is not None and not interruption:
            with interruption.at_once():
                running.page.wait_for_reader(display.say)
        return code


def _cot_sender(
    mission: Mission[Any], options: Options, display: ProgressDisplay
) -> CotSender | None:
    """Return what sends the found targets of a run; ScenarioError: it cannot."""
    if options.cot is None:
        return None
    origin = mission.scenario.environment.origin
    if origin is None or not isinstance(mission, TargetMission):
        raise ScenarioError(
            f'--cot: read {options.cot}, allowed in searches for targets with environment.origin'
        )
    try:
        return CotSender(mission.name, options.cot, origin, display.warn)
    except ValueError as error:
        raise ScenarioError(str(error)) from None


def prepare(mission: Mission[Any], options: Options) -> Path:
    """Create the folder of the run and write its scenario and RViz view."""
    folder = make_folder(options.out)
    mission.prepare()
    write_text(folder / 'scenario.yaml', mission.scenario.text())
    write_text(folder / 'view.rviz', view_text(mission, options.namespace))
    return folder


class RunningRun:
    """A run whose nodes are started, recorded and watched."""

    def __init__(
        self,
        mission: Mission[Any],
        options: Options,
        interruption: Interruption,
        display: ProgressDisplay,
        folder: Path,
        domain: Domain,
    ) -> None:
        self.mission, self.options, self.interruption = mission, options, interruption
        self.display, self.folder, self.scenario = display, folder, mission.scenario
        self.cot: CotSender | None = None  # set before the run begins
        self.supervisor = Supervisor(mission, options, folder, display)
        self._processes = processes = list(self.supervisor.processes.values())
        os.environ.update(domain.environment(len(processes) + 1))
        display.say(
            f'{mission.name}: seed {self.scenario.seed}, {len(processes)} nodes in ROS '
            f'domain {domain.number}, results in {short(folder)}'
        )
        # Wall times at which all nodes were ready, and of the first step.
        self._complete: float | None = None
        self._begun: float | None = None
        with contextlib.ExitStack() as ends:
            ends.callback(self.display.close)
            ends.callback(stop, processes)
            # Ctrl-C ends the wait; the run reports it.
            with self.interruption.at_once():
                wait_for_server()
            # Nodes start while this process loads its modules.
            for process in () if self.interruption else processes:
                process.start()
            types = load_types()
            self.observer = mission.observer(types)
            self._bag: BagWriter | None = None
            if options.record:
                self._bag = BagWriter(folder / 'bag', types, self.scenario.record.images)
                ends.callback(self._close_bag)
            step = self.scenario.step
            self.recorder = Recorder(domain.number, self.observer, step, self._bag, options)
            ends.callback(self.recorder.close)
            self.supervisor.recorder = self.recorder
            if self._bag is not None:
                self._bag.write_scenario(self._facts(), {'seed': str(self.scenario.seed)})
            self.page = self._serve(domain.number)
            if self.page is not None:
                ends.callback(self.page.end)
                self.recorder.listener = self.page.put_message
            self.close = ends.pop_all().close

    def _facts(self) -> str:
        options = self.options
        facts = {
            'name': self.mission.name,
            'seed': self.scenario.seed,
            'command': options.command(self.scenario.seed),
            'lockstep': options.lockstep,
            'rate': options.rate,
            'namespace': options.namespace,
            'scenario': self.scenario.content(),
            'nodes': {
                plan.full_name: {
                    key: getattr(plan, key) for key in ('package', 'executable', 'parameters')
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
            scene = scene_of(self.mission.name, self.scenario)
            scene['command'] = self.options.command(self.scenario.seed)
            if self.options.record:
                scene['replay'] = short(self.folder / REPLAY)
            page = RunPage(scene, options, domain, self.options.namespace)
        except OSError as error:
            self.display.warn(f'cannot serve the page: {options.host}: {error.strerror or error}')
            return None
        page.announce(self.display.say, options.browser)
        return page

    def finish(self) -> 'EndedRun':
        """Follow the run to its end, stop its nodes, and close the recording."""
        options, recorder = self.options, self.recorder
        self._name_external_robots()
        ending = self._wait_until_ready() or self._follow()
        now = time.monotonic()
        wall_time = now - (self._begun or now)
        recorder.finish()
        unwritten = []
        if options.record and ending.code in (DONE, NOT_ALL_FOUND):
            patience = _CONNECTION_PATIENCE * (options.rate or 1.0)
            unwritten = recorder.gaps(self.scenario.external_clock, patience)
        for gap in unwritten:
            self.supervisor.note('recorder', 'gap', reason=gap)
        self.supervisor.stop()
        if self._bag is not None:
            # Closing the recording reports its errors.
            with contextlib.suppress(BagError):
                self._bag.write_text(ENDING_TOPIC, recorder.time, f'{ending.reason}\n{ending.text}')
        if self.cot is not None:
            self.display.say(self.cot.finish(self._found()))
            self.cot.close()
        if self.page is not None:
            self.page.put(EventMaker.end, ending.reason, ending.text)
        unwritten += self._close_bag()
        # The replay is written in parallel to the report, if the server of the nodes is running.
        ran = options.record and self._processes[0].pid is not None
        replay = in_background(send_replay, self.folder) if ran else iter(())
        began = self._time_of_day(recorder.elapsed, wall_time)
        end = RunEnd(ending.reason, recorder.elapsed, wall_time, self.supervisor.events, began)
        return EndedRun(self, ending, end, unwritten, replay)

    def _time_of_day(self, elapsed: float, wall_time: float) -> float | None:
        """Return the Unix time of the first step [s] if the run kept pace with the clock."""
        kept = abs(elapsed - wall_time) <= _PACE * max(wall_time, 100.0)
        return time.time() - wall_time if kept and not self.options.lockstep else None

    def _close_bag(self) -> list[str]:
        try:
            if self._bag is not None:
                self._bag.close()
        except BagError as error:
            return [str(error)]
        return []

    def _wait_until_ready(self) -> Ending | None:
        """Wait until every node is ready, the recorder last; return an ending if one is not."""
        begin, patience = time.monotonic(), _START_PATIENCE
        while (ending := self._turn()) is None and (lacks := self._lacks()):
            what = ', '.join(f'{name} {lack}' for name, lack in lacks.items())
            waited = time.monotonic() - begin
            if waited > self.scenario.limits.start:
                text = f'{what} after {self.scenario.limits.start:g} s (limits.start)'
                return Ending('not_ready', NODE_FAILED, text, lacks)
            if waited > patience:
                self.display.say(f'waiting: {what}')
                patience += _START_PATIENCE
        # Their executors run, even if no heartbeat has arrived yet.
        for node in self._processes:
            node.beat(time.monotonic())
        if ending is None:
            loose = self.recorder.unmatched()
            self.display.warn(
                *(
                    f'{topic}: a publisher cannot be recorded because its QoS does not match'
                    for topic in loose
                )
            )
            self.recorder.publish_ready()
            # This takes a while.
            news = in_background(send_warning, self.mission)
            threading.Thread(target=lambda: self.display.warn(*news), daemon=True).start()
        return ending

    def _lacks(self) -> dict[str, str]:
        recorder = self.recorder
        # Nodes report last: all topics of a node that has reported are discovered.
        ready = set(recorder.receive_ready())
        recorder.discover()
        nodes = list(self.supervisor.processes)
        late = [name for name in nodes if name not in ready]
        done, total = len(nodes) - len(late), len(nodes)
        self.display.update(f'starting: {done} of {total} nodes ready', quiet=True)
        if self.page is not None:
            self.page.starting(done, total)
        if late:
            return dict.fromkeys(late, 'is not ready')
        self._complete = self._complete or time.monotonic()
        lacks = dict.fromkeys(recorder.unmatched(), 'has an unconnected publisher')
        if not recorder.subscribed(CLOCK):
            # That of another program may be discovered after all nodes.
            lacks[CLOCK] = 'has no publisher'
        if lacks and time.monotonic() - self._complete <= _CONNECTION_PATIENCE:
            return lacks
        return dict.fromkeys(recorder.unanswered(nodes), 'has not discovered the recorder')

    def _name_external_robots(self) -> None:
        team = self.options.namespace
        where = f' --namespace {team}' if team else ''
        domain = self.recorder.context.get_domain_id()
        for name, robot in self.scenario.robots.items():
            if isinstance(robot, RobotSettings):
                for topic in external_topics(f'{team}/{name}'.strip('/'), robot):
                    self.display.say(f'{name}: another program is to {topic}')
            if robot.external and robot.link != 'topics':
                self.display.say(
                    f'{name} is external; to let it take off: '
                    f'ROS_DOMAIN_ID={domain} ./scripts/team_command arm {name}{where}'
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
            self.display.warn(*recorder.pop_complaints())
            if self.cot is not None:
                self.cot.update(self._found())
            if self.display.due or self.observer.news:
                self._show()
        return ending

    def _turn(self) -> Ending | None:
        recorder, observer, limit = self.recorder, self.observer, self.scenario.limits.time
        time.sleep(_POLL if self.supervisor.running else _START_POLL)
        recorder.drain(round(limit * 1e9))
        recorder.arm(name for name, robot in self.scenario.robots.items() if robot.takes_off)
        if self.interruption:
            return Ending('interrupted', INTERRUPTED)
        if failure := self.supervisor.check():
            return failure
        if observer.completed is not None:
            return Ending('all_found', DONE)
        if self._bag is not None and self._bag.failed:
            return Ending('not_recorded', NOT_WRITTEN)
        if observer.settled is not None:
            meant = self.scenario.stop == 'planner_done'
            return end_of_planners(observer.settled, self.explored, meant)
        if recorder.elapsed >= limit:
            text = f'time limit of {number(limit)} s reached: raise limits.time or --time-limit'
            return Ending('time_limit', NOT_ALL_FOUND, text)
        return None

    @property
    def explored(self) -> float:
        """Explored share, from the planner that reports the largest."""
        return max(self.observer.explored, self.recorder.explored)

    def _found(self) -> list[FoundTarget]:
        log = self.observer.log
        return log.found_targets if isinstance(log, RunLog) else []

    def _show(self) -> None:
        observer = self.observer
        observer.news = False
        seconds = self.recorder.elapsed
        wall = time.monotonic() - (self._begun or time.monotonic())
        targets = f' of {observer.total}' if observer.total else ''
        targets += f' ({observer.false_found} false)' if observer.false_found else ''
        text = (
            f'{seconds:7.1f} s   {counted(observer.measurements, "measurement"):>16}   '
            f'{observer.found} {self.mission.found_word}{targets}   '
            f'{100.0 * self.explored:3.0f} % explored'
        )
        if seconds > 0.0 and wall > 0.0:
            text += f'   {number(seconds / wall)} x real time'
        self.display.show(text, observer.found)


@dataclass(frozen=True)
class EndedRun:
    """A run whose nodes have ended, ready to be reported."""

    run: RunningRun
    ending: Ending
    end: RunEnd
    unwritten: list[str]  #: errors of writing
    replay: Iterator[Any]  # progress of the process that writes the replay, then its error

    def report(self) -> int:
        """Write report and replay, print the summary, and return the exit code."""
        run, ending = self.run, self.ending
        say = run.display.say
        report: dict[str, Any] = {}
        place, problem = None, ''
        with run.interruption.at_once(signal.SIGINT):
            say('writing report and replay (Ctrl-C skips each one)')
            record = run.observer.record(self.end)
            report, place, problem = store_report(run.mission, record, run.folder)
        say(run.mission.summary(report) if report else 'report: skipped')
        if ending.text:
            say(f'ended: {ending.text}')
        for name in ending.nodes:
            if process := run.supervisor.processes.get(name):
                say(f'--- {short(process.log)}\n{process.last_words()}')
        unwritten = [*self.unwritten, *filter(None, [problem])]
        for text in unwritten:
            say(f'error: {text}')
        if report:
            say(f'report: {"not written" if place is None else short(place / "report.json")}')
        if run.options.record:
            with run.interruption.at_once(signal.SIGINT):
                self._leave_replay()
        run.display.close()
        code = ending.code
        none_missed = ending.reason == 'planner_done' and report.get('missed') == 0
        if none_missed and run.explored >= LEAST_EXPLORED:
            code = DONE
        return NOT_WRITTEN if unwritten and code in (DONE, NOT_ALL_FOUND) else code

    def _leave_replay(self) -> None:
        display, problem = self.run.display, 'it was not written'
        for news in self.replay:
            if isinstance(news, float):
                display.share(f'writing {REPLAY}', news)
            else:
                problem = news
        if problem:
            display.warn(f'no {REPLAY}: {problem}')
        else:
            display.say(f'replay: {short(self.run.folder / REPLAY)}', instead=True)
