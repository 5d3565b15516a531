"""Whole scenarios: separate processes over DDS, from camera image to found target."""

import json
import os
import signal
import subprocess

import pytest
import yaml
from scenario_runs import PATIENCE, command, processes_with, run_scenario, wait_for

from maasi_sim.bag import Bag
from maasi_sim.replay import plain
from maasi_sim.scenario import load_scenario
from maasi_sim.search import search

pytestmark = pytest.mark.system


def of_topic(run, topic):
    with Bag(run.bag) as bag:
        return [plain(item.message) for item in bag.messages([topic])]


def replay(run, folder):
    return subprocess.run(
        [*command('mambo_turtlebot', folder)[:3], '--replay', str(run.bag)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


def test_the_demo_finds_all_targets(tmp_path):
    run = run_scenario('mambo_turtlebot', tmp_path / 'run', '--seed', 2, '--lockstep')
    assert run.code == 0, run.output
    report = run.report
    assert report['true_found'] == 12
    assert report['missed'] == report['false_found'] == 0
    assert report['rmse'] <= 0.08
    assert report['end_reason'] == 'all_found'
    assert (run.folder / 'report.png').stat().st_size > 10_000
    for name in ('sim_node', 'mambo_driver', 'turtlebot_driver', 'filter_node', 'planner_node'):
        assert (run.folder / f'{name}.log').exists()


def test_a_run_beside_another_does_not_hear_it(repeated):
    first, _ = repeated
    other = first.folder.parent / 'other'
    assert json.loads((other / 'report.json').read_text())['seed'] == 4
    with Bag(other / 'bag') as bag:
        steps = [item.message.step for item in bag.messages(['/lockstep/step'])]
    # Of two clocks some steps would be there twice.
    assert steps == list(range(len(steps))) and len(steps) >= 100


def test_the_same_seed_gives_the_same_run_to_the_bit(repeated):
    first, second = repeated
    assert first.code == second.code, first.output + second.output
    decisions = of_topic(first, '/decisions')
    assert len(decisions) > 3
    assert decisions == of_topic(second, '/decisions')
    updates = of_topic(first, '/filter_update')
    assert len(updates) > 50
    assert updates == of_topic(second, '/filter_update')
    assert first.report['found'] == second.report['found']


def test_the_nodes_decide_as_the_search_in_one_process(repeated):
    run, _ = repeated
    scenario = load_scenario('mambo_turtlebot', {'limit': (('limits', 'time'), 20.0)})
    result = search(scenario, 3)
    decisions = of_topic(run, '/decisions')
    assert len(result.decisions) == len(decisions)
    for ours, theirs in zip(result.decisions, decisions):
        assert ours.step == theirs['step']
        for robot in theirs['robots']:
            waypoint = ours.robots[robot['robot']].waypoint.tolist()
            assert waypoint == [robot['waypoint'][axis] for axis in 'xyz']
    found = [target.position.tolist() for target in result.found_targets]
    assert found == [list(item['position']) for item in run.report['found']]


def test_the_bag_holds_the_run(repeated):
    run, _ = repeated
    with Bag(run.bag) as bag:
        facts = bag.scenario()
        topics = {topic for topic, _, _, _ in bag.raw(None)}
    assert facts['seed'] == 3
    for topic in ('/clock', '/mambo/odom', '/turtlebot/scan', '/particles', '/markers'):
        assert topic in topics
    assert any(topic.endswith('image_raw/compressed') for topic in topics)


def test_a_replay_finds_the_same(repeated, tmp_path):
    run, _ = repeated
    done = replay(run, tmp_path)
    assert done.returncode == 0, done.stdout
    assert 'equal to the bit' in done.stdout


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


def test_ranging_drones_search_space(tmp_path):
    options = ('--seed', 1, '--lockstep', '--time-limit', 30)
    run = run_scenario('ranging_pair_3d', tmp_path / 'run', *options)
    assert run.code in (0, 1), run.output
    assert sum(run.report['measurements'].values()) >= 40
    assert len(run.report['found']) >= 1


def test_independent_robots_share_what_they_find_and_nothing_else(tmp_path):
    """A filter and a planner for each robot decide as the search in one process; 002, section 4."""
    scenario = load_scenario('ranging_pair_3d').content()
    scenario['planner'] = {'name': 'maas', 'coordination': 'independent', 'alpha': 1.0}
    # The first target is for both to see.
    for robot, start in (('drone1', [100.0, 60.0, 60.0]), ('drone2', [100.0, 130.0, 60.0])):
        scenario['robots'][robot]['start'] = start
        scenario['robots'][robot]['candidates'] = {'ring': 6, 'distance': 12.0}
    scenario['targets'] = {'positions': [[100.0, 95.0, 70.0], [60.0, 70.0, 60.0], [250.0] * 3]}
    scenario['limits']['time'] = 30.0
    file = tmp_path / 'independent.yaml'
    file.write_text(yaml.safe_dump(scenario))
    run = run_scenario(file, tmp_path / 'run', '--seed', 1, '--lockstep')
    assert run.code == 1, run.output
    result = search(load_scenario(file), 1)
    assert len(result.found_targets) == 2
    for name in ('drone1', 'drone2'):
        ours = [item for item in result.decisions if name in item.robots]
        theirs = of_topic(run, f'/{name}/decisions')
        assert len(ours) >= 5
        assert [item.step for item in ours] == [item['step'] for item in theirs]
        for one, other in zip(ours, theirs):
            waypoint = other['robots'][0]['waypoint']
            assert one.robots[name].waypoint.tolist() == [waypoint[axis] for axis in 'xyz']
        # Both find the second target at the same time; it is the first one's then.
        last = of_topic(run, f'/{name}/found_targets')[-1]['targets']
        assert [item['robot'] for item in last] == ['drone1', 'drone1']
    report = run.report
    assert report['end_reason'] == result.end_reason
    assert [item['position'] for item in report['found']] == [
        target.position.tolist() for target in result.found_targets
    ]
    assert report['measurements'] == result.measurements
    done = replay(run, tmp_path)
    assert done.returncode == 0, done.stdout
    assert 'equal to the bit' in done.stdout


def test_without_targets_the_planner_says_when_nothing_is_left(tmp_path):
    run = run_scenario('no_targets', tmp_path / 'run', '--lockstep', '--no-record')
    assert run.code == 0, run.output
    report = run.report
    assert report['end_reason'] == 'planner_done'
    assert report['found'] == []
    # The same as in one process, to the last measurement.
    result = search(load_scenario('no_targets'), report['seed'])
    assert result.end_reason == 'planner_done'
    assert report['measurements'] == result.measurements
    assert report['time_to_find_all'] is None


@pytest.mark.parametrize('name', ['asi', 'as', 'mutual_information', 'nearest_widest', 'lawnmower'])
def test_every_planner_runs_in_the_planner_node(tmp_path, name):
    options = ('--planner', name, '--lockstep', '--no-record', '--time-limit', 12)
    run = run_scenario('ranging_drone_3d', tmp_path / 'run', *options)
    assert run.code == 1, run.output
    report = run.report
    assert report['planner'] == name
    assert report['end_reason'] == 'time_limit'
    assert report['decisions'] >= 1
    assert report['measurements']['drone'] >= 1
    assert report['distance']['drone'] > 50.0


def test_free_running_finds_targets_too(tmp_path):
    options = ('--seed', 1, '--time-limit', 12, '--rate', 1)
    run = run_scenario('mambo_turtlebot', tmp_path / 'run', *options)
    assert run.code in (0, 1), run.output
    assert run.report['false_found'] == 0
    assert sum(run.report['measurements'].values()) >= 20


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


def test_a_killed_node_is_started_again_where_the_scenario_says_so(tmp_path):
    content = load_scenario('mambo').content()
    content['on_exit'] = 'respawn'
    file, folder = tmp_path / 'respawn.yaml', tmp_path / 'run'
    file.write_text(yaml.safe_dump(content))
    process = under_way(file, folder, '--lockstep', '--time-limit', 40)
    kill(folder, 'filter_node')
    output, _ = process.communicate(timeout=PATIENCE)
    assert process.returncode in (0, 1), output
    with Bag(folder / 'bag') as bag:
        updates = [item.message.batch_id for item in bag.messages(['/filter_update'])]
        batches = [item.message.id for item in bag.messages(['/measurement_batch'])]
    report = json.loads((folder / 'report.json').read_text())
    assert [event['node'] for event in report['events'] if event['event'] == 'restarted'] == [
        '/filter_node'
    ]
    # It takes part again: the last batches are answered.
    assert updates[-1] >= batches[-1] - 1 and len(batches) > 30
    assert 'started again' in output


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
