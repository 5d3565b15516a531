"""Tests of the campaign runner: statistics, kept runs, resumption, bad input."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import stats

from maasi_sim import machine
from maasi_sim.experiments import (
    campaign,
    execution,
    registry,
    reproduce,
    results,
    statistics,
    tables,
)
from maasi_sim.experiments.campaign import SerialExecutor, carry_out, plan
from maasi_sim.experiments.cases import Case, Comparison, Outcome, Published, Quantity
from maasi_sim.experiments.experiment import Experiment

STEPS = Quantity('steps', 'steps', '', 'restricted')
ERROR = Quantity('error', 'error', 'm')
LIMIT = 40


def toy_run(settings, seed):
    """Return a run in which the number of steps depends on settings and seed alone."""
    generator = np.random.default_rng([seed, settings['bias']])
    steps = settings['bias'] + int(generator.integers(10, 60))
    made.append((settings['bias'], seed))
    if settings.get('fails'):
        raise RuntimeError('lost its way')
    return Outcome(
        {'steps': steps if steps <= LIMIT else None, 'limit': LIMIT, 'error': math.nan},
        {'step': np.arange(3), 'value': generator.normal(size=3)},
        {'truth': [[0.1, 1.0 / 3.0]]},
        {'wall': 0.1},
    )


made: list[tuple[int, int]] = []


@pytest.fixture
def toy(monkeypatch):
    """Register an experiment of three cases that takes no time, and nothing else."""
    made.clear()
    experiment = Experiment(
        name='000-toy',
        title='A toy',
        cases=lambda small: [
            Case('first', {'bias': 1}),
            Case('second', {'bias': 5}, 'recommended'),
            Case('once', {'bias': 2}, runs=1),
        ],
        run=toy_run,
        quantities=(STEPS, ERROR),
        draw=lambda figure, results: figure.add_subplot().plot([0, 1]),
        published=(Published('first', 'steps', 30.0, 2.0, note='table 9'),),
        comparisons=(Comparison('first', 'second', 'steps'),),
        runs=4,
    )
    monkeypatch.setattr(registry, 'PAPERS', ('toy',))
    monkeypatch.setattr(registry, 'paper_experiments', lambda number: [experiment])
    return experiment


def run_files(out: Path) -> dict[str, str]:
    """Return the files of the runs without the time they took."""
    found = {}
    for file in (out / '000-toy' / 'runs').glob('*.csv'):
        run = results.load_run(file)
        assert run.timing.pop('processor_time') >= 0.0
        found[file.name] = results.to_text(run)
    return found


# Statistics


def test_mean_interval_is_that_of_scipy():
    values = np.array([3.0, 4.5, 7.0, 1.0, 9.5])
    low, high = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    result = statistics.mean_interval([*values, math.nan])
    assert result.number == 5
    assert (result.mean - result.half_width, result.mean + result.half_width) == pytest.approx(
        (low, high)
    )


def test_mean_interval_of_few_values():
    assert math.isnan(statistics.mean_interval([]).mean)
    one = statistics.mean_interval([4.0])
    assert one.mean == 4.0 and math.isnan(one.half_width)


def test_paired_difference_is_that_of_scipy():
    generator = np.random.default_rng(3)
    first, second = generator.normal(5.0, 2.0, 12), generator.normal(4.0, 2.0, 12)
    low, high = stats.ttest_rel(first, second).confidence_interval(0.95)
    result = statistics.paired_difference(first, second)
    assert (result.mean - result.half_width, result.mean + result.half_width) == pytest.approx(
        (low, high)
    )


def test_independent_difference_is_that_of_welch():
    generator = np.random.default_rng(4)
    first, second = generator.normal(5.0, 1.0, 10), generator.normal(3.0, 4.0, 7)
    test = stats.ttest_ind(first, second, equal_var=False)
    low, high = test.confidence_interval(0.95)
    published = statistics.mean_interval(second)
    result = statistics.independent_difference(
        statistics.mean_interval(first),
        statistics.from_published(published.mean, published.half_width, 7),
    )
    assert (result.mean - result.half_width, result.mean + result.half_width) == pytest.approx(
        (low, high)
    )


def test_difference_from_a_number_without_spread_has_our_spread():
    ours = statistics.mean_interval([1.0, 2.0, 4.0])
    result = statistics.independent_difference(ours, statistics.from_published(2.0, None, 10))
    assert result.half_width == pytest.approx(ours.half_width)
    assert result.mean == pytest.approx(ours.mean - 2.0)


def test_restricted_mean_is_the_area_under_scipys_survival_curve():
    times = np.array([2.0, 3.0, 3.0, 5.0, 6.0, 8.0, 9.0, 11.0])
    ended = np.array([True, True, False, True, False, True, True, True])
    limit = 10.0
    sample = stats.CensoredData.right_censored(times, ~ended)
    survival = stats.ecdf(sample).sf
    grid = np.linspace(0.0, limit, 200_001)
    area = survival.evaluate(0.5 * (grid[1:] + grid[:-1])).sum() * (grid[1] - grid[0])
    result = statistics.restricted_mean(times, ended, limit)
    assert result.mean == pytest.approx(area, abs=1e-4)
    assert 0.0 < result.half_width < limit


def test_restricted_mean_counts_a_run_that_did_not_get_there_with_the_limit():
    result = statistics.restricted_mean([10.0, 20.0, 30.0, 30.0], [True, True, False, False], 30.0)
    expected = statistics.mean_interval([10.0, 20.0, 30.0, 30.0])
    assert result == expected


def test_greenwoods_variance_is_students_without_censoring():
    times = np.array([1.0, 2.0, 4.0, 7.0])
    plain = statistics.restricted_mean(times, np.ones(4, bool), 9.0)
    # A run cut short after all others have ended, below the limit, takes the other way.
    other = statistics.restricted_mean([*times, 8.0], [True] * 4 + [False], 9.0)
    assert plain.mean == 3.5
    assert other.mean == pytest.approx((1.0 + 2.0 + 4.0 + 7.0 + 9.0) / 5.0)


@pytest.mark.parametrize(
    ('times', 'ended', 'limit'),
    [([1.0, math.nan], [True, True], 2.0), ([1.0], [True], math.inf), ([1.0], [True, True], 2.0)],
)
def test_restricted_mean_refuses(times, ended, limit):
    with pytest.raises(ValueError):
        statistics.restricted_mean(times, ended, limit)


# Runs and their files


def test_run_reads_back_the_same_to_the_bit(toy):
    case = toy.cases(False)[0]
    run = results.run_of(toy.name, case, 3, 17, toy.run(case.settings, 17))
    text = results.to_text(run)
    again = results.from_text(text)
    assert results.to_text(again) == text
    assert again.details == {'truth': [[0.1, 1.0 / 3.0]]}
    assert again.summary['error'] is None
    np.testing.assert_array_equal(again.columns['value'], run.columns['value'])


@pytest.mark.parametrize(
    'damage',
    [
        lambda text: text[:-5],
        lambda text: text.replace('"limit": 40', '"limit": 41'),
        lambda text: '',
        lambda text: text[1:],
    ],
)
def test_damaged_run_is_made_again_and_no_other(toy, tmp_path, damage, capsys):
    assert reproduce.main(['000-toy', '--out', str(tmp_path), '--workers', '1']) == 0
    before = run_files(tmp_path)
    made.clear()
    file = tmp_path / '000-toy' / 'runs' / 'second-0002.csv'
    file.write_text(damage(file.read_text()))
    assert reproduce.main(['000-toy', '--out', str(tmp_path), '--workers', '1']) == 0
    assert made == [(5, toy.seed(2))]
    said = capsys.readouterr().err
    assert 'second-0002.csv' in said and 'repeated' in said
    after = run_files(tmp_path)
    assert after.keys() == before.keys()
    assert after == before


def test_columns_of_different_lengths_are_refused(toy):
    case = toy.cases(False)[0]
    with pytest.raises(ValueError, match='columns'):
        results.run_of(toy.name, case, 0, 1, Outcome({}, {'a': [1.0], 'b': [1.0, 2.0]}))


# Campaigns


def test_interrupted_campaign_goes_on_without_losing_or_doubling_a_run(toy, tmp_path, monkeypatch):
    whole = tmp_path / 'whole'
    assert reproduce.main(['000-toy', '--out', str(whole), '--workers', '1']) == 0
    made.clear()
    parts = tmp_path / 'parts'

    def interrupt(*_):
        if len(made) == 5:
            raise KeyboardInterrupt
        return original(*_)

    original = campaign.execute
    monkeypatch.setattr(campaign, 'execute', interrupt)
    assert reproduce.main(['000-toy', '--out', str(parts), '--workers', '1']) == 130
    assert len(run_files(parts)) == 5
    monkeypatch.setattr(campaign, 'execute', original)
    assert reproduce.main(['000-toy', '--out', str(parts), '--workers', '1']) == 0
    # Four maps of two cases, and one of the third.
    assert len(made) == len(set(made)) == 9
    assert run_files(parts) == run_files(whole)
    for name in ('steps.csv', 'table.csv', 'table.md', 'configuration.yaml'):
        assert (parts / '000-toy' / name).read_text() == (whole / '000-toy' / name).read_text()


def test_more_maps_later_keep_the_first(toy, tmp_path):
    assert reproduce.main(['000-toy', '--out', str(tmp_path), '--workers', '1', '--runs', '2']) == 0
    first = run_files(tmp_path)
    assert len(first) == 5
    made.clear()
    assert reproduce.main(['000-toy', '--out', str(tmp_path), '--workers', '1', '--runs', '3']) == 0
    assert len(made) == 2
    assert first.items() <= run_files(tmp_path).items()


def test_other_settings_are_run_anew(toy, tmp_path):
    here = SerialExecutor()
    carry_out(plan(toy, tmp_path, 1), here)
    changed = Experiment(**{**toy.__dict__, 'cases': lambda small: [Case('first', {'bias': 2})]})
    assert [task.case for task in plan(changed, tmp_path, 1).tasks] == ['first']
    assert not plan(toy, tmp_path, 1).tasks


def test_no_room_on_the_disk_is_said_and_nothing_is_lost(toy, tmp_path, monkeypatch, capsys):
    synced = os.fsync
    written = []

    def full(descriptor):
        if len(written) == 3:
            raise OSError(errno.ENOSPC, 'No space left on device')
        written.append(descriptor)
        synced(descriptor)

    monkeypatch.setattr(os, 'fsync', full)
    assert reproduce.main(['000-toy', '--out', str(tmp_path), '--workers', '1']) == 3
    said = capsys.readouterr().err
    assert 'no room on the disk' in said and 'kept' in said
    files = sorted(path.name for path in (tmp_path / '000-toy' / 'runs').iterdir())
    assert len(files) == 3 and not any(name.startswith('.') for name in files)
    monkeypatch.setattr(os, 'fsync', synced)
    made.clear()
    assert reproduce.main(['000-toy', '--out', str(tmp_path), '--workers', '1']) == 0
    assert len(made) == 6


def test_folder_that_cannot_be_made_is_said(toy, tmp_path, capsys):
    (tmp_path / 'file').write_text('')
    code = reproduce.main(['000-toy', '--out', str(tmp_path / 'file'), '--workers', '1'])
    assert code == 3
    assert 'cannot be written' in capsys.readouterr().err


def test_run_that_fails_leaves_the_others(toy, tmp_path, monkeypatch, capsys):
    cases = [Case('first', {'bias': 1}), Case('second', {'bias': 5, 'fails': True})]
    failing = Experiment(**{**toy.__dict__, 'cases': lambda small: cases})
    monkeypatch.setattr(registry, 'paper_experiments', lambda number: [failing])
    assert reproduce.main(['000-toy', '--out', str(tmp_path), '--workers', '1']) == 1
    said = capsys.readouterr().err
    assert 'second, map' in said and 'lost its way' in said
    assert (tmp_path / '000-toy' / 'table.md').exists()


def test_worker_with_other_settings_is_noticed(toy):
    task = campaign.Task('000-toy', 'first', 0, 1, False, 'another')
    text, problem = campaign.execute(task)
    assert text == '' and 'another version' in problem


# What is written


def test_outputs_hold_what_was_run(toy, tmp_path):
    assert reproduce.main(['000-toy', '--out', str(tmp_path), '--workers', '1']) == 0
    folder = tmp_path / '000-toy'
    steps = (folder / 'steps.csv').read_text().splitlines()
    assert steps[0] == 'case,map,step,value'
    assert len(steps) == 1 + 3 * 9
    runs = (folder / 'runs.csv').read_text().splitlines()
    assert len(runs) == 1 + 9
    configuration = yaml.safe_load((folder / 'configuration.yaml').read_text())
    assert configuration['cases']['second'] == {
        'preset': 'recommended',
        'runs': 4,
        'settings': {'bias': 5},
    }
    assert configuration['maps'] == {number: toy.seed(number) for number in range(4)}
    table = (folder / 'table.md').read_text()
    assert '30 ± 2 (table 9)' in table
    assert 'first minus second' in table
    assert (folder / 'figure.png').read_bytes().startswith(b'\x89PNG')


def test_table_compares_with_the_paper_and_in_pairs(toy, tmp_path):
    work = plan(toy, tmp_path, 4)
    carry_out(work, SerialExecutor())
    got = work.results()
    table = {(row.case, row.quantity.name): row for row in tables.rows(got)}
    row = table['first', 'steps']
    values = [LIMIT if value is None else value for value in got.values('first', 'steps')]
    assert row.ours.mean == pytest.approx(np.mean(values))
    assert row.difference.mean == pytest.approx(np.mean(values) - 30.0)
    # With more than half of the runs cut short there is no median.
    assert math.isnan(row.median) == (sum(value == LIMIT for value in values) >= 2)
    assert tables.median(np.array([3.0, np.nan, 9.0]), STEPS) == 9.0
    assert math.isnan(tables.median(np.array([3.0, np.nan, np.nan]), STEPS))
    assert tables.median(np.array([3.0, np.nan, 9.0]), ERROR) == 6.0
    assert ('first', 'error') not in table
    other = [LIMIT if value is None else value for value in got.values('second', 'steps')]
    [pair] = tables.paired_rows(got)
    assert pair.difference.mean == pytest.approx(np.mean(values) - np.mean(other))
    json.dumps([run.summary for run in got.runs['first']], allow_nan=False)


def test_page_says_what_was_run_and_what_was_not(toy, tmp_path, capsys):
    out = tmp_path / 'out'
    arguments = ['000-toy', '--out', str(out), '--workers', '1', '--runs', '3']
    file = tmp_path / 'docs' / 'page.md'
    assert reproduce.main([*arguments, '--document', str(file)]) == 0
    text = file.read_text()
    assert '1 to 3 runs of each case, the paper has 4' in text
    assert '30 ± 2 (table 9)' in text and 'first minus second' in text
    picture = file.parent / 'reproduction' / '000-toy.png'
    assert picture.read_bytes().startswith(b'\x89PNG')
    assert f'reproduction/{picture.name}' in text
    assert reproduce.main(['000-toy', '--out', str(out), '--workers', '1']) == 0
    assert reproduce.main(['--document', str(file), '--out', str(out)]) == 0
    assert 'not in full' not in file.read_text()
    new = tmp_path / 'docs' / 'new.md'
    assert reproduce.main(['--document', str(new), '--out', str(tmp_path / 'nothing')]) == 0
    assert '**not run**' in new.read_text()


def test_page_keeps_the_tables_of_what_was_not_run_again(toy, tmp_path, capsys):
    """Tables and picture stay, marked as earlier ones; text is that of the present code."""
    file = tmp_path / 'docs' / 'page.md'
    arguments = ['000-toy', '--out', str(tmp_path / 'out'), '--workers', '1']
    assert reproduce.main([*arguments, '--document', str(file)]) == 0
    first = file.read_text()
    tables = [line for line in first.splitlines() if line.startswith('| first')]
    assert len(tables) >= 2
    picture = (file.parent / 'reproduction' / '000-toy.png').read_bytes()
    for _ in range(2):
        text = file.read_text().replace('first minus second', 'FIRST minus second')
        file.write_text(text.replace('# The papers', '# Old words'))
        assert reproduce.main(['--document', str(file), '--out', str(tmp_path / 'nothing')]) == 0
        text = file.read_text()
        # A row that is not in the results, so that it can only be from the page.
        assert 'FIRST minus second' in text
        assert 'Old words' not in text
        assert [line for line in text.splitlines() if line.startswith('| first')] == [
            line for line in tables if 'minus' not in line
        ]
        assert 'each case, from an earlier campaign.' in text
        assert 'campaign, from an earlier' not in text
    assert (file.parent / 'reproduction' / '000-toy.png').read_bytes() == picture
    # What is run again replaces it.
    assert reproduce.main([*arguments, '--document', str(file)]) == 0
    assert file.read_text() == first


def test_only_some_cases_run_again_leave_the_rows_of_the_others(toy, tmp_path, capsys):
    file = tmp_path / 'docs' / 'page.md'
    arguments = ['000-toy', '--workers', '1', '--document', str(file)]
    assert reproduce.main([*arguments, '--out', str(tmp_path / 'old')]) == 0
    before = file.read_text()
    name = toy.cases(False)[0].name
    options = ['--case', name, '--runs', '2', '--out', str(tmp_path / 'new')]
    assert reproduce.main([*arguments, *options]) == 0
    after = file.read_text()
    for row in (line for line in before.splitlines() if line.startswith('| ')):
        cells = [cell.strip() for cell in row.strip('|').split('|')]
        if cells[0] in ('case', 'paired on the same maps', 'experiment') or len(cells) < 4:
            continue
        marked = '| ' + ' | '.join([*cells[:2], f'{cells[2]} (earlier)', *cells[3:]]) + ' |'
        # Of the case that was run again there is the new row only.
        assert (marked in after) == (cells[0] != name), row
        assert row not in after or cells[0] == name
    assert f'| {name} | steps | 1 of 2 |' in after or f'| {name} | steps | 2 of 2 |' in after
    assert reproduce.main([*arguments, '--case', 'none such']) == 2
    assert name in capsys.readouterr().err


# Command line


def test_unknown_name_gets_the_nearest(capsys):
    assert reproduce.main(['000-fgi4']) == 2
    assert '000-fig4' in capsys.readouterr().err


@pytest.mark.parametrize(
    'arguments', [[], ['000-fig4', '--runs', '0'], ['000-fig4', '--workers', 'two']]
)
def test_wrong_arguments_end_with_2(arguments):
    with pytest.raises(SystemExit) as ended:
        reproduce.main(arguments)
    assert ended.value.code == 2


def test_cluster_that_does_not_answer_is_said(monkeypatch, capsys, tmp_path, toy):
    monkeypatch.setattr(campaign.Cluster.__init__, '__defaults__', (1.0,))
    code = reproduce.main(['000-toy', '--out', str(tmp_path), '--cluster', 'tcp://127.0.0.1:1'])
    assert code == 3
    assert 'no scheduler answers' in capsys.readouterr().err


def test_workers_of_a_cluster_say_on_what_they_run(toy, tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, processes=False, dashboard_address=None) as local:
        workers = campaign.Cluster(local.scheduler_address)
        try:
            machines = workers.machines()
            assert len(machines) == 2
            assert all(item == machine.this_machine() for item in machines.values())
            work = plan(toy, tmp_path, 1)
            assert carry_out(work, workers, machine=campaign.one_machine(workers, [work])) == []
            assert len(work.done) == 3
        finally:
            workers.close()


def test_names_are_unique_and_listed(capsys):
    assert reproduce.main(['--list']) == 0
    listed = capsys.readouterr().out
    for name, experiment in registry.experiments().items():
        assert name in listed
        cases = experiment.cases(False)
        names = [case.name for case in cases]
        assert len(names) == len(set(names))
        assert len({case.slug for case in cases}) == len(names)
        known = {item.name for item in experiment.quantities}
        for item in experiment.published:
            assert item.case in names and item.quantity in known
        for pair in experiment.comparisons:
            assert pair.first in names and pair.second in names and pair.quantity in known


def test_command_ends_cleanly_when_interrupted(tmp_path):
    code = (
        'import os, signal, sys\n'
        'from maasi_sim.experiments import campaign, reproduce\n'
        'campaign.execute = lambda task: os.kill(os.getpid(), signal.SIGTERM)\n'
        "arguments = ['000-fig4', '--small', '--workers', '1', '--out', sys.argv[1]]\n"
        'sys.exit(reproduce.main(arguments))\n'
    )
    ended = subprocess.run(
        [sys.executable, '-c', code, str(tmp_path)], capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 130
    assert 'Traceback' not in ended.stderr


# Machines


class Elsewhere(SerialExecutor):
    """Workers on machines that differ in what is given."""

    def __init__(self, *changes: dict[str, str], makes: dict[str, str] | None = None) -> None:
        self.changes = changes
        self.makes = makes or {}

    def machines(self):
        return {
            f'tcp://{number}': {**machine.this_machine(), **change}
            for number, change in enumerate(self.changes)
        }

    def make(self, tasks):
        for task, text, problem in super().make(tasks):
            run = results.from_text(text)
            run.machine.update(self.makes)
            yield task, results.to_text(run), problem


@pytest.fixture
def elsewhere(monkeypatch):
    """Let the workers of the command be those that are given."""

    def use(workers):
        monkeypatch.setattr(execution, 'make_workers', lambda *_: workers)

    return use


def test_run_says_on_what_it_was_made(toy, tmp_path):
    work = plan(toy, tmp_path, 1)
    carry_out(work, SerialExecutor())
    for case in work.cases:
        made_on = results.load_run(work.folder.file(case, 0)).machine
        assert made_on == machine.this_machine()
    assert made_on['numpy'] == np.__version__
    assert all(made_on[key] for key in ('processor', 'features', 'python', 'numba', 'llvmlite'))


def test_file_without_a_machine_is_read(toy, tmp_path):
    work = plan(toy, tmp_path, 1)
    carry_out(work, SerialExecutor())
    file = work.folder.file(work.cases[0], 0)
    first, second, rest = file.read_text().split('\n', 2)
    facts = json.loads(second[2:])
    del facts['machine']
    body = f'# {json.dumps(facts)}\n{rest}'
    file.write_text(f'# maasi run, sha256 {hashlib.sha256(body.encode()).hexdigest()}\n{body}')
    assert results.load_run(file).machine == {}
    assert first != file.read_text().split('\n', 1)[0]
    again = plan(toy, tmp_path, 2)
    assert len(again.done) == 3 and len(again.tasks) == 2
    assert campaign.one_machine(SerialExecutor(), [again]) == machine.this_machine()


def test_workers_that_differ_are_refused_unless_asked(toy, tmp_path, elsewhere, capsys):
    arguments = ['000-toy', '--out', str(tmp_path)]
    elsewhere(Elsewhere({}, {}, {'processor': 'i486', 'numba': '0.1'}))
    assert reproduce.main(arguments) == 2
    said = capsys.readouterr().err
    here = machine.this_machine()
    assert 'tcp://2 differs from worker tcp://0' in said and '--mixed-workers' in said
    assert f'processor i486 instead of {here["processor"]}' in said
    assert f'Numba 0.1 instead of {here["numba"]}' in said
    assert 'NumPy' not in said
    assert not made and not run_files(tmp_path)
    assert reproduce.main([*arguments, '--mixed-workers']) == 0
    assert len(made) == len(run_files(tmp_path)) == 9


def test_runs_of_another_machine_are_not_mixed_unless_asked(toy, tmp_path, elsewhere, capsys):
    arguments = ['000-toy', '--out', str(tmp_path)]
    other = {'features': '0123456789ab'}
    elsewhere(Elsewhere(other, makes=other))
    assert reproduce.main([*arguments, '--runs', '1']) == 0
    kept = run_files(tmp_path)
    elsewhere(SerialExecutor())
    # With nothing to make, nothing is mixed.
    assert reproduce.main([*arguments, '--runs', '1']) == 0
    capsys.readouterr()
    assert reproduce.main([*arguments, '--runs', '2']) == 2
    said = capsys.readouterr().err
    assert 'first-0000.csv was made on another machine' in said
    assert 'processor features 0123456789ab' in said
    assert run_files(tmp_path) == kept
    assert reproduce.main([*arguments, '--runs', '2', '--mixed-workers']) == 0
    assert kept.items() < run_files(tmp_path).items()


def test_run_of_a_worker_that_came_later_and_differs_is_not_kept(toy, tmp_path, elsewhere, capsys):
    elsewhere(Elsewhere({}, makes={'numpy': '1.0'}))
    assert reproduce.main(['000-toy', '--out', str(tmp_path), '--runs', '1']) == 1
    said = capsys.readouterr().err
    assert 'first, map 0: not kept, made by a different worker: NumPy 1.0' in said
    assert not run_files(tmp_path)
