"""Tests of the papers' experiments: each in a small version, with all that it writes."""

import csv

import numpy as np
import pytest
import yaml
from distributed import LocalCluster

from maasi_sim.experiments import reproduce
from maasi_sim.experiments.campaign import Workers, plan
from maasi_sim.experiments.outputs import write_outputs
from maasi_sim.experiments.papers import experiments
from maasi_sim.experiments.runs import load_run
from maasi_sim.run.view.recording import event_log
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.search import search

KNOWN = experiments()


@pytest.mark.parametrize('name', list(KNOWN))
def test_small_version_writes_what_makes_sense(name, tmp_path):
    experiment = KNOWN[name]
    work = plan(experiment, tmp_path, 1, small=True)
    assert work.carry_out(Workers()) == []
    write_outputs(work, 1)
    folder = tmp_path / name
    assert not plan(experiment, tmp_path, 1, small=True).tasks

    for case in work.cases.values():
        run = load_run(work.file(case.name, 0))
        assert run.seed == experiment.seed(0) and run.columns
        if 'scenario' in case.settings:
            check_search(run, case.settings)
        elif name != '004-table1':
            summary = run.summary
            assert summary['complete'] and summary['visited'] == summary['cuboids'] > 0
            assert summary['outside'] == 0
            # As printed, corners of objects may be cut between samples.
            between = case.settings['mission'].get('between_samples', True)
            assert summary['collisions'] == 0 or not between
            assert run.columns['visited'][-1] == summary['cuboids']
            shots = {shot['cuboid'] for shot in run.details['snapshots']}
            assert shots == set(range(summary['cuboids']))
    with (folder / 'runs.csv').open() as stream:
        assert len(list(csv.DictReader(stream))) == len(work.cases)
    configuration = yaml.safe_load((folder / 'configuration.yaml').read_text())
    assert list(configuration['cases']) == list(work.cases)
    # Each paper leaves something open; without a reason it just does not say.
    assert configuration['choices']
    assert all(item['what'] and item['taken'] for item in configuration['choices'])
    table = (folder / 'table.csv').read_text()
    assert all(case.name in table for case in work.cases.values())
    picture = (folder / 'figure.png').read_bytes()
    assert picture.startswith(b'\x89PNG') and len(picture) > 5000


def check_search(run, settings):
    columns, summary = run.columns, run.summary
    scenario = settings['scenario']
    low, high = np.array(scenario['environment']['bounds'], float).T
    assert columns['time'] == pytest.approx(columns['step'] * scenario['step'])
    assert (columns['true_found'] <= columns['found']).all()
    # The last measurements are of all robots that measure at that step.
    assert summary['measurements'] == columns['measurements'][-1]
    assert summary['measurements'] < settings['most_measurements'] + len(scenario['robots'])
    assert summary['found'] == columns['true_found'][-1] <= len(run.details['truth'])
    assert summary['false_found'] == len(run.details['found']) - summary['found']
    members = np.zeros(len(columns['step']))
    for robot in scenario['robots']:
        place = np.stack([columns[f'{robot}_{axis}'] for axis in 'xyz'], axis=1)
        inside = place[:, : len(low)]
        assert (inside >= low - 0.5).all() and (inside <= high + 0.5).all()
        members += columns[f'{robot}_measures']
    np.testing.assert_array_equal(np.cumsum(members), columns['measurements'])


def test_cluster_makes_the_same_runs(tmp_path):
    command = ['000-fig7', '--small', '--out']
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        there = [*command, str(tmp_path / 'there'), '--cluster', cluster.scheduler_address]
        assert reproduce.main(there) == 0
    assert reproduce.main([*command, str(tmp_path / 'here'), '--jobs', '1']) == 0
    here, there = (tmp_path / place / '000-fig7' / 'steps.csv' for place in ('here', 'there'))
    assert here.read_text() == there.read_text()
    assert here.read_text().count('\n') > 30


def test_maps_of_one_figure_are_those_of_its_neighbour():
    # Paths are drawn of a run of the curves.
    assert KNOWN['000-fig5'].seed(0) == KNOWN['000-fig4'].seed(0) != KNOWN['000-table1'].seed(0)


def test_all_of_the_ablation_decides_as_the_recommended_case():
    small = [KNOWN[name].cases(True) for name in ('000-ablation', '000-fig4')]
    (every,) = (case for case in small[0] if case.name == 'all')
    (recommended,) = (case for case in small[1] if case.name == 'ASI, recommended')
    one, other = (KNOWN['000-fig4'].run(case.settings, 3).columns for case in (every, recommended))
    for column, values in one.items():
        np.testing.assert_array_equal(values, other[column], err_msg=column)


def test_robot_that_leaves_measures_no_more():
    experiment = KNOWN['000-fig11']
    case = next(case for case in experiment.cases(True) if case.name == 'MAASI')
    leave = {'at': 4.95, 'robot': 'drone2', 'do': 'leave'}
    content = {**case.settings['scenario'], 'events': [leave]}
    outcome = experiment.run({'scenario': content, 'most_measurements': 20}, 3)
    time = np.array(outcome.columns['time'])
    second = np.array(outcome.columns['drone2_measures'])
    assert second[time < 4.95].all() and not second[time >= 4.95].any()
    assert np.array(outcome.columns['drone1_measures']).all()
    assert outcome.summary['measurements'] == 20
    result = search(scenario_from_values(content, 'test'), 3, 20)
    said = [event[4:] for event in event_log(result).events if event[1] == 'log']
    assert ['drone2', 'left'] in said
    # The way is at least that from one measurement to the next.
    places = np.array([item.positions['drone1'] for item in result.progress])
    straight = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert result.distance['drone1'] >= 0.999 * straight > 1.0
    back = {'at': 8.0, 'robot': 'drone2', 'do': 'back'}
    content = {**content, 'events': [leave, back]}
    with pytest.raises(ValueError, match=r'events: read .* of drone2'):
        experiment.run({'scenario': content, 'most_measurements': 20}, 3)
