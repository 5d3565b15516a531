"""Planners and kinds of teams through separate processes."""

import pytest
import yaml
from scenario_runs import of_topic, replay, run_scenario

from maasi_sim.scenario.loading import load_scenario
from maasi_sim.search import search

pytestmark = pytest.mark.system


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
