"""One run of a scenario, from the file to the report."""

from __future__ import annotations

import os
import signal
import warnings
from functools import partial
from pathlib import Path
from typing import Any

from maasi_sim.missions import load_mission
from maasi_sim.run.bag import BagError
from maasi_sim.run.domain import Domain
from maasi_sim.run.ending import DONE, NODE_FAILED, NOT_ALL_FOUND, NOT_WRITTEN, Interruption
from maasi_sim.run.node_plan import (
    NodePlan,
    RunSettings,
    in_team,
    with_followed_clock,
    with_saved_state,
)
from maasi_sim.run.node_server import wait_for_server
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.report_files import StoredReport, store_report
from maasi_sim.run.run_folder import ResultsError, make_folder, write_text
from maasi_sim.run.run_options import Options, ViewOptions
from maasi_sim.run.run_record import RunEnd
from maasi_sim.run.rviz_view import view_text
from maasi_sim.run.session import Session
from maasi_sim.run.supervisor import Supervisor
from maasi_sim.scenario.layering import Key, ScenarioError, ScenarioWarning
from maasi_sim.view.live_view import RunPage
from maasi_sim.view.messages import read_events
from maasi_sim.view.page_file import REPLAY, write_replay
from maasi_sim.view.scene import scene_of


class ScenarioRun:
    """One run of a scenario, from the file to the report; ends when `interruption` is true."""

    def __init__(self, options: Options, interruption: Interruption) -> None:
        self.options = options
        self.interruption = interruption
        overrides: dict[str, tuple[Key, Any]] = {}
        if options.planner is not None:
            overrides['--planner'] = (('planner', 'name'), options.planner)
        if options.time_limit is not None:
            overrides['--time-limit'] = (('limits', 'time'), options.time_limit)
        if options.seed is not None:
            overrides['--seed'] = (('seed',), options.seed)
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

    def execute(self) -> int:
        """Run it and return the exit code."""
        options = self.options
        with Domain(
            options.domain_id, team=options.namespace, shared=options.follow_clock
        ) as domain:
            self.folder = make_folder(options.out)
            os.environ.update(domain.environment())
            self.mission.prepare()
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
        options, scenario = self.options, self.mission.scenario
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
        session: Session | None = None
        page: RunPage | None = None
        try:
            if self.options.view is not None:
                page = self._page(self.options.view, domain.number)
            session = Session(
                self.mission, self.supervisor, self.options, self.interruption, self.display
            )
            session.listener = None if page is None else page.put_message
            session.open(domain.number, self.folder)
            # Ctrl-C ends the wait at once; the run reports it.
            with self.interruption.at_once():
                wait_for_server()
            if not self.interruption:
                self.supervisor.start()
            session.run()
            if session.is_followed:
                session.close_bag()
                code = self._report(session)
                session.keep_clock()
                return code
        finally:
            self.supervisor.stop_all()
            if session is not None:
                session.close()
            if page is not None:
                page.end()
            self.display.close()
        return self._report(session)

    def _report(self, session: Session) -> int:
        """Write the report, print a summary, and return the exit code."""
        ending = session.ending
        end = RunEnd(
            ending.reason, session.recorder.elapsed, session.wall_time, self.supervisor.events
        )
        stored = StoredReport({}, 'report: skipped', None)
        with self.interruption.at_once(signal.SIGINT):
            self.display.say('writing report and replay (Ctrl-C skips each)')
            stored = store_report(self.mission, session.observer.record(end), self.folder)
        self.display.say(stored.words)
        if ending.text:
            self.display.say(f'ended: {ending.text}')
        if ending.code == NODE_FAILED:
            for log, text in self.supervisor.failed_logs():
                self.display.say(f'--- {short(log)}\n{text}')
        unwritten = session.unwritten + ([stored.problem] if stored.problem else [])
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

    def _page(self, options: ViewOptions, domain: int) -> RunPage | None:
        """Serve the page of the run; an error does not end the run."""
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
