"""A run after the start of its nodes: waits until they are ready, monitors it, ends it."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from maasi_sim.run.bag import BagError, BagWriter, load_types
from maasi_sim.run.ending import (
    DONE,
    INTERRUPTED,
    NODE_FAILED,
    NOT_ALL_FOUND,
    NOT_WRITTEN,
    Ending,
    Interruption,
)
from maasi_sim.run.mission import Mission
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.recorder_node import Recorder
from maasi_sim.run.run_options import Options
from maasi_sim.run.supervisor import Supervisor
from maasi_sim.run.topics import STEP
from maasi_sim.scenario.layering import to_yaml

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


class Session:
    """Records and monitors a run whose nodes have been started.

    Attributes
    ----------
    listener : callable or None
        Called with topic, type and content of each message that a page shows; set before `open`.
    ending : Ending
        How the run ended, after `run`.
    unwritten : list of str
        Errors of writing.
    """

    recorder: Recorder
    ending: Ending

    def __init__(
        self,
        mission: Mission[Any],
        supervisor: Supervisor,
        options: Options,
        interruption: Interruption,
        display: ProgressDisplay,
    ) -> None:
        self.mission = mission
        self.unwritten: list[str] = []
        self.listener: Callable[[str, str, bytes], None] | None = None
        self._types = load_types()
        self.observer = mission.observer(self._types)
        self._scenario = mission.scenario
        self._limits = mission.scenario.limits
        self._supervisor = supervisor
        self._options = options
        self._interruption = interruption
        self._display = display
        self._bag: BagWriter | None = None
        # Planners whose present error was printed.
        self._told: set[str] = set()
        self._open = contextlib.ExitStack()
        self._armed_at = 0.0
        # Wall time of the first step and of the end.
        self._begun: float | None = None
        self._ended: float | None = None

    def open(self, domain: int, folder: Path) -> None:
        """Open the recording and join the ROS domain."""
        if self._options.record:
            self._bag = BagWriter(folder / 'bag', self._types, self._scenario.record.images)
            self._open.callback(self.close_bag)
            self._bag.write_scenario(self._facts(), {'seed': str(self._scenario.seed)})
        self.recorder = Recorder(
            domain, self.observer, self._scenario.step, self._bag, self._options.namespace
        )
        self.recorder.listener = self.listener
        self._open.callback(self.recorder.close)

    def close(self) -> None:
        """Leave the ROS domain and close the recording."""
        self._open.close()

    def close_bag(self) -> None:
        """Close the recording."""
        try:
            if self._bag is not None:
                self._bag.close()
        except BagError as error:
            self.unwritten.append(str(error))

    def run(self) -> None:
        """Monitor the run from the start to the end of its nodes."""
        ending = self._wait_until_ready()
        threading.Thread(target=self._warn, daemon=True).start()
        self.ending = ending or self._follow()
        self._ended = time.monotonic()
        self._check_recording()
        self.recorder.finish()
        self._supervisor.stop(self.recorder, self.is_followed, _POLL)

    def _let_take_off(self) -> None:
        """Let simulated robots take off whose drivers do not take part yet."""
        if time.monotonic() - self._armed_at < _ARMING_PERIOD:
            return
        self._armed_at = time.monotonic()
        ready = set(map(self._supervisor.without_team, self.recorder.ready))
        names = [name for name in self.mission.taking_off() if f'/{name}/driver' not in ready]
        self.recorder.arm(names)

    def _check_recording(self) -> None:
        """Note which topics with a message at each step lack a recording of their beginning."""
        recorder, options = self.recorder, self._options
        if not options.record or self.ending.code not in (DONE, NOT_ALL_FOUND):
            return
        topics = [STEP, *(f'/{name}/state' for name in recorder.robots)]
        times = [recorder.first.get(topic, recorder.time) for topic in topics]
        begin = min(times) if options.follow_clock or self._scenario.external_clock else 0
        for topic, time_ in zip(topics, times):
            missed = (time_ - begin) * 1e-9
            if missed <= _CONNECTION_PATIENCE * (options.rate or 1.0):
                continue
            gap = f'the recording lacks the first {missed:.1f} s of {topic}'
            if topic not in recorder.first:
                gap = f'the recording lacks {topic}'
            self.unwritten.append(gap)
            self._supervisor.events.append(
                {'time': recorder.elapsed, 'node': 'recorder', 'event': 'gap', 'reason': gap}
            )

    @property
    def wall_time(self) -> float:
        """Wall time from the first step to the end [s]."""
        if self._begun is None or self._ended is None:
            return 0.0
        return self._ended - self._begun

    @property
    def is_followed(self) -> bool:
        """Whether another run follows the clock of this one."""
        follows = self._options.follow_clock or self._scenario.external_clock
        own = self._supervisor.clock_running and not (follows or self._options.lockstep)
        return bool(own and not self._interruption and self.recorder.followers())

    def keep_clock(self) -> None:
        """Keep the simulation running until no other run follows its clock."""
        teams = ', '.join(self.recorder.followers())
        self._display.say(f'the clock goes on for {teams} (Ctrl-C ends it)')
        while self.is_followed:
            self.recorder.wait(_FOLLOWERS_PERIOD)
            self.recorder.drain()

    def _facts(self) -> str:
        """Return the data for a replay, as YAML."""
        options = self._options
        facts = {
            'name': self.mission.name,
            'seed': self._scenario.seed,
            'lockstep': options.lockstep,
            'rate': options.rate,
            'namespace': options.namespace,
            'follow_clock': options.follow_clock,
            'scenario': self._scenario.content(),
            'nodes': {
                self._supervisor.without_team(plan.full_name): {
                    'package': plan.package,
                    'executable': plan.executable,
                    'parameters': plan.parameters,
                }
                for plan in self._supervisor.plans
            },
        }
        return to_yaml(facts)

    def _warn(self) -> None:
        warning = self.mission.warning()
        if warning:
            self._display.say(f'warning: {warning}')

    def _wait_until_ready(self) -> Ending | None:
        """Wait until every node is ready, the recorder last; return an ending if one is not."""
        recorder, supervisor = self.recorder, self._supervisor
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
                self._display.say(f'waiting: {", ".join(what)}')
                patience += _START_PATIENCE
            recorder.wait(_POLL)
        for complaint in recorder.complaints:
            self._display.say(f'warning: {complaint}')
        for topic in unmatched:
            self._display.say(f'warning: {topic} has a publisher that is not recorded')
        # Their executors run, even if no heartbeat has arrived so far.
        for name in expected:
            supervisor.watch.beat(name, time.monotonic())
        recorder.publish_ready()
        return None

    def _name_external_robots(self) -> None:
        team = self._options.namespace
        where = f' --namespace {team}' if team else ''
        domain = self.recorder.context.get_domain_id()
        for name in self.mission.external():
            self._display.say(
                f'{name} is external: it takes off when you call its service arm (search_command '
                f'arm --robot {name}{where}, with ROS_DOMAIN_ID={domain})'
            )

    def _follow(self) -> Ending:
        """Monitor the run until it ends, and return its ending."""
        recorder, supervisor = self.recorder, self._supervisor
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
                if self._options.follow_clock:
                    return Ending(
                        'clock_stopped',
                        NODE_FAILED,
                        '/clock, which this run follows, stands still for '
                        f'{self._limits.silence:g} s',
                    )
                return supervisor.standstill(recorder)
            self._tell_faults()
            if self._display.due or self.observer.news:
                self._show()

    def _tell_faults(self) -> None:
        """Print an error of a planner when it begins."""
        for name in self.recorder.faults.keys() - self._told:
            self._display.say(f'warning: {name}: {self.recorder.faults[name]}')
        self._told = set(self.recorder.faults)

    def _finish_step(self) -> None:
        """Report that the recorder is done with a step, once the disk keeps up."""
        if self._bag is not None:
            with contextlib.suppress(BagError):
                self._bag.wait(_BACKLOG)
        if self._options.lockstep and self.recorder.step is not None:
            self.recorder.publish_done(self.recorder.step)

    def _check(self) -> Ending | None:
        """Return an ending if the run was interrupted or a node has failed."""
        if self._interruption:
            return Ending('interrupted', INTERRUPTED)
        return self._supervisor.check(self.recorder)

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
        self._display.show(
            f'{seconds:7.1f} s   {observer.measurements:4d} measurements   '
            f'{observer.found} {self.mission.found_word}{targets}   '
            f'{100.0 * explored:3.0f} % explored   '
            f'{seconds / wall if wall > 0.0 else 0.0:.1f} x real time',
            observer.found,
        )
