"""Runs with nodes that play by a script: how they end, what they leave, who is blamed."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import rclpy
import yaml
from chaos_execution import processes_of
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from report_check import check_report
from reserved_domain import reserved_domain
from rosgraph_msgs.msg import Clock
from waiting import wait_until

from maasi_sim.run.bag import Bag
from maasi_sim.run.run_folder import make_folder
from maasi_sim.run.run_options import Options, parse
from maasi_sim.run.scenario_run import ScenarioRun
from maasi_sim.scenario.layering import ScenarioError

WITH_FAKES = Path(__file__).with_name('run_with_fakes.py')
LIMIT = 120.0

pytestmark = pytest.mark.system

TARGETS = [[0.5, 0.5], [1.5, 0.5], [1.0, 1.5]]


def scenario_in(folder):
    def write(**changes):
        content = {
            'version': 1,
            'environment': {'bounds': [[0.0, 2.0], [0.0, 2.0]]},
            'step': 0.05,
            'targets': {'positions': TARGETS},
            'robots': {
                name: {
                    'type': 'mambo',
                    'start': [0.5, 0.5, 1.0],
                    'candidates': {'grid': [6, 6], 'spacing': 0.34},
                }
                for name in ('mambo', 'second')
            },
            'limits': {'time': 20.0, 'start': 30.0, 'silence': 5.0},
        }
        content.update(changes)
        path = folder / 'scripted.yaml'
        path.write_text(yaml.safe_dump(content))
        return path

    return write


@pytest.fixture
def scenario(tmp_path):
    return scenario_in(tmp_path)


class Run:
    """A run as a process."""

    def __init__(self, folder, scenario, *options, script=None):
        self.folder = folder
        self.process = subprocess.Popen(
            [
                sys.executable,
                str(WITH_FAKES),
                json.dumps(script or {}),
                str(scenario),
                '--out',
                str(folder),
                *options,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def wait(self):
        """Return exit code and output."""
        output, _ = self.process.communicate(timeout=LIMIT)
        return self.process.returncode, output

    def wait_for(self, text):
        """Read the output up to a line with a text."""
        for line in self.process.stdout:
            if text in line:
                return
        raise AssertionError(f'never said {text}')

    @property
    def report(self):
        return json.loads((self.folder / 'report.json').read_text())

    def nodes(self):
        """Return the numbers of its nodes' processes that are alive."""
        found = processes_of(str(self.folder))
        return [pid for pid, command in found.items() if 'fake_nodes' in command]


@pytest.fixture(scope='module')
def complete(tmp_path_factory):
    """Return a run that finds all."""
    folder = tmp_path_factory.mktemp('complete')
    run = Run(folder / 'run', scenario_in(folder)(), '--lockstep', '--seed', '5')
    code, output = run.wait()
    assert code == 0, output
    assert '3 of 3 targets found' in output
    return run


def test_a_run_that_finds_all(complete):
    run, report = complete, complete.report
    assert report['end_reason'] == 'all_found'
    assert report['seed'] == 5
    assert report['true_found'] == 3 and report['false_found'] == 0
    assert report['measurements'] == {'mambo': 3, 'second': 3}
    assert report['measurements_to_find_all'] == 6
    assert report['time_to_find_all'] == 1.0
    assert report['decisions'] == 6
    assert report['distance']['mambo'] == pytest.approx(0.2)
    assert report['real_time_factor'] > 0.0
    assert (run.folder / 'report.png').exists()
    logs = {path.name for path in run.folder.glob('*.log')}
    assert logs == {
        'sim_node.log',
        'mambo_driver.log',
        'second_driver.log',
        'filter_node.log',
        'planner_node.log',
    }
    assert (run.folder / 'parameters' / 'filter_node.yaml').exists()
    assert run.nodes() == []


def test_the_recording_holds_the_run_and_how_to_repeat_it(complete):
    with Bag(complete.folder) as bag:
        counts = bag.counts
        steps = [item.message.step for item in bag.messages(['/lockstep/step'])]
        updates = [item.message.step for item in bag.messages(['/filter_update'])]
        states = [item.message.step for item in bag.messages(['/mambo/state'])]
        # The planner repeats what is not answered soon.
        batches = {item.message.id for item in bag.messages(['/measurement_batch'])}
        facts = bag.scenario()
    # A step more may begin before the run ends.
    assert steps == list(range(len(steps))) and len(steps) in (21, 22)
    assert updates == [0, 10, 20]
    assert states[:21] == steps[:21]
    assert counts['/decisions'] == 3 and batches == {1, 2, 3}
    assert counts['/mambo/odom'] >= 21
    assert facts['seed'] == 5 and facts['lockstep'] is True
    assert facts['scenario']['targets']['positions'] == TARGETS
    assert facts['nodes']['/mambo/driver']['parameters']['step'] == 0.05


@pytest.mark.parametrize(
    ('from_step', 'said'),
    [(0, 'the recording lacks /second/state'), (120, 'the recording lacks the first 6')],
)
def test_a_gap_of_the_recording_is_in_report_and_exit_code(tmp_path, scenario, from_step, said):
    script = {'second/driver': {'fault': 'mute', 'fault_step': from_step}, 'found': 2}
    path = scenario(limits={'time': 8.0, 'start': 30.0, 'silence': 20.0})
    run = Run(tmp_path / 'run', path, script=script)
    code, output = run.wait()
    assert f'error: {said}' in output
    assert code == 4
    (gap,) = (event for event in run.report['events'] if event['event'] == 'gap')
    assert gap['reason'].startswith(said) and gap['reason'].endswith('/second/state')
    check_report(run.report)


def test_report_and_replay_of_a_long_run_may_be_skipped(tmp_path, scenario):
    run = Run(tmp_path / 'run', scenario(), '--lockstep', script={'long': True})
    run.wait_for('Ctrl-C skips each')
    for _ in ('report', 'replay'):
        run.wait_for('busy')
        run.process.send_signal(signal.SIGTERM)
        run.process.send_signal(signal.SIGINT)
    code, output = run.wait()
    assert code == 0, output
    assert not (run.folder / 'report.json').exists()
    with Bag(run.folder / 'bag') as bag:
        assert bag.counts['/filter_update'] == 3


def test_a_run_without_a_home_folder_in_a_poor_environment(tmp_path, scenario, monkeypatch):
    for name in ('HOME', 'ROS_HOME', 'ROS_LOG_DIR', 'XDG_RUNTIME_DIR', 'XDG_CACHE_HOME'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('LC_ALL', 'C')
    mask = os.umask(0o077)
    try:
        run = Run(tmp_path / """it's "here" """, scenario(), '--lockstep')
    finally:
        os.umask(mask)
    code, output = run.wait()
    assert code == 0, output
    assert run.report['true_found'] == 3


@pytest.fixture
def follower():
    """Return a domain, and the simulation of another run in it that follows its clock."""
    with reserved_domain() as domain, pytest.MonkeyPatch.context() as patch:
        for name, value in domain.environment().items():
            patch.setenv(name, value)
        context = Context()
        rclpy.init(context=context, domain_id=domain.number)
        node = Node('sim_node', namespace='/other', context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        node.times = []
        node.create_subscription(Clock, '/clock', node.times.append, 10)
        yield domain.number, node, executor
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_a_clock_that_another_run_follows_goes_on_until_that_has_ended(
    tmp_path, scenario, follower
):
    number, node, executor = follower
    # Slow enough to discover the follower before the end.
    run = Run(tmp_path / 'run', scenario(), '--domain-id', str(number), '--rate', '0.1')
    run.wait_for('report: ')
    run.wait_for('the clock goes on for /other')
    assert run.report['end_reason'] == 'all_found'
    with Bag(run.folder) as bag:
        assert bag.counts['/mambo/state'] > 0
    node.times.clear()
    wait_until(lambda: len(node.times) >= 20, lambda: executor.spin_once(timeout_sec=0.1))
    assert len(run.nodes()) == 1
    node.destroy_node()
    code, output = run.wait()
    assert code == 0, output
    assert run.nodes() == []


def test_the_time_limit_ends_a_run_at_the_same_step_each_time(tmp_path, scenario):
    run = Run(
        tmp_path / 'run', scenario(), '--lockstep', '--time-limit', '1.0', script={'found': 2}
    )
    code, output = run.wait()
    assert code == 1, output
    assert run.report['end_reason'] == 'time_limit'
    assert run.report['true_found'] == 2 and run.report['missed'] == 1
    assert run.report['measurements_to_find_all'] is None
    with Bag(run.folder) as bag:
        # A step that a busy machine holds up is repeated.
        steps = {item.message.step: None for item in bag.messages(['/mambo/state'])}
        assert list(steps) == list(range(20))
        steps = {item.message.step: None for item in bag.messages(['/filter_update'])}
        assert list(steps) == [0, 10]


@pytest.mark.parametrize('stop, code', [('planner_done', 0), ('all_found', 1)])
def test_the_planner_may_end_a_run(tmp_path, scenario, stop, code):
    script = {'found': 1, 'planner_node': {'finished_step': 30}}
    run = Run(tmp_path / 'run', scenario(stop=stop), '--lockstep', script=script)
    ended, output = run.wait()
    assert ended == code, output
    assert 'nothing is left to gain' in output
    assert run.report['end_reason'] == 'planner_done'


@pytest.mark.parametrize(
    ('node', 'fault', 'said'),
    [
        ('filter_node', 'raise', 'exited with 1'),
        ('mambo/driver', 'die', 'was killed by SIGKILL'),
        ('sim_node', 'die', 'was killed by SIGKILL'),
    ],
)
def test_a_node_that_dies_ends_the_run_and_is_named(tmp_path, scenario, node, fault, said):
    script = {node: {'fault': fault, 'fault_step': 15}}
    run = Run(tmp_path / 'run', scenario(), '--lockstep', script=script)
    code, output = run.wait()
    assert code == 3, output
    assert f'/{node} {said}' in output
    # The end of its log.
    assert fault != 'raise' or 'RuntimeError: a scripted fault' in output
    assert run.report['end_reason'] == 'node_died'
    (event,) = run.report['events']
    assert event['node'] == f'/{node}' and event['event'] == 'died'
    assert run.nodes() == []
    with Bag(run.folder) as bag:
        assert bag.counts['/lockstep/step'] >= 15
        *_, last = bag.messages(['/mambo/cmd_vel'])
    # The robot of a dead driver is told to stop.
    assert node != 'mambo/driver' or last.message.twist.linear.x == 0.0


def test_a_node_that_dies_again_and_again_is_given_up(tmp_path, scenario):
    limits = {'time': 20.0, 'start': 30.0, 'silence': 20.0, 'restarts': 1}
    script = {'second/driver': {'fault': 'die', 'fault_step': 5}}
    path = scenario(on_exit='respawn', limits=limits)
    run = Run(tmp_path / 'run', path, '--lockstep', script=script)
    code, output = run.wait()
    assert code == 3, output
    assert 'after 1 restarts' in output


def test_a_node_that_hangs_ends_the_run_and_is_named(tmp_path, scenario):
    node = 'second/driver'
    script = {node: {'fault': 'hang', 'fault_step': 7}}
    run = Run(tmp_path / 'run', scenario(), '--lockstep', script=script)
    code, output = run.wait()
    assert code == 3, output
    assert f'step 7: nothing from /{node}' in output
    assert run.report['end_reason'] == 'node_hung'


@pytest.mark.parametrize('on_exit', ['end', 'respawn'])
def test_a_node_in_an_endless_loop_ends_a_free_run_or_is_started_again(tmp_path, scenario, on_exit):
    # The executor's thread is busy for ever: the process lives.
    fault = {'fault': 'loop', 'fault_step': 5, 'marker': str(tmp_path / 'looped')}
    limits = {'time': 120.0, 'start': 60.0, 'silence': 90.0}
    path = scenario(on_exit=on_exit, limits=limits)
    run = Run(tmp_path / 'run', path, '--no-record', script={'filter_node': fault})
    code, output = run.wait()
    assert '/filter_node hangs: no heartbeat for 4.' in output
    events = [item['event'] for item in run.report['events'] if 'node' in item]
    assert run.nodes() == [] and not (run.folder / 'bag').exists()
    if on_exit == 'end':
        assert (code, run.report['end_reason'], events) == (3, 'node_hung', ['hung']), output
    else:
        assert (code, events) == (0, ['hung', 'restarted']), output
        assert 'it is killed' in output and 'it is restarted' in output


def test_a_node_that_never_gets_ready_is_named(tmp_path, scenario):
    limits = {'time': 20.0, 'start': 5.0, 'silence': 5.0}
    script = {'filter_node': {'fault': 'silent'}}
    run = Run(tmp_path / 'run', scenario(limits=limits), script=script)
    code, output = run.wait()
    assert code == 3, output
    assert '/filter_node is not ready' in output
    assert run.report['end_reason'] == 'not_ready'


def test_deaf_nodes_are_killed_and_no_robot_goes_on(tmp_path, scenario):
    script = {name: {'fault': 'deaf'} for name in ('filter_node', 'mambo/driver')}
    run = Run(tmp_path / 'run', scenario(), '--lockstep', script=script)
    code, output = run.wait()
    assert code == 0, output
    killed = next(line for line in output.splitlines() if 'had to be killed' in line)
    assert '/filter_node' in killed and '/mambo/driver' in killed
    assert run.nodes() == []
    with Bag(run.folder / 'bag') as bag:
        topics = ['/mambo/cmd_vel', '/second/cmd_vel']
        last = {item.topic: item.message for item in bag.messages(topics)}
    # The deaf driver has not said so itself.
    assert [last[topic].twist.linear.x for topic in topics] == [0.0, 0.0]


@pytest.mark.parametrize(
    'number, said',
    [(signal.SIGINT, 'nodes in ROS domain'), (signal.SIGTERM, 'measurements')],
)
def test_an_interrupt_leaves_no_process_and_a_readable_recording(tmp_path, scenario, number, said):
    script = {'found': 0}
    run = Run(tmp_path / 'run', scenario(), '--rate', '1.0', script=script)
    run.wait_for(said)
    run.process.send_signal(number)
    code, output = run.wait()
    assert code == 130, output
    assert 'Traceback' not in output
    assert run.nodes() == []
    assert run.report['end_reason'] == 'interrupted'
    with Bag(run.folder) as bag:
        assert bag.scenario()['name'] == 'scripted'


def test_wrong_input_is_told_before_anything_starts(tmp_path, scenario):
    run = Run(tmp_path / 'run', scenario(stopp=1), '--lockstep')
    code, output = run.wait()
    assert code == 2
    assert 'scripted.yaml' in output and "did you mean 'stop'" in output
    assert not (tmp_path / 'run').exists()


@pytest.mark.parametrize(
    'options, words',
    [
        (['--domain-id', '-1'], '--domain-id'),
        (['--seed', '-1'], '--seed'),
        (['--seed', '1.5'], '--seed'),
        (['--rate', '0'], '--rate'),
        (['--time-limit', 'nan'], '--time-limit'),
        (['--time-limit', 'inf'], '--time-limit'),
        (['--lockstepp'], '--lockstepp'),
        (['--lokstep'], 'unknown: --lokstep (did you mean --lockstep?)'),
        (['--follow-clock'], '--follow-clock needs the --domain-id'),
        (['--follow-clock', '--domain-id', '7', '--lockstep'], 'allowed without --lockstep'),
        (['--namespace', '1a'], "read '1a', allowed are letters"),
    ],
)
def test_wrong_options_are_named(options, words, capsys):
    with pytest.raises(SystemExit) as caught:
        parse(['mambo', *options])
    assert caught.value.code == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        ({'planner': 'masi'}, "--planner: planner.name: unknown planner 'masi'"),
        ({'namespace': 'team/mambo'}, "read 'team/mambo', allowed is a name that is none of"),
    ],
)
def test_what_does_not_fit_the_scenario_is_named_with_the_option(options, words):
    with pytest.raises(ScenarioError, match=re.escape(words)):
        ScenarioRun(Options('mambo', **options), interruption=False)


def test_options_win_over_the_scenario():
    options = Options('mambo', planner='lawnmower', seed=9, time_limit=3.0)
    run = ScenarioRun(options, interruption=False)
    scenario = run.mission.scenario
    assert scenario.planner.name == 'lawnmower'
    assert scenario.limits.time == 3.0
    assert scenario.seed == 9


def test_a_folder_that_holds_a_run_is_not_overwritten(tmp_path):
    assert make_folder(tmp_path / 'run') == tmp_path / 'run'
    (tmp_path / 'run' / 'report.json').write_text('{}')
    with pytest.raises(ScenarioError, match='holds a run already'):
        make_folder(tmp_path / 'run')
    (tmp_path / 'file').write_text('')
    with pytest.raises(ScenarioError, match=r'--out: .*file'):
        make_folder(tmp_path / 'file')


def test_folders_named_by_the_time_are_new_ones(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = {make_folder(None) for _ in range(3)}
    assert len(folders) == 3
    assert all(folder.parent == tmp_path / 'runs' for folder in folders)
