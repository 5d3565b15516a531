"""Tests of campaigns: kept runs, resumption, workers, tables, the page, bad input."""

import csv
import errno
import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import yaml

from maasi_sim import machine
from maasi_sim.experiments import campaign, papers, reproduce, runs, tables
from maasi_sim.experiments.campaign import Workers, make_workers, plan
from maasi_sim.experiments.experiment import (
    Case,
    Claim,
    Comparison,
    Experiment,
    Outcome,
    Published,
    Quantity,
)

STEPS = Quantity('steps', 'steps', '', 'restricted')
ERROR = Quantity('error', 'error', 'm')
LIMIT = 40
made: list[tuple[int, int]] = []


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
        claims=(
            Claim('the first is faster', 'steps', 'first', 'second'),
            Claim('30 steps', 'steps', case='first', expects='number'),
        ),
        runs=4,
    )
    monkeypatch.setattr(papers, 'PAPERS', ('toy',))
    monkeypatch.setattr(papers, 'paper_experiments', lambda number: [experiment])
    return experiment


def command(out, *more):
    return reproduce.main(['000-toy', '--out', str(out), '--jobs', '1', *map(str, more)])


def run_files(out: Path) -> dict[str, str]:
    """Return the files of the runs without the time they took."""
    found = {}
    for file in (out / '000-toy' / 'runs').glob('*.json'):
        run = runs.load_run(file)
        assert run.timing.pop('processor_time') >= 0.0
        found[file.name] = runs.to_text(run)
    return found


def test_damaged_run_is_made_again_and_no_other(toy, tmp_path, capsys):
    assert command(tmp_path) == 0
    before = run_files(tmp_path)
    file = tmp_path / '000-toy' / 'runs' / 'second-0002.json'
    text = file.read_text()
    for damaged in (text[:-5], text.replace('"limit": 40', '"limit": 41'), '', '[1]', text[1:]):
        made.clear()
        file.write_text(damaged)
        assert command(tmp_path) == 0
        assert made == [(5, toy.seed(2))]
        said = capsys.readouterr().err
        assert 'second-0002.json' in said and 'repeated' in said
        assert run_files(tmp_path) == before


def test_columns_of_a_run_are_of_one_length(toy):
    case = toy.cases(False)[0]
    with pytest.raises(ValueError, match='columns'):
        runs.run_of(toy.name, case, 0, 1, Outcome({}, {'a': [1.0], 'b': [1.0, 2.0]}))


@pytest.mark.parametrize('ending', [signal.SIGINT, signal.SIGTERM])
def test_interrupted_campaign_goes_on_without_losing_or_doubling_a_run(
    toy, tmp_path, monkeypatch, ending, capsys
):
    assert command(tmp_path / 'whole') == 0
    made.clear()
    original = campaign.execute

    def interrupt(*_):
        if len(made) == 5:
            os.kill(os.getpid(), ending)
        return original(*_)

    monkeypatch.setattr(campaign, 'execute', interrupt)
    assert command(tmp_path / 'parts') == 130
    assert 'the same command resumes' in capsys.readouterr().err
    assert len(run_files(tmp_path / 'parts')) == 5
    monkeypatch.setattr(campaign, 'execute', original)
    assert command(tmp_path / 'parts') == 0
    # Four maps of two cases, and one of the third.
    assert len(made) == len(set(made)) == 9
    assert run_files(tmp_path / 'parts') == run_files(tmp_path / 'whole')
    for name in ('steps.csv', 'table.csv', 'table.md', 'configuration.yaml'):
        parts, whole = (tmp_path / folder / '000-toy' / name for folder in ('parts', 'whole'))
        assert parts.read_text() == whole.read_text()


def test_more_maps_later_keep_the_first_and_other_settings_are_run_anew(toy, tmp_path):
    assert command(tmp_path, '--runs', 2) == 0
    first = run_files(tmp_path)
    assert len(first) == 5
    made.clear()
    assert command(tmp_path, '--runs', 3) == 0
    assert len(made) == 2
    assert first.items() <= run_files(tmp_path).items()
    changed = Experiment(**{**toy.__dict__, 'cases': lambda small: [Case('first', {'bias': 2})]})
    assert [task.case.name for task in plan(changed, tmp_path, 1).tasks] == ['first']
    assert not plan(toy, tmp_path, 1).tasks
    task = campaign.Task('000-toy', toy.cases(False)[0], 0, 1, toy_run, 'another')
    assert 'another version' in campaign.execute(task)


def test_no_room_on_the_disk_is_said_and_nothing_is_lost(toy, tmp_path, monkeypatch, capsys):
    synced, written = os.fsync, []

    def full(descriptor):
        if len(written) == 3:
            raise OSError(errno.ENOSPC, 'No space left on device')
        written.append(synced(descriptor))

    monkeypatch.setattr(os, 'fsync', full)
    assert command(tmp_path) == 3
    said = capsys.readouterr().err
    assert 'no room on the disk' in said and 'kept' in said
    files = [path.name for path in (tmp_path / '000-toy' / 'runs').iterdir()]
    assert len(files) == 3 and not any(name.startswith('.') for name in files)
    monkeypatch.setattr(os, 'fsync', synced)
    made.clear()
    assert command(tmp_path) == 0
    assert len(made) == 6
    (tmp_path / 'file').write_text('')
    assert command(tmp_path / 'file') == 3
    assert 'cannot be written' in capsys.readouterr().err


def test_run_that_fails_leaves_the_others(toy, tmp_path, monkeypatch, capsys):
    cases = [Case('first', {'bias': 1}), Case('second', {'bias': 5, 'fails': True})]
    failing = Experiment(**{**toy.__dict__, 'cases': lambda small: cases})
    monkeypatch.setattr(papers, 'paper_experiments', lambda number: [failing])
    assert command(tmp_path) == 1
    said = capsys.readouterr().err
    assert 'second, map' in said and 'lost its way' in said
    assert (tmp_path / '000-toy' / 'table.md').exists()


def test_outputs_hold_what_was_run_beside_the_paper_and_in_pairs(toy, tmp_path):
    assert command(tmp_path) == 0
    folder = tmp_path / '000-toy'
    steps = (folder / 'steps.csv').read_text().splitlines()
    assert steps[0] == 'case,map,step,value' and len(steps) == 1 + 3 * 9
    assert len((folder / 'runs.csv').read_text().splitlines()) == 1 + 9
    configuration = yaml.safe_load((folder / 'configuration.yaml').read_text())
    second = {'preset': 'recommended', 'runs': 4, 'settings': {'bias': 5}}
    assert configuration['cases']['second'] == second
    assert configuration['maps'] == {number: toy.seed(number) for number in range(4)}
    assert '30 ± 2 (table 9)' in (folder / 'table.md').read_text()
    assert (folder / 'figure.png').read_bytes().startswith(b'\x89PNG')
    row, *others, pair = csv.DictReader((folder / 'table.csv').open())
    got = plan(toy, tmp_path, 4).results()
    first, other = (
        np.nan_to_num(got.values(name, 'steps'), nan=LIMIT) for name in ('first', 'second')
    )
    assert (row['case'], pair['case']) == ('first', 'first - second')
    assert float(row['ours']) == pytest.approx(first.mean())
    assert float(row['difference']) == pytest.approx(first.mean() - 30.0)
    assert float(pair['difference']) == pytest.approx((first - other).mean())
    # No run has an error: there is no such row.
    assert {item['quantity'] for item in (row, *others, pair)} == {'steps'}


@pytest.mark.parametrize(
    ('values', 'quantity', 'expected'),
    [
        ([3.0, math.nan, 9.0], STEPS, 9.0),
        ([3.0, math.nan, math.nan], STEPS, math.nan),
        ([3.0, math.nan, 9.0], ERROR, 6.0),
    ],
)
def test_median_counts_unfinished_durations_as_longest(values, quantity, expected):
    assert tables.median(np.array(values), quantity) == pytest.approx(expected, nan_ok=True)


def test_page_says_what_was_run_and_keeps_what_was_not_run_again(toy, tmp_path):
    file = tmp_path / 'docs' / 'page.md'
    picture = file.parent / 'reproduction' / '000-toy.png'
    write = ('--document', file)
    assert command(tmp_path / 'out', '--runs', 3, *write) == 0
    text = file.read_text()
    assert '1 to 3 runs of each case, the paper has 4' in text
    # The difference is a claim, and stands on the page of claims only.
    assert 'paper 30±2 |' in text and 'first minus second' not in text
    assert 'reproduction/000-toy.png' in text and picture.read_bytes().startswith(b'\x89PNG')
    assert command(tmp_path / 'out', *write) == 0
    first, shown = file.read_text(), picture.read_bytes()
    claims = file.with_name('claims.md')
    claimed = claims.read_text()
    assert '| the first is faster, [000-toy](page.md#000-toy) |' in claimed
    assert 'the 2 intervals' in claimed
    assert 'not in full' not in first
    nothing = ['--out', str(tmp_path / 'nothing'), '--document']
    for _ in range(2):
        assert reproduce.main([*nothing, str(file)]) == 0
        text = file.read_text()
        assert 'runs of each case, from an earlier campaign.' in text
        assert text.replace(', from an earlier campaign', '') == first
        assert claims.read_text().count(' (earlier) | ') == 2
        assert claims.read_text().replace(' (earlier) | ', ' | ') == claimed
    # Of the case that is run again there is the new row only; the others are marked.
    assert command(tmp_path / 'new', '--case', 'first', '--runs', 2, *write) == 0
    rows = [line for line in file.read_text().splitlines() if line.startswith('| ')]
    assert [row[:13] for row in rows if row.startswith('| first |')] == ['| first | 2 |']
    old = [row for row in first.splitlines() if row.startswith(('| second', '| once'))]
    assert len(old) == 2
    for row in old:
        cells = row.split(' | ')
        cells[1] += ' (earlier)'
        assert ' | '.join(cells) in rows
    assert picture.read_bytes() == shown
    # The number rests on the new runs, the comparison on the earlier ones.
    kept = [line for line in claims.read_text().splitlines() if ' (earlier) | ' in line]
    assert [row[:21] for row in kept] == ['| the first is faster']
    assert command(tmp_path / 'out', *write) == 0
    assert file.read_text() == first
    # From the stored tables alone come the same pages.
    file.unlink()
    assert reproduce.main([*nothing, str(file), '--rewrite']) == 0
    assert file.read_text() == first and claims.read_text() == claimed
    new = tmp_path / 'docs' / 'none' / 'new.md'
    assert reproduce.main([*nothing, str(new)]) == 0
    assert '**not run**' in new.read_text()


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['000-fgi4'], '000-fig4'),
        ([], 'give names'),
        (['000-fig4', '--runs', '0'], '--runs'),
        (['000-fig4', '--jobs', 'two'], '--jobs'),
        (['000-fig4', '--case', 'none such'], "unknown case 'none such'"),
    ],
)
def test_wrong_arguments_end_with_2(arguments, words, capsys):
    with pytest.raises(SystemExit) as ended:
        raise SystemExit(reproduce.main(arguments))
    assert ended.value.code == 2
    assert words in capsys.readouterr().err


def test_names_are_unique_and_listed_and_what_is_named_is_there(capsys):
    assert reproduce.main(['--list']) == 0
    listed = capsys.readouterr().out
    for name, experiment in papers.experiments().items():
        assert name in listed
        cases = experiment.cases(False)
        names = [case.name for case in cases]
        assert len(names) == len(set(names)) == len({case.slug for case in cases})
        known = {item.name for item in experiment.quantities}
        printed = {(item.case, item.quantity) for item in experiment.published}
        for case, quantity in printed:
            assert case in names and quantity in known
        for pair in (*experiment.comparisons, *experiment.claims):
            assert pair.quantity in known, pair
        words = [claim.says for claim in experiment.claims]
        assert len(words) == len(set(words)), name
        for claim in experiment.claims:
            assert (claim.expects == 'number') == bool(claim.case), claim
            assert not claim.case or (claim.case, claim.quantity) in printed, claim
        pairs = [claim for claim in experiment.claims if not claim.case]
        for pair in (*experiment.comparisons, *pairs):
            assert {pair.first, pair.second} <= set(names), pair


def test_cluster_that_does_not_answer_is_said(monkeypatch, capsys, tmp_path, toy):
    monkeypatch.setattr(campaign, 'PATIENCE', 1.0)
    assert command(tmp_path, '--cluster', 'tcp://127.0.0.1:1') == 3
    assert 'no scheduler answers' in capsys.readouterr().err


def _die(number):
    os._exit(number)


def test_worker_that_dies_is_said():
    team = make_workers(2, 2)
    try:
        with pytest.raises(campaign.WorkersLost, match='a worker died'):
            list(team.make(_die, [1, 2]))
    finally:
        team.close()


@pytest.fixture
def elsewhere(monkeypatch):
    """Let the command have workers on machines with these changes, that make runs on another."""

    def use(*changes, makes=None):
        here = machine.this_machine()
        machines = {f'tcp://{n}': {**here, **change} for n, change in enumerate(changes)}
        team = Workers(machines=machines)
        original = Workers.make

        def make(function, items):
            for task, run in original(team, function, items):
                run.machine.update(makes or {})
                yield task, run

        team.make = make
        monkeypatch.setattr(campaign, 'make_workers', lambda *_: team)

    return use


def test_workers_that_differ_are_refused_unless_asked(toy, tmp_path, elsewhere, capsys):
    elsewhere({}, {}, {'processor': 'i486', 'numba': '0.1'})
    assert command(tmp_path) == 2
    said = capsys.readouterr().err
    here = machine.this_machine()
    assert 'tcp://2 differs from worker tcp://0' in said and '--mixed-workers' in said
    assert f'processor i486 instead of {here["processor"]}' in said
    assert f'Numba 0.1 instead of {here["numba"]}' in said and 'NumPy' not in said
    assert not made
    assert command(tmp_path, '--mixed-workers') == 0
    assert len(made) == len(run_files(tmp_path)) == 9


def test_runs_of_another_machine_are_not_mixed_unless_asked(toy, tmp_path, elsewhere, capsys):
    other = {'features': '0123456789ab'}
    elsewhere(other, makes=other)
    assert command(tmp_path, '--runs', 1) == 0
    kept = run_files(tmp_path)
    elsewhere({})
    # With nothing to make, nothing is mixed.
    assert command(tmp_path, '--runs', 1) == 0
    assert command(tmp_path, '--runs', 2) == 2
    said = capsys.readouterr().err
    assert 'first-0000.json was made on another machine' in said
    assert 'processor features 0123456789ab' in said
    assert run_files(tmp_path) == kept
    assert command(tmp_path, '--runs', 2, '--mixed-workers') == 0
    assert kept.items() < run_files(tmp_path).items()
    # Those of a worker that came later and differs are not kept.
    elsewhere({}, makes={'numpy': '1.0'})
    assert command(tmp_path / 'later', '--runs', 1) == 1
    said = capsys.readouterr().err
    assert 'first, map 0: not kept, made by a different worker: NumPy 1.0' in said
    assert not run_files(tmp_path / 'later')
