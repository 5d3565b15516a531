"""Tests of ./scripts/compare: searches that are kept, what is written, and its statistics."""

import csv
import json
import pickle

import numpy as np
import pytest
import yaml
from small_field import SMALL_FIELD

from maasi_sim.experiments import campaign, compare, searches

PLANNERS = ['nearest_widest', 'lawnmower']


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / 'field.yaml'
    path.write_text(yaml.safe_dump(SMALL_FIELD))
    return path


@pytest.fixture
def executed(monkeypatch):
    made: list[tuple[str, int]] = []
    original = campaign.execute

    def execute(task):
        made.append((task.case.name, task.number))
        return original(task)

    monkeypatch.setattr(campaign, 'execute', execute)
    return made


def command(scenario, out, *more, seeds=2):
    arguments = [str(scenario), '--planner', ','.join(PLANNERS), '--runs', str(seeds)]
    if out is not None:
        arguments += ['--out', str(out)]
    return compare.main([*arguments, '--jobs', '1', *more])


def test_comparison_is_written_and_not_made_twice(scenario, tmp_path, executed, capsys):
    out = tmp_path / 'out'
    assert command(scenario, out, '--seed', '7') == 0
    assert sorted(executed) == sorted((name, seed) for name in PLANNERS for seed in (7, 8))
    assert 'lawnmower minus nearest_widest' in capsys.readouterr().out
    facts = json.loads((out / 'comparison.json').read_text())
    cases = facts['scenarios']['field']['cases']
    assert list(cases) == PLANNERS and facts['seeds'] == [7, 8]
    times = {name: [run['time'] for run in case['runs']] for name, case in cases.items()}
    [gap] = [
        item
        for item in facts['scenarios']['field']['differences']
        if item['quantity'] == 'time' and item['case'] == 'lawnmower'
    ]
    expected = np.mean(np.subtract(times['lawnmower'], times['nearest_widest']))
    assert gap['mean'] == pytest.approx(expected) and gap['number'] == 2
    rows = list(csv.DictReader((out / 'comparison.csv').open()))
    [row] = [row for row in rows if row['minus'] and row['quantity'] == 'time']
    assert float(row['mean']) == pytest.approx(expected)
    page = (out / 'comparison.md').read_text()
    assert '| lawnmower | 2 |' in page and 'Seeds 7 to 8' in page
    assert (out / 'comparison.png').read_bytes().startswith(b'\x89PNG')
    runs = list(csv.DictReader((out / 'field' / 'runs.csv').open()))
    assert [run['seed'] for run in runs] == ['7', '8'] * 2
    del executed[:]
    assert command(scenario, out, '--seed', '7', seeds=3) == 0
    assert sorted(executed) == [('lawnmower', 9), ('nearest_widest', 9)]


def test_interrupted_comparison_goes_on_in_its_folder(scenario, tmp_path, executed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command(scenario, None) == 0
    [folder] = (tmp_path / 'runs').iterdir()
    # Interrupted ones have no results, and lack searches.
    (folder / 'comparison.json').unlink()
    (folder / 'field' / 'runs' / 'lawnmower-0002.json').unlink()
    assert command(scenario, None) == 0
    assert (folder / 'comparison.json').exists() and executed[4:] == [('lawnmower', 2)]
    # It is finished: the same command once more is another comparison.
    assert command(scenario, None) == 0
    assert len(list((tmp_path / 'runs').iterdir())) == 2


def test_other_settings_and_other_code_are_noticed(
    scenario, tmp_path, executed, monkeypatch, capsys
):
    out = tmp_path / 'out'
    assert command(scenario, out, seeds=1) == 0
    del executed[:]
    assert command(scenario, out, '--time-limit', '5', seeds=1) == 2
    said = capsys.readouterr().err
    assert '2 searches there are of other settings' in said and '--again' in said
    # What a cluster sends.
    task = campaign.plan(searches.compared(scenario, PLANNERS), tmp_path / 'new', 1).tasks[0]
    monkeypatch.setattr(searches, 'code_digest', lambda: 'another')
    assert 'another version of the code' in campaign.execute(pickle.loads(pickle.dumps(task)))
    del executed[:]
    assert command(scenario, out, seeds=1) == 2
    assert not executed
    assert command(scenario, out, '--again', seeds=1) == 0
    assert len(executed) == 2
    assert command(scenario, out, seeds=1) == 0
    assert len(executed) == 2


def test_planner_of_ones_own_is_compared_and_its_changes_are_noticed(
    scenario, tmp_path, executed, monkeypatch
):
    name = 'own_planner_to_compare'
    module = tmp_path / f'{name}.py'
    text = (
        'from maasi_planner.planners import NearestWidest\n\nclass Mine(NearestWidest):\n    pass\n'
    )
    module.write_text(text)
    arguments = [str(scenario), '--planner', f'lawnmower,{name}:Mine', '--runs', '1']
    arguments += ['--jobs', '1', '--out', str(tmp_path / 'out')]
    assert compare.main(arguments) == 0
    assert executed == [('lawnmower', 1), (f'{name}:Mine', 1)]
    facts = json.loads((tmp_path / 'out' / 'comparison.json').read_text())
    assert facts['scenarios']['field']['cases'][f'{name}:Mine']['planner'] == f'{name}:Mine'
    module.write_text(f'# Another one.\n{text}')
    assert compare.main(arguments) == 2
    assert compare.main([*arguments, '--again']) == 0
    # The other planner's search is kept.
    assert executed[2:] == [(f'{name}:Mine', 1)]


def test_a_changed_filter_of_ones_own_is_other_code(scenario, tmp_path):
    name = 'own_filter_to_compare'
    module = tmp_path / f'{name}.py'
    text = 'from maasi_filter.pmb.filter import PmbFilter\n\nclass Mine(PmbFilter):\n    pass\n'
    codes = []
    for line in ('', '# Another one.\n'):
        module.write_text(line + text)
        (case,) = searches.compared(scenario, [], [f'{name}:Mine'], 4.0).cases(False)
        codes.append(case.settings['code'])
    assert codes[0] != codes[1]


def test_filters_are_compared_with_each_planner(scenario):
    cases = searches.compared(scenario, PLANNERS, ['pmb', 'ic_phd'], 4.0).cases(False)
    assert [case.name for case in cases] == [
        f'{planner}, {method}' for method in ('pmb', 'ic_phd') for planner in PLANNERS
    ]
    settings = [case.settings['scenario'] for case in cases]
    assert [item['filter']['method'] for item in settings] == ['pmb', 'pmb', 'ic_phd', 'ic_phd']
    assert {item['limits']['time'] for item in settings} == {4.0}


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['nothing_like_it'], 'known are'),
        (['field.yaml', '--planner', 'maasi,none_such'], 'none_such'),
        (['field.yaml', '--planner', 'maasi,maasi'], 'different names'),
        (['field.yaml', '--filter', 'kalman'], 'pmb'),
        (['field.yaml', 'field.yaml'], 'different names'),
        (['field.yaml', '--runs', '0'], 'from 1 to 9999'),
        (['field.yaml', '--seed', '1.5'], 'whole numbers'),
        (['field.yaml', '--time-limit', '-1'], 'above 0'),
        (['buildings_one'], 'searches for targets'),
    ],
)
def test_bad_input(scenario, monkeypatch, arguments, words, capsys):
    monkeypatch.chdir(scenario.parent)
    with pytest.raises(SystemExit) as ended:
        raise SystemExit(compare.main([*arguments, '--jobs', '1']))
    assert ended.value.code == 2
    assert words in capsys.readouterr().err
    assert not (scenario.parent / 'runs').exists()
