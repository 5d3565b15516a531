"""The nodes of a run: planned, watched, restarted and stopped."""

import signal
import time
from pathlib import Path
from typing import Any

from maasi_filter.wording import counted
from maasi_sim.run.domain import remove_dead
from maasi_sim.run.ending import NODE_FAILED, Ending
from maasi_sim.run.mission import Mission
from maasi_sim.run.node_plan import NodePlan
from maasi_sim.run.processes import NodeProcess, stop
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.recorder_node import Recorder
from maasi_sim.run.run_options import Options
from maasi_sim.run.topics import within

# Wall time between two checks of the processes [s].
_CHECK_PERIOD = 0.05
_LONGEST_GAP = 1.0  # a longer gap between two checks means that the run was suspended [s]
_LAST_MESSAGES = 0.02  # wait for the last messages of drivers [s]


class Supervisor:
    """Watches the nodes of a run; restarts one that dies or hangs, or ends the run."""

    recorder: Recorder  # what the nodes report; created while they start

    def __init__(
        self, mission: Mission[Any], options: Options, folder: Path, display: ProgressDisplay
    ) -> None:
        team, level = options.namespace, options.log_level
        plans = mission.plan_nodes(options, folder / 'scenario.yaml')
        self.plans = {within(team, plan.full_name): plan for plan in plans}
        self.processes = {
            name: plan.process(folder, team, level) for name, plan in self.plans.items()
        }
        self.events: list[dict[str, Any]] = []  #: nodes that died, hung or were restarted
        #: Whether all nodes have been ready; before that they may take long.
        self.running = False
        self._scenario = mission.scenario
        self._options, self._display = options, display
        self._checked = 0.0
        # Newest step and simulated time, and the wall time of their last change [s].
        self._moment: tuple[int | None, int] = (None, 0)
        self._moved = 0.0

    def check(self) -> Ending | None:
        """Return an ending if time stands still, or a node has died or hangs."""
        now = time.monotonic()
        gap = now - self._checked
        # Polling each process takes longer than a short step.
        if gap < _CHECK_PERIOD:
            return None
        self._checked = now
        beats = self.recorder.pop_heartbeats()
        for name, process in self.processes.items():
            if name in beats:
                process.beat(beats[name])
            # The last heartbeat may be from before the gap.
            if gap > _LONGEST_GAP and process.beaten is not None:
                process.beaten = min(process.beaten + gap, now)
            if ending := self._check_node(self.plans[name], process, now):
                return ending
        moment = self.recorder.step, self.recorder.time
        # A restarted node may have to compile, within `limits.start`.
        restarting = any(item.restarts and item.beaten is None for item in self.processes.values())
        if not self.running or restarting or moment != self._moment:
            self._moment, self._moved = moment, now
        elif now - self._moved > self._scenario.limits.silence:
            return self._standstill(now)
        return None

    def _check_node(self, plan: NodePlan, process: NodeProcess, now: float) -> Ending | None:
        """Restart a dead node, kill a hanging one, or return the ending of the run."""
        name, limits = process.name, self._scenario.limits
        died = not process.is_alive()
        if died:
            text = f'{name} {process.how_it_ended()}'
        elif not self.running:
            return None
        elif process.beaten is None:
            if now - process.started <= limits.start:
                return None
            text = f'{name} is not ready {limits.start:g} s after its start (limits.start)'
            return Ending('not_ready', NODE_FAILED, text, [name])
        elif self._options.lockstep:
            return None  # a step may take long; `limits.silence` covers its nodes
        elif process.hangs(now, limits.heartbeat):
            text = f'{name} hangs: no heartbeat for {now - process.beaten:.1f} s (limits.heartbeat)'
        else:
            return None
        if plan.namespace in self._scenario.robots and (not died or plan.role == 'driver'):
            self.recorder.stop_robots([plan.namespace])
        # A restarted simulation would begin at time 0.
        respawns = self._scenario.on_exit == 'respawn' and plan.role != 'clock'
        if not respawns or process.restarts >= limits.restarts:
            if process.restarts:
                text += f', after {counted(process.restarts, "restart")} (limits.restarts)'
            word = 'died' if died else 'hung'
            self.note(name, word)
            return Ending(f'node_{word}', NODE_FAILED, text, [name])
        if died:
            self.note(name, 'restarted')
            self.recorder.ready.discard(name)
            remove_dead()
            process.restart()
        else:
            self.note(name, 'hung')
            process.signal(signal.SIGKILL)
        self._display.say(f'{text}: {"restarting" if died else "killing"} it')
        return None

    def note(self, name: str, event: str, **details: str) -> None:
        """Add an event."""
        time_ = self.recorder.elapsed
        self.events.append({'time': time_, 'node': name, 'event': event, **details})

    def _standstill(self, now: float) -> Ending:
        silence = f'for {self._scenario.limits.silence:g} s (limits.silence)'
        if self._scenario.external_clock:
            text = f'the external /clock has not advanced {silence}'
            return Ending('clock_stopped', NODE_FAILED, text)
        step = self.recorder.step
        if step is None:
            return Ending(
                'node_hung', NODE_FAILED, f'the simulated time has not advanced {silence}'
            )
        steps = self.recorder.done_steps()
        reached = self.recorder.observer.log.last_steps
        steps |= {
            name: reached.get(plan.namespace, -1)
            for name, plan in self.plans.items()
            if plan.role == 'driver'
        }
        nodes = self.nodes('driver', 'other')
        # Nodes that are late may wait for a node that hangs.
        hung = [n.name for n in nodes if n.hangs(now, self._scenario.limits.heartbeat)]
        late = hung or [n.name for n in nodes if steps.get(n.name, step) < step]
        who = ', '.join(late) or self.nodes('clock')[0].name
        return Ending(
            'node_hung', NODE_FAILED, f'step {step}: no message from {who} {silence}', late
        )

    def nodes(self, *roles: str) -> list[NodeProcess]:
        """Return the processes of the nodes with some roles."""
        return [self.processes[name] for name, plan in self.plans.items() if plan.role in roles]

    def stop(self) -> None:
        """Stop the robots, then the nodes, and record their last messages."""
        recorder, robots = self.recorder, self._scenario.names()
        stubborn = []
        if self._options.lockstep:
            # Robots stand still between steps, and no step follows.
            stubborn = stop(self.nodes('clock'))
        # Drivers stop their robots while the simulation, or the robot, still runs. A hanging driver
        # may send commands until it is killed, so stop the robots before and after.
        self._display.update('stopping the nodes', quiet=True)
        recorder.stop_robots(robots)
        # All others stop together; a running planner would report ended drivers as lost.
        stubborn += stop(self.nodes('driver', 'guard', 'other'))
        # Record their last commands before the stop.
        recorder.drain()
        recorder.stop_robots(robots)
        time.sleep(_LAST_MESSAGES)
        recorder.drain()
        stubborn += stop(self.nodes('clock'))
        recorder.drain()
        if stubborn:
            self._display.say(f'killed because they did not stop: {", ".join(stubborn)}')
