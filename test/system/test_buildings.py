"""Searches of buildings: a planner process for each robot, and a link of limited range."""

import os
import signal

import numpy as np
import pytest
from scenario_runs import of_topic, run_scenario, start

from maasi_sim.run.buildings.scenario import load_cuboid_scenario, mission_of

pytestmark = pytest.mark.system


def small(**changes):
    """Return a search of one building by two robots, 16 cuboids."""
    content = load_cuboid_scenario('buildings_four').content()
    content['robots'] = {name: content['robots'][name] for name in ('blue', 'green')}
    content['planner']['objects'] = content['planner']['objects'][:1]
    content['planner'].update(horizon=6, time_limit=1e9)
    return content | changes


def place_of(state):
    return np.array([state['pose']['pose']['position'][axis] for axis in 'xyz'])


def test_robots_share_a_building_and_the_nodes_do_what_one_process_does(tmp_path):
    run = run_scenario(small(), tmp_path / 'run', '--lockstep', '--seed', 3)
    assert run.code == 0, run.output
    report = run.report
    assert report['cuboids']['visited'] == report['cuboids']['total'] == 16
    assert report['end_reason'] == 'all_found'
    assert report['collisions'] == 0
    assert set(report['choices']) == {'optimal'}
    assert report['most_heard'] == 1
    assert all(number > 0 for number in report['measurements'].values())
    assert (run.folder / 'report.png').stat().st_size > 20_000
    shots = report['snapshots']
    chances = [shot['detection_probability'] for shot in shots]
    assert report['least_detection_probability'] == min(chances) > 0.7
    assert sum(report['measurements'].values()) == len(shots) >= 16
    assert '16 of 16 cuboids visited (ended: all cuboids visited)' in run.output
    # Nobody but sim and planners takes part.
    logs = sorted(path.stem for path in run.folder.glob('*.log'))
    assert logs == ['blue_cuboid_planner', 'green_cuboid_planner', 'sim_node']

    mission = mission_of(load_cuboid_scenario(tmp_path / 'search.yaml', {'seed': (('seed',), 3)}))
    record = mission.run(200)
    assert report['time_to_find_all'] == record.steps
    for name, path in record.paths.items():
        states = of_topic(run, f'/{name}/state')
        ours = np.array([place_of(state) for state in states])
        assert ours == pytest.approx(path[: len(ours)], abs=1e-6)
        assert len(ours) >= record.steps
    assert [(shot['cuboid'], shot['agent'], shot['time']) for shot in report['snapshots']] == [
        (shot.cuboid, shot.robot, shot.step) for shot in record.snapshots
    ]


def test_the_link_has_a_range_and_batteries_fail(tmp_path):
    events = [
        {'at': 4.0, 'robot': 'green', 'do': 'leave'},
        {'at': 9.0, 'robot': 'green', 'do': 'back'},
    ]
    content = small(stop='planner_done', events=events)
    for robot in content['robots'].values():
        robot['hazard'].update(alpha=14.0, recharge_steps=[2, 4])
    content['planner'].update(communication_range=40.0)
    run = run_scenario(content, tmp_path / 'run', '--lockstep', '--time-limit', 300)
    assert run.code == 0, run.output
    report = run.report
    assert report['end_reason'] == 'planner_done' and report['missed'] == 0
    assert report['collisions'] == 0
    words = {(event['agent'], event['event']) for event in report['events']}
    assert {('green', 'lost'), ('green', 'joined')} <= words
    assert {'returning', 'recharging', 'searching'} <= {word for _, word in words}
    places = {
        name: {state['step']: place_of(state) for state in of_topic(run, f'/{name}/state')}
        for name in ('blue', 'green')
    }
    heard = [item['step'] for item in of_topic(run, '/blue/link/rx') if item['messages']]
    assert len(heard) > 2
    for step in heard:
        assert np.linalg.norm(places['blue'][step] - places['green'][step]) <= 40.0
        assert not 4 <= step < 9


def test_a_killed_planner_stops_nobody_and_takes_up_its_work(tmp_path):
    with start(small(on_exit='respawn'), tmp_path / 'run', '--rate', 4) as run:
        run.wait_for(r' [1-9]\d* visited of')
        os.kill(*run.processes('/green/cuboid_planner'), signal.SIGKILL)
        run.finish()
    assert run.code == 0, run.output
    assert 'restarting it' in run.output
    steps = [item['step'] for item in of_topic(run, '/green/decision')]
    gaps = np.diff(steps)
    lost, away = steps[int(np.argmax(gaps))], gaps.max()
    # It was away for a while, the other one went on, and it came back.
    assert away > 1 and steps[-1] > lost
    others = [item['step'] for item in of_topic(run, '/blue/decision')]
    assert sum(lost < step < lost + away for step in others) >= away // 2
