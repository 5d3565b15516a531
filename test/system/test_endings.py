"""How runs end, what they leave, and who is blamed."""

import os
import re
import signal
import subprocess
import sys

import pytest
from scenario_runs import command, run_scenario, start, started, wait_for, write_scenario

from maasi_filter.ros import middleware
from maasi_sim.run.bag import Bag
from maasi_sim.run.ending import NOT_WRITTEN
from maasi_sim.run.missions import checked_mission
from maasi_sim.run.progress import ProgressDisplay
from maasi_sim.run.run_folder import make_folder
from maasi_sim.run.run_options import Options, parse
from maasi_sim.run.run_scenario import main
from maasi_sim.scenario.layering import ScenarioError

pytestmark = pytest.mark.system
NEAR, FAR = [[1.9, 1.9]], [[0.0, 0.0]]
# A planner that is never ready, or fails as soon as it is asked.
SCRIPTED = """
import time
from pydantic import BaseModel
from maasi_planner.planners.base import Planner


class Scripted(Planner):
    class Settings(BaseModel):
        fault: str

    def __init__(self, settings):
        super().__init__(settings)
        if self.own.fault == 'waits':
            time.sleep(1e6)

    def decide(self, team):
        raise RuntimeError('a scripted fault')
"""
# What would take minutes waits until it is interrupted.
LONG = """
import sys, time
from maasi_sim.run import run_scenario, scenario_run

def wait(*_):
    print('busy', flush=True)
    while True:
        time.sleep(0.05)

scenario_run.store_report = wait
scenario_run.in_background = lambda *_: map(wait, [0])
sys.exit(run_scenario.main(sys.argv[1:]))
"""
# A recorder with a gap.
GAP = """
import sys
from maasi_sim.run import recorder_node, run_scenario

recorder_node.Recorder.gaps = lambda *_: ['a gap']
sys.exit(run_scenario.main(sys.argv[1:]))
"""


def scripted(folder, fault, **changes):
    (folder / 'scripted.py').write_text(SCRIPTED)
    planner = {'name': 'scripted:Scripted', 'settings': {'fault': fault}}
    return write_scenario(folder / 'search.yaml', FAR, planner=planner, **changes)


def test_a_node_that_dies_again_and_again_is_given_up(tmp_path):
    limits = {'time': 60.0, 'restarts': 1}
    path = scripted(tmp_path, 'raises', on_exit='respawn', limits=limits)
    run = run_scenario(path, tmp_path / 'run', '--lockstep')
    assert run.code == 3, run.output
    assert '/planner_node exited with 1, after 1 restart (limits.restarts)' in run.output
    # The end of its log.
    assert 'RuntimeError: a scripted fault' in run.output
    assert run.report['end_reason'] == 'node_died'
    assert [(item['node'], item['event']) for item in run.report['events']] == [
        ('/planner_node', 'restarted'),
        ('/planner_node', 'died'),
    ]


def test_nodes_that_never_get_ready_are_named(tmp_path):
    path = scripted(tmp_path, 'waits', limits={'start': 10.0})
    with start(path, tmp_path / 'run') as run:
        # A free run waits for the guards as well.
        wait_for(lambda: run.processes('/mambo/guard'), 'no guard')
        os.kill(run.processes('/mambo/guard')[0], signal.SIGSTOP)
        run.finish()
    assert run.code == 3, run.output
    (line,) = re.findall(r'ended: (.*) is not ready after 10 s \(limits.start\)', run.output)
    # On a busy machine others may be late as well.
    assert {'/mambo/guard', '/planner_node'} <= set(line.split(' is not ready, '))
    assert run.report['end_reason'] == 'not_ready'


def test_a_start_that_is_ended_leaves_no_process_and_a_readable_recording(tmp_path):
    with start(write_scenario(tmp_path / 'far.yaml', FAR), tmp_path / 'run') as run:
        run.wait_for('nodes in ROS domain')
        run.process.send_signal(signal.SIGTERM)
        run.finish()
    assert run.code == 130, run.output
    assert 'Traceback' not in run.output
    assert run.processes() == []
    assert run.report['end_reason'] == 'interrupted'
    with Bag(run.folder) as bag:
        assert bag.scenario()['name'] == 'far'


def test_report_and_replay_of_a_long_run_may_be_skipped(tmp_path):
    path = write_scenario(tmp_path / 'near.yaml', NEAR)
    words = [sys.executable, '-c', LONG, *command(path, tmp_path / 'run', '--lockstep')[3:]]
    with started(words, tmp_path / 'run') as run:
        run.wait_for('Ctrl-C skips each')
        for _ in ('report', 'replay'):
            run.wait_for('busy')
            run.process.send_signal(signal.SIGTERM)
            run.process.send_signal(signal.SIGINT)
        run.finish()
    assert run.code == 0, run.output
    assert not (run.folder / 'report.json').exists()
    with Bag(run.bag) as bag:
        assert bag.counts['/filter_update'] > 0


def test_a_run_needs_no_home_folder_and_leaves_no_warning(tmp_path):
    names = ('HOME', 'ROS_HOME', 'ROS_LOG_DIR', 'XDG_RUNTIME_DIR', 'XDG_CACHE_HOME')
    poor = ['env', *(f'--unset={name}' for name in names), 'LC_ALL=C']
    path, folder = write_scenario(tmp_path / 'near.yaml', NEAR), tmp_path / """it's "here" """
    with started([*poor, *command(path, folder)], folder, umask=0o077) as run:
        run.finish()
    assert run.code == 0, run.output
    assert '1 of 1 targets found' in run.output
    assert run.report['end_reason'] == 'all_found'
    with Bag(run.folder) as bag:
        assert bag.counts['/mambo/state'] > 0
    assert run.processes() == []
    assert run.warnings == []


def test_a_gap_of_the_recording_is_in_report_and_exit_code(tmp_path):
    path = write_scenario(tmp_path / 'near.yaml', NEAR)
    words = [sys.executable, '-c', GAP, *command(path, tmp_path / 'run', '--lockstep')[3:]]
    with started(words, tmp_path / 'run') as run:
        run.finish()
    assert run.code == NOT_WRITTEN, run.output
    assert 'error: a gap' in run.output
    (event,) = run.report['events']
    assert (event['node'], event['event'], event['reason']) == ('recorder', 'gap', 'a gap')


def test_wrong_input_is_told_before_anything_starts(tmp_path):
    run = run_scenario(write_scenario(tmp_path / 'wrong.yaml', NEAR, stopp=1), tmp_path / 'run')
    assert run.code == 2
    assert 'wrong.yaml' in run.output and "did you mean 'stop'" in run.output
    assert not run.folder.exists()


def test_a_middleware_that_is_not_there_is_named(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_none_cpp')
    assert main(['mambo', '--out', str(tmp_path / 'run')]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: RMW_IMPLEMENTATION: read 'rmw_none_cpp', which is not installed")
    assert 'allowed is rmw_fastrtps_cpp' in said or ', rmw_fastrtps_cpp' in said
    assert not (tmp_path / 'run').exists()
    for name in ('', 'rmw_fastrtps_cpp'):
        monkeypatch.setenv('RMW_IMPLEMENTATION', name)
        assert not middleware.is_missing()


@pytest.mark.parametrize(
    'command',
    ['filter_node', 'planner_node', 'sim_node', 'turtlebot_driver', 'view_node', 'team_command'],
)
def test_a_node_or_command_without_its_middleware_says_so(command):
    environment = os.environ | {'RMW_IMPLEMENTATION': 'rmw_none_cpp'}
    run = subprocess.run([command], env=environment, capture_output=True, text=True)
    assert run.returncode == 2
    (line,) = run.stderr.splitlines()
    assert line.startswith("error: RMW_IMPLEMENTATION: read 'rmw_none_cpp', which is not installed")


@pytest.mark.parametrize(
    'options, words',
    [
        (['--domain-id', '-1'], '--domain-id'),
        (['--rate', '0'], '--rate'),
        (['--time-limit', 'nan'], '--time-limit'),
        (['--lokstep'], 'unknown: --lokstep (did you mean --lockstep?)'),
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
        ({'namespace': 'team/mambo'}, "--namespace: read 'team/mambo'"),
    ],
)
def test_what_does_not_fit_the_scenario_is_named_with_the_option(options, words):
    with pytest.raises(ScenarioError, match=re.escape(words)):
        checked_mission(Options('mambo', **options), ProgressDisplay())


def test_a_run_gets_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = {make_folder(None) for _ in range(3)}
    assert len(folders) == 3
    assert all(folder.parent == tmp_path / 'runs' for folder in folders)
    assert make_folder(tmp_path / 'run') == tmp_path / 'run'
    (tmp_path / 'run' / 'report.json').write_text('{}')
    with pytest.raises(ScenarioError, match=r'--out: .*run'):
        make_folder(tmp_path / 'run')
    (tmp_path / 'file').write_text('')
    with pytest.raises(ScenarioError, match=r'--out: .*file'):
        make_folder(tmp_path / 'file')
