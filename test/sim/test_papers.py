"""Tests of the papers' experiments: each in a small version, with all that it writes."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import yaml

from maasi_sim.experiments import results
from maasi_sim.experiments.campaign import Here, carry_out, plan
from maasi_sim.experiments.outputs import write_outputs
from maasi_sim.experiments.registry import experiments

KNOWN = experiments()


@pytest.mark.parametrize('name', list(KNOWN))
def test_small_version_writes_what_makes_sense(name, tmp_path):
    experiment = KNOWN[name]
    work = plan(experiment, tmp_path, 1, small=True)
    assert carry_out(work, Here()) == []
    write_outputs(work.folder, work.results(), 1)
    folder = tmp_path / name
    assert not plan(experiment, tmp_path, 1, small=True).tasks

    for case in work.cases:
        run = results.load_run(work.folder.file(case, 0))
        assert run.seed == experiment.seed(0) and run.columns
        check_search(run, case.settings)
    with (folder / 'runs.csv').open() as stream:
        assert len(list(csv.DictReader(stream))) == len(work.cases)
    configuration = yaml.safe_load((folder / 'configuration.yaml').read_text())
    assert list(configuration['cases']) == [case.name for case in work.cases]
    # Whoever repeats the paper has had to choose something, and says why.
    assert configuration['choices']
    assert all(item['reason'] for item in configuration['choices'])
    table = (folder / 'table.csv').read_text()
    for case in work.cases:
        assert case.name in table
    picture = (folder / 'figure.png').read_bytes()
    assert picture.startswith(b'\x89PNG') and len(picture) > 5000


def check_search(run, settings):
    columns, summary = run.columns, run.summary
    scenario = settings['scenario']
    low, high = np.array(scenario['environment']['bounds'], float).T
    assert (np.diff(columns['measurements']) > 0).all()
    assert (np.diff(columns['step']) > 0).all()
    assert columns['time'] == pytest.approx(columns['step'] * scenario['step'])
    assert (columns['true_found'] <= columns['found']).all()
    assert (columns['true_found'] <= summary['targets']).all()
    assert summary['measurements'] == columns['measurements'][-1]
    # The last measurements are of all robots that measure at that step.
    assert summary['measurements'] < settings['most_measurements'] + len(scenario['robots'])
    assert summary['targets'] == len(run.details['truth'])
    assert summary['found'] == columns['true_found'][-1]
    assert summary['false_found'] == len(run.details['found']) - summary['found']
    assert summary['end_reason'] in (
        'all_found',
        'planner_done',
        'time_limit',
        'measurement_limit',
    )
    members = np.zeros(len(columns['step']))
    for robot in scenario['robots']:
        place = np.stack([columns[f'{robot}_{axis}'] for axis in 'xyz'], axis=1)
        inside = place[:, : len(low)]
        assert (inside >= low - 0.5).all() and (inside <= high + 0.5).all()
        members += columns[f'{robot}_measures']
    np.testing.assert_array_equal(np.cumsum(members), columns['measurements'])
    if summary['found']:
        assert 0.0 <= summary['rmse'] <= settings['scenario']['scoring']['radius']


def test_maps_of_one_figure_are_those_of_its_neighbour():
    # Paths are drawn of a run of the curves, and the same drones search the same maps.
    assert KNOWN['000-fig5'].seed(0) == KNOWN['000-fig4'].seed(0)
    assert KNOWN['000-fig7'].seed(0) == KNOWN['000-fig6'].seed(0)
    assert KNOWN['000-fig12'].seed(0) == KNOWN['000-fig11'].seed(0)
    assert KNOWN['000-table1'].seed(0) != KNOWN['000-fig4'].seed(0)


def test_recommended_and_paper_see_the_same_maps():
    experiment = KNOWN['000-fig4']
    outcomes = {
        case.name: experiment.run(case.settings, experiment.seed(3))
        for case in experiment.cases(True)
        if case.name in ('ASI', 'ASI, recommended')
    }
    truths = [outcome.details['truth'] for outcome in outcomes.values()]
    assert truths[0] == truths[1] and len(truths[0]) == 12
