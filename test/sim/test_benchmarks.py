"""Benchmark commands, tables of search quality, and the reference that knows the targets."""

import json
import sys
from types import SimpleNamespace

import bench
import pytest
import search_quality
from clairvoyant import clairvoyant
from timing import against

from maasi_sim.experiments.searches import find_times
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.search import search


@pytest.fixture
def run_bench(monkeypatch):
    def run(*arguments):
        monkeypatch.setattr(sys, 'argv', ['bench', *map(str, arguments)])
        return bench.main()

    return run


@pytest.mark.parametrize('file', ['missing/figures.json', '.'])
def test_a_file_that_cannot_be_written_is_refused_before_the_work(
    run_bench, tmp_path, file, capsys
):
    with pytest.raises(SystemExit, match='2'):
        run_bench('drivers', '--json', tmp_path / file)
    said = capsys.readouterr()
    assert '--json: read' in said.err and said.out == ''


def test_quick_figures(run_bench, tmp_path, capsys):
    file = tmp_path / 'figures.json'
    run_bench('drivers', '--quick', '--json', file)
    rows = json.loads(file.read_text())
    assert len(rows) == len(capsys.readouterr().out.splitlines()) == 6
    assert all(row['value'] > 0.0 for row in rows)


def test_a_peer_that_is_not_installed_is_named_as_not_measured():
    def measure():
        import no_such_package  # noqa: F401

    text = bench.show(against('kernel', 2.0, 'Peer', measure))
    assert 'Peer: not measured' in text and 'no_such_package' in text
    assert '2 x faster than Peer, 4 ms' in bench.show(against('kernel', 2.0, 'Peer', lambda: 4.0))


def test_each_target_has_the_time_at_which_so_many_were_found():
    progress = [SimpleNamespace(time=t, true_found=n) for t, n in ((1.0, 0), (2.0, 2), (5.0, 3))]
    result = SimpleNamespace(truth=[0] * 4, progress=progress)
    assert find_times(result, 9.0).tolist() == [2.0, 2.0, 5.0, 9.0]


@pytest.mark.parametrize('regime', search_quality.REGIMES)
def test_every_regime_has_every_planner(regime):
    """All scenarios are valid, what is compared differs, and the reference stands first."""
    cases = search_quality.comparison(regime, list(search_quality.KINDS)).cases(False)
    assert len({case.digest() for case in cases}) == len(search_quality.KINDS)
    assert cases[0].name == 'before'


@pytest.mark.parametrize(
    ('begin', 'option', 'row'),
    [
        (search_quality.BEGIN, [], '**one drone** (limit 400 s)'),
        (search_quality.BEGIN_SHORT, ['--short'], '| one drone | 1 |'),
    ],
)
def test_a_regime_is_run_and_its_table_written(begin, option, row, tmp_path, capsys, monkeypatch):
    page, end = tmp_path / 'page.md', search_quality.END
    marks = [search_quality.BEGIN_SHORT, search_quality.BEGIN]
    page.write_text('above\n' + ''.join(f'{mark}\nold\n{end}\nbelow\n' for mark in marks))
    before = page.read_text()
    arguments = ['one drone', '--planner', 'maasi', 'tour', '--runs', '1', '--jobs', '1', *option]
    arguments += ['--out', str(tmp_path), '--document', str(page)]
    monkeypatch.setattr(sys, 'argv', ['search_quality', *arguments])
    assert search_quality.main() == 0
    said = capsys.readouterr().out
    assert row in said and ('| maasi | 1 |' in said) != bool(option)
    table = page.read_text().partition(f'{begin}\n')[2].partition(end)[0]
    assert table.startswith('Block `development`') and (table in said) == bool(option)
    assert option or '| one drone (400 s) | ' in table
    assert page.read_text().replace(table, 'old\n') == before


@pytest.mark.parametrize('name', ['ranging_drone_3d', 'mambo'])
def test_knowing_the_targets_helps(name):
    scenario = load_scenario(name)
    result = search(scenario, 20_000, planner=clairvoyant)
    assert result.complete
    assert result.steps < 0.9 * search(scenario, 20_000).steps
