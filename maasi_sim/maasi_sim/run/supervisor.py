"""The nodes of a run as processes: started, watched, restarted and stopped."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from maasi_sim.run.ending import NODE_FAILED, Ending
from maasi_sim.run.node_plan import NodePlan
from maasi_sim.run.processes import NodeProcess, stop
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.recorder_node import Recorder
from maasi_sim.run.run_folder import ResultsError
from maasi_sim.run.run_options import Options
from maasi_sim.scenario.base import BaseScenario

# Wall time between two checks of the processes, where steps come in quick succession [s].
_CHECK_PERIOD = 0.05
# A heartbeat this soon after a restart is from the previous process [s].
_LEAST_START = 0.5
# A longer gap between two checks means that the run itself was suspended [s].
_LONGEST_LOOK = 1.0


@dataclass
class _Node:
    """Times in seconds of wall time."""

    pid: int | None
    started: float
    beat: float | None = None
    # Time spent waiting for a processor until the last heartbeat.
    waited: float = 0.0


def waited_for_processor(pid: int | None) -> float:
    """Return how long the main thread of a process was runnable without running [s]."""
    try:
        return 1e-9 * int(Path(f'/proc/{pid}/schedstat').read_text().split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0


class NodeWatch:
    """Detects nodes that hang, by the heartbeats that their executors publish each second.

    Time in which a node waited for a processor does not count. Until its first heartbeat a node
    counts as starting, which may include compilation. Times are of the wall [s].
    """

    def __init__(
        self,
        silence: float,
        start: float,
        waited: Callable[[int | None], float] = waited_for_processor,
    ) -> None:
        self._silence = silence
        self._start = start
        self._waited = waited
        self._nodes: dict[str, _Node] = {}
        self._looked: float | None = None

    def begin(self, name: str, pid: int | None, now: float) -> None:
        """Note that the process of a node was started."""
        self._nodes[name] = _Node(pid, now)

    def beat(self, name: str, now: float) -> None:
        """Note a heartbeat."""
        node = self._nodes.get(name)
        if node is None or (node.beat is None and now - node.started < _LEAST_START):
            return
        node.beat, node.waited = now, self._waited(node.pid)

    def starting(self) -> list[str]:
        """Return the nodes without a heartbeat so far."""
        return [name for name, node in self._nodes.items() if node.beat is None]

    def late(self, now: float) -> list[str]:
        """Return the nodes that have been starting for too long."""
        return [name for name in self.starting() if now - self._nodes[name].started > self._start]

    def hung(self, now: float) -> dict[str, float]:
        """Return the nodes that hang, and for how long [s]; to be called several times a second."""
        gap = 0.0 if self._looked is None else now - self._looked
        self._looked = now
        hung = {}
        for name, node in self._nodes.items():
            if node.beat is None:
                continue
            if gap > _LONGEST_LOOK:
                node.beat += gap
            silent = now - node.beat
            if silent > self._silence:
                silent -= self._waited(node.pid) - node.waited
            if silent > self._silence:
                hung[name] = silent
        return hung


class Supervisor:
    """Starts the nodes of a run; restarts a node that dies or hangs, or ends the run."""

    def __init__(
        self,
        plans: list[NodePlan],
        scenario: BaseScenario,
        options: Options,
        folder: Path,
        display: ProgressDisplay,
    ) -> None:
        self.plans = plans
        #: Nodes that died, hung or were restarted.
        self.events: list[dict[str, Any]] = []
        #: Nodes that caused the end of the run.
        self.failed: set[str] = set()
        #: Whether the first step has begun; before it nodes may take long to start.
        self.running = False
        self._scenario = scenario
        self._limits = scenario.limits
        self._respawn = scenario.on_exit == 'respawn'
        self._team = options.namespace
        self._lockstep = options.lockstep
        self._display = display
        self._checked = 0.0
        self.watch = NodeWatch(self._limits.heartbeat, self._limits.start)
        self._plan_of = {plan.full_name: plan for plan in plans}
        self.clocks = {plan.full_name for plan in plans if plan.is_clock}
        parameters = folder / 'parameters'
        try:
            parameters.mkdir(exist_ok=True)
        except OSError as error:
            raise ResultsError(f'{parameters}: {error.strerror}') from error
        self.processes = {
            plan.full_name: plan.process(parameters, folder, options.log_level) for plan in plans
        }

    def start(self) -> None:
        """Start all nodes."""
        for process in self.processes.values():
            process.start()
            self.watch.begin(process.name, process.pid, time.monotonic())

    def check(self, recorder: Recorder) -> Ending | None:
        """Return an ending if a node has died or hangs and is not restarted."""
        # Polling each process takes longer than a short step.
        if time.monotonic() - self._checked < _CHECK_PERIOD:
            return None
        self._checked = time.monotonic()
        for name, beat in recorder.heartbeats.items():
            self.watch.beat(name, beat)
        recorder.heartbeats.clear()
        # Before the first step `ScenarioRun` waits for the nodes.
        late = self.watch.late(self._checked) if self.running else []
        if late:
            text = f'{", ".join(late)} not ready {self._limits.start:g} s after the start'
            return self._failure('not_ready', text, late)
        ending = self._check_heartbeats(recorder)
        for name, process in self.processes.items():
            if ending is None and not process.running:
                ending = self._restart(name, process, recorder)
        return ending

    def _restart(self, name: str, process: NodeProcess, recorder: Recorder) -> Ending | None:
        """Restart a node that has died, or return the ending of the run."""
        text = f'{name} {process.how_it_ended()}'
        event = {'time': recorder.elapsed, 'node': name, 'event': 'died'}
        robot = self._robot_of(name)
        if robot is not None and self._plan_of[name].drives:
            recorder.stop_robots([robot])
        # A restarted simulation would begin at time 0.
        tries = 0 if name in self.clocks else self._limits.restarts
        if self._respawn and process.restarts < tries:
            self.events.append({**event, 'event': 'restarted'})
            recorder.ready.discard(name)
            process.restart()
            self.watch.begin(name, process.pid, self._checked)
            self._display.say(f'{text}; it is restarted')
            return None
        self.events.append(event)
        if process.restarts:
            text += f', after {process.restarts} restarts'
        return self._failure('node_died', text, [name])

    def _failure(self, reason: str, text: str, names: list[str]) -> Ending:
        self.failed.update(names)
        return Ending(reason, NODE_FAILED, text)

    def _check_heartbeats(self, recorder: Recorder) -> Ending | None:
        """Kill a node that hangs, or return the ending of the run."""
        for name, silent in self.watch.hung(self._checked).items():
            plan = self._plan_of[name]
            # A lockstep step may take long: `limits.silence` applies to awaited nodes.
            awaited = self._lockstep and (plan.says_done or plan.is_clock)
            if not self.running or awaited or not self.processes[name].running:
                continue
            text = f'{name} hangs: no heartbeat for {silent:.1f} s'
            self.events.append({'time': recorder.elapsed, 'node': name, 'event': 'hung'})
            robot = self._robot_of(name)
            if robot is not None:
                recorder.stop_robots([robot])
            if self._respawn and name not in self.clocks:
                self._display.say(f'{text}; it is killed')
                self.processes[name].signal(signal.SIGKILL)
                continue
            return self._failure('node_hung', text, [name])
        return None

    def standstill(self, recorder: Recorder) -> Ending:
        """Return the ending of a run whose time has stopped."""
        silence = f'for {self._limits.silence:g} s'
        if recorder.step is None:
            return self._failure('node_hung', f'the simulated time stands still {silence}', [])
        steps = recorder.done_steps()
        doers = [plan.full_name for plan in self.plans if plan.says_done]
        late = [name for name in doers if steps.get(name, -1) < recorder.step]
        who = ', '.join(late) or next(iter(self.clocks))
        text = f'step {recorder.step}: nothing from {who} {silence}'
        return self._failure('node_hung', text, late)

    @property
    def restarting(self) -> bool:
        """Whether a restarted node has not had a heartbeat yet."""
        return any(self.processes[name].restarts for name in self.watch.starting())

    def stop(self, recorder: Recorder, keep_clock: bool, poll: float) -> None:
        """Stop the robots, then the nodes, and record their last messages."""
        kept = self.clocks if keep_clock else set()
        drivers = [
            plan.full_name for plan in self.plans if plan.drives or plan.package == 'maasi_drivers'
        ]
        others = [name for name in self.processes if name not in kept.union(drivers)]
        robots = self._scenario.names()
        # Drivers stop their robots while the simulation, or the robot, still runs. One that hangs
        # does not, and may send a command until it is killed: stop the robots before and after.
        recorder.stop_robots(robots)
        stubborn = stop([self.processes[name] for name in drivers])
        recorder.stop_robots(robots)
        recorder.wait(poll)
        recorder.drain()
        stubborn += stop([self.processes[name] for name in others])
        recorder.drain()
        if stubborn:
            self._display.say(f'had to be killed: {", ".join(stubborn)}')

    def without_team(self, name: str) -> str:
        """Return the name of a node without the namespace of the team."""
        return name.removeprefix(f'/{self._team}') if self._team else name

    def _robot_of(self, node: str) -> str | None:
        name = self.without_team(node).strip('/').partition('/')[0]
        return name if name in self._scenario.robots else None
