"""Who hangs: silent nodes, but not those that start or wait for a processor."""

import os
import signal
from types import SimpleNamespace

import pytest

from maasi_sim.run import processes, supervisor
from maasi_sim.run.node_plan import NodePlan
from maasi_sim.run.processes import waited_for_processor
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.run_options import Options
from maasi_sim.run.supervisor import Supervisor
from maasi_sim.scenario.loading import load_scenario

FILTER, PLANNER = '/filter_node', '/planner_node'


class Run:
    """Two nodes whose heartbeats, clock and waits for a processor are played."""

    def __init__(self, monkeypatch, folder, **overrides):
        self.now = 0.0
        self.beats, self.queued, self.stopped = {}, {}, []
        clock = SimpleNamespace(monotonic=lambda: self.now)
        monkeypatch.setattr(supervisor, 'time', clock)
        monkeypatch.setattr(processes, 'waited_for_processor', lambda pid: self.queued.get(pid, 0))
        names = ('filter_node', 'planner_node')
        plans = [NodePlan(f'maasi_{name[:-5]}', name, name) for name in names]
        mission = SimpleNamespace(
            scenario=load_scenario('mambo', overrides), plan_nodes=lambda *_: plans
        )
        self.recorder = SimpleNamespace(
            elapsed=0.0, step=None, time=0, ready={PLANNER}, pop_heartbeats=self.pop
        )
        self.recorder.observer = SimpleNamespace(log=SimpleNamespace(last_steps={}))
        self.supervisor = Supervisor(mission, Options(), folder, ProgressDisplay())
        self.supervisor.recorder = self.recorder
        self.supervisor.running = True
        self.nodes = self.supervisor.processes
        for pid, node in enumerate(self.nodes.values(), start=1):
            node._popen = SimpleNamespace(pid=pid, poll=lambda: None)

    def pop(self):
        beats, self.beats = self.beats, {}
        return beats

    def beat(self, *names, at):
        self.now, self.recorder.step = at, at
        self.beats |= dict.fromkeys(names, at)
        return self.supervisor.check()

    def until(self, end, stands_still=False):
        """Look ten times a second; return the time and the words of the first ending."""
        while self.now < end - 0.05:
            self.now += 0.1
            if not stands_still:
                self.recorder.step = self.now
            if ending := self.supervisor.check():
                return self.now, ending.text
        return None


@pytest.fixture
def run(monkeypatch, tmp_path):
    return Run(monkeypatch, tmp_path)


def test_a_silent_node_is_named_within_five_seconds_and_no_pause_of_three(run):
    run.beat(FILTER, PLANNER, at=26.0)
    assert run.until(30.0) is None
    run.beat(FILTER, at=30.0)
    for second in range(30, 34):
        run.beat(PLANNER, at=float(second))
        assert run.until(second + 1) is None
    run.beat(PLANNER, at=34.0)
    when, words = run.until(36.0)
    assert words.startswith(FILTER) and 'limits.heartbeat' in words
    assert when < 35.0


def test_a_node_that_starts_has_as_long_as_the_limit_says(run):
    assert run.until(179.0) is None
    run.beat(PLANNER, at=179.5)
    when, words = run.until(181.0)
    assert words.startswith(FILTER) and 'limits.start' in words and when < 180.5
    # The last heartbeat of the process before does not count.
    node = run.nodes[PLANNER]
    node.started, node.beaten, node.restarts = 190.0, None, 1
    node.beat(190.2)
    assert node.beaten is None
    node.beat(190.6)
    assert node.beaten == 190.6


def test_time_in_the_queue_for_a_processor_does_not_count(run):
    run.queued[1] = 2.0
    run.beat(FILTER, at=1.0)
    run.queued[1] = 5.0
    assert run.until(8.4) is None
    assert run.until(9.0) is not None


def test_a_node_that_is_ready_at_once_is_watched(run):
    for node in run.nodes.values():
        node.beat(0.2)
    when, words = run.until(6.0)
    assert 'hangs' in words and when < 5.0


def test_a_run_whose_time_stands_still_names_who_is_late(run):
    assert run.until(20.0) is None
    run.recorder.step = 7
    run.recorder.done_steps = lambda: {FILTER: 7, PLANNER: 6}
    # A restarted node may compile.
    run.nodes[PLANNER].restarts = 1
    assert run.until(100.0, stands_still=True) is None
    run.supervisor._options = Options(lockstep=True)
    run.nodes[PLANNER].restarts = 0
    when, words = run.until(180.0, stands_still=True)
    assert words.startswith('step 7: ') and PLANNER in words and 129.9 < when < 130.5
    # The planner lives, and waits for the other one.
    for filter_beaten, who in ((when, PLANNER), (when - 10.0, FILTER)):
        run.beats = {FILTER: filter_beaten, PLANNER: when}
        _, words = run.until(180.0, stands_still=True)
        assert [node for node in run.nodes if node in words] == [who]


@pytest.mark.parametrize('last', [1.0, 1.18, 61.2])
def test_the_run_itself_may_have_stood_still(run, last):
    run.beat(FILTER, at=1.0)
    run.until(1.2)
    # It has received this one, but not looked yet.
    run.beats = {FILTER: last}
    run.now = 61.2
    assert run.until(65.0) is None
    assert run.until(66.5) is not None


def test_a_node_is_killed_if_it_hangs_and_restarted_as_often_as_the_limit_says(
    monkeypatch, tmp_path
):
    limits = {'on_exit': (('on_exit',), 'respawn'), 'restarts': (('limits', 'restarts'), 1)}
    run = Run(monkeypatch, tmp_path, **limits)
    node, signals, starts = run.nodes[PLANNER], [], []
    monkeypatch.setattr(node, 'signal', signals.append)
    monkeypatch.setattr(node, 'start', lambda: starts.append(node.restarts))
    monkeypatch.setattr(node, 'join', lambda: None)
    removed = []
    monkeypatch.setattr(supervisor, 'remove_dead', lambda: removed.append(len(starts)))
    run.beat(FILTER, PLANNER, at=1.0)
    run.until(4.0)
    run.beat(FILTER, at=4.0)
    assert run.until(6.3) is None and set(signals) == {signal.SIGKILL}
    node._popen = SimpleNamespace(pid=2, poll=lambda: -9)
    run.beat(FILTER, at=6.4)
    assert starts == [1] and removed == [0] and run.recorder.ready == set()
    assert 'start number 2' in node.last_words()
    node._popen = SimpleNamespace(pid=3, poll=lambda: 7)
    ending = run.beat(FILTER, at=6.6)
    assert ending.text == f'{PLANNER} exited with 7, after 1 restart (limits.restarts)'
    events = [event['event'] for event in run.supervisor.events]
    assert events[0] == 'hung' and events[-2:] == ['restarted', 'died']
    assert ending.nodes == [PLANNER]


def test_the_wait_for_a_processor_is_read_from_the_system():
    begin = waited_for_processor(os.getpid())
    assert waited_for_processor(os.getpid()) >= begin >= 0.0
    assert waited_for_processor(None) == 0.0
