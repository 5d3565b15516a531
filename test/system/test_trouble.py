"""Runs in which robots leave, nodes are killed and users interrupt."""

import json
import os
import signal
import subprocess

import pytest
import yaml
from scenario_runs import PATIENCE, command, of_topic, processes_with, run_scenario, wait_for

from maasi_sim.run.bag import Bag
from maasi_sim.scenario.loading import load_scenario

pytestmark = pytest.mark.system


def test_the_others_plan_on_when_a_robot_leaves(tmp_path):
    scenario = load_scenario('mambo_turtlebot').content()
    scenario['events'] = [
        {'at': 3.0, 'robot': 'mambo', 'do': 'leave'},
        {'at': 22.0, 'robot': 'mambo', 'do': 'back'},
    ]
    scenario['limits']['time'] = 27.0
    file = tmp_path / 'leaving.yaml'
    file.write_text(yaml.safe_dump(scenario))
    run = run_scenario(file, tmp_path / 'run', '--seed', 1, '--lockstep')
    assert run.code in (0, 1), run.output
    events = [(item['agent'], item['event']) for item in run.report['events']]
    assert ('mambo', 'lost') in events
    assert ('mambo', 'joined') in events
    alone = [
        robot['robot']
        for decision in of_topic(run, '/decisions')
        if 3.0 / 0.05 < decision['step'] < 22.0 / 0.05
        for robot in decision['robots']
    ]
    assert alone
    assert set(alone) == {'turtlebot'}
    later = [
        robot['robot']
        for decision in of_topic(run, '/decisions')
        if decision['step'] >= 22.0 / 0.05
        for robot in decision['robots']
    ]
    assert 'mambo' in later


def under_way(scenario, folder, *options):
    """Return the process of a run that has recorded something."""
    process = subprocess.Popen(
        command(scenario, folder, *options),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    wait_for(
        lambda: (
            any((folder / 'bag').glob('*.mcap'))
            and next((folder / 'bag').glob('*.mcap')).stat().st_size > 300_000
        ),
        'the run is under way',
    )
    return process


def kill(folder, name):
    """Kill a node of a run."""
    victims = [pid for pid in processes_with(f'{folder}/') if name in _command_line(pid)]
    os.kill(victims[0], signal.SIGKILL)


def _command_line(pid):
    with open(f'/proc/{pid}/cmdline', 'rb') as file:
        return file.read().decode()


@pytest.mark.parametrize('name', ['filter_node', 'turtlebot_driver'])
def test_a_killed_node_ends_the_run(tmp_path, name):
    folder = tmp_path / 'run'
    process = under_way('mambo_turtlebot', folder, '--lockstep')
    kill(folder, name)
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 3, output
    assert name.split('_', maxsplit=1)[0] in output
    with Bag(folder / 'bag') as bag:
        assert any(True for _ in bag.raw(['/clock']))
    assert not processes_with(f'{folder}/')


def test_killed_nodes_are_started_again_where_the_scenario_says_so(tmp_path):
    content = load_scenario('mambo').content()
    content['on_exit'] = 'respawn'
    file, folder = tmp_path / 'respawn.yaml', tmp_path / 'run'
    file.write_text(yaml.safe_dump(content))
    process = under_way(file, folder, '--lockstep', '--time-limit', 40)
    log = folder / 'sim_node.log'
    names = {
        'filter_node': '/filter_node',
        'mambo_driver': '/mambo/driver',
        'planner_node': '/planner_node',
    }
    for file, node in names.items():
        kill(folder, file)
        wait_for(lambda node=node: f'{node} was restarted' in log.read_text(), f'{node} is back')
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode in (0, 1), output
    with Bag(folder / 'bag') as bag:
        updates = [item.message.batch_id for item in bag.messages(['/filter_update'])]
        batches = [item.message.id for item in bag.messages(['/measurement_batch'])]
    report = json.loads((folder / 'report.json').read_text())
    assert [event['node'] for event in report['events'] if event['event'] == 'restarted'] == list(
        names.values()
    )
    # They take part again: the last batches are answered.
    assert updates[-1] >= batches[-1] - 1 and len(batches) > 30
    assert 'is restarted' in output


def test_ctrl_c_leaves_no_process_and_a_readable_bag(tmp_path):
    folder = tmp_path / 'run'
    process = under_way('mambo_turtlebot', folder)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, output
    assert 'Traceback' not in output
    assert not processes_with(f'{folder}/')
    with Bag(folder / 'bag') as bag:
        assert any(True for _ in bag.raw(['/clock']))
        # Drivers stop their robots before they go.
        last = {}
        for item in bag.messages(['/mambo/cmd_vel', '/turtlebot/cmd_vel']):
            last[item.topic] = item.message.twist
    for twist in last.values():
        assert twist.linear.x == twist.linear.y == twist.linear.z == twist.angular.z == 0.0
    assert len(last) == 2


def test_a_wrong_file_is_refused_before_anything_starts(tmp_path):
    scenario = load_scenario('mambo_turtlebot').content()
    scenario['planer'] = scenario.pop('planner')
    file = tmp_path / 'wrong.yaml'
    file.write_text(yaml.safe_dump(scenario))
    run = run_scenario(file, tmp_path / 'run')
    assert run.code == 2
    assert 'planer' in run.output
    assert str(file) in run.output
    assert not (tmp_path / 'run').exists()
