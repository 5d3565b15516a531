"""The nodes of a run: started, watched, restarted and stopped."""

from __future__ import annotations

import signal
import time
from collections.abc import Mapping
from typing import Any

from maasi_sim.run.ending import NODE_FAILED, Ending
from maasi_sim.run.node_plan import NodePlan
from maasi_sim.run.processes import NodeProcess, stop
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.recorder_node import Recorder
from maasi_sim.scenario.base import BaseScenario

# Wall time between two checks of the processes, where steps come in quick succession [s].
_CHECK_PERIOD = 0.05
# A longer gap between two checks means that the run itself was suspended [s].
_LONGEST_GAP = 1.0
# For the last messages of drivers to arrive [s].
_LAST_MESSAGES = 0.02


class Supervisor:
    """Starts the nodes of a run; restarts a node that dies or hangs, or ends the run."""

    def __init__(
        self,
        plans: Mapping[str, NodePlan],
        processes: Mapping[str, NodeProcess],
        scenario: BaseScenario,
        lockstep: bool,
        recorder: Recorder,
        display: ProgressDisplay,
    ) -> None:
        self.processes = processes
        #: Nodes that died, hung or were restarted.
        self.events: list[dict[str, Any]] = []
        #: Whether the first step has begun; before it nodes may take long to start.
        self.running = False
        self._plans = plans
        self._scenario = scenario
        self._limits = scenario.limits
        self._lockstep = lockstep
        self._recorder = recorder
        self._display = display
        self._checked = 0.0
        self._clocks = {name for name, plan in plans.items() if plan.is_clock}

    def start(self) -> None:
        """Start all nodes."""
        for process in self.processes.values():
            process.start()

    def check(self) -> Ending | None:
        """Return an ending if a node has died or hangs and is not restarted."""
        now = time.monotonic()
        gap = now - self._checked
        # Polling each process takes longer than a short step.
        if gap < _CHECK_PERIOD:
            return None
        self._checked = now
        beats = self._recorder.take_heartbeats()
        for name, process in self.processes.items():
            if name in beats:
                process.beat(beats[name])
            # The last heartbeat may have been before the gap.
            if gap > _LONGEST_GAP and process.beaten is not None:
                process.beaten = min(process.beaten + gap, now)
            ending = None
            if not process.is_alive():
                ending = self._restart(name, process)
            elif self.running:
                ending = self._check_heartbeat(name, process, now)
            if ending is not None:
                return ending
        return None

    def _restart(self, name: str, process: NodeProcess) -> Ending | None:
        """Restart a node that has died, or return the ending of the run."""
        text = f'{name} {process.how_it_ended()}'
        if self._plans[name].drives:
            self._stop_robot_of(name)
        if self._respawns(name) and process.restarts < self._limits.restarts:
            self._note(name, 'restarted')
            self._recorder.ready.discard(name)
            process.restart()
            self._display.say(f'{text}; it is restarted')
            return None
        self._note(name, 'died')
        if process.restarts:
            text += f', after {process.restarts} restarts'
        return Ending('node_died', NODE_FAILED, text, [name])

    def _check_heartbeat(self, name: str, process: NodeProcess, now: float) -> Ending | None:
        """Kill a node that hangs, or return the ending of the run."""
        plan, limits = self._plans[name], self._limits
        if process.beaten is None:
            if now - process.started <= limits.start:
                return None
            text = f'{name} not ready {limits.start:g} s after the start'
            return Ending('not_ready', NODE_FAILED, text, [name])
        # A lockstep step may take long: `limits.silence` applies to awaited nodes.
        awaited = self._lockstep and (plan.says_done or plan.is_clock)
        if awaited or not process.hangs(now, limits.heartbeat):
            return None
        text = f'{name} hangs: no heartbeat for {now - process.beaten:.1f} s'
        self._note(name, 'hung')
        self._stop_robot_of(name)
        if not self._respawns(name):
            return Ending('node_hung', NODE_FAILED, text, [name])
        self._display.say(f'{text}; it is killed')
        process.signal(signal.SIGKILL)
        return None

    def _respawns(self, name: str) -> bool:
        # A restarted simulation would begin at time 0.
        return self._scenario.on_exit == 'respawn' and name not in self._clocks

    def _note(self, name: str, event: str) -> None:
        self.events.append({'time': self._recorder.elapsed, 'node': name, 'event': event})

    def _stop_robot_of(self, name: str) -> None:
        robot = (self._recorder.relative(name) or '').split('/')[1]
        if robot in self._scenario.robots:
            self._recorder.stop_robots([robot])

    def standstill(self) -> Ending:
        """Return the ending of a run whose time has stopped."""
        silence = f'for {self._limits.silence:g} s'
        step = self._recorder.step
        if step is None:
            return Ending('node_hung', NODE_FAILED, f'the simulated time stands still {silence}')
        steps = self._recorder.done_steps()
        doers = [name for name, plan in self._plans.items() if plan.says_done]
        late = [name for name in doers if steps.get(name, -1) < step]
        who = ', '.join(late) or next(iter(self._clocks))
        return Ending('node_hung', NODE_FAILED, f'step {step}: nothing from {who} {silence}', late)

    @property
    def restarting(self) -> bool:
        """Whether a restarted node has not had a heartbeat yet."""
        return any(item.restarts and item.beaten is None for item in self.processes.values())

    @property
    def has_clock(self) -> bool:
        """Whether the simulation runs."""
        return all(self.processes[name].is_alive() for name in self._clocks)

    def stop(self, keep_clock: bool) -> None:
        """Stop the robots, then the nodes, and record their last messages."""
        recorder, robots = self._recorder, self._scenario.names()
        drivers, others = [], []
        for name, plan in self._plans.items():
            if plan.drives or plan.package == 'maasi_drivers':
                drivers.append(self.processes[name])
            elif not (keep_clock and plan.is_clock):
                others.append(self.processes[name])
        # Drivers stop their robots while the simulation, or the robot, still runs. One that hangs
        # does not, and may send a command until it is killed: stop the robots before and after.
        recorder.stop_robots(robots)
        stubborn = stop(drivers)
        recorder.stop_robots(robots)
        recorder.wait(_LAST_MESSAGES)
        recorder.drain()
        stubborn += stop(others)
        recorder.drain()
        if stubborn:
            self._display.say(f'had to be killed: {", ".join(stubborn)}')
