"""Tests of the tables of search quality: times to find, regimes, the document."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import quality
import search_quality
import search_regimes

from maasi_sim.experiments.searches import find_times


def test_find_times():
    """Each target has the time at which so many were found, those that were not the limit."""
    progress = [SimpleNamespace(time=t, true_found=n) for t, n in ((1.0, 0), (2.0, 2), (5.0, 3))]
    result = SimpleNamespace(truth=[0] * 4, progress=progress)
    assert find_times(result, 9.0).tolist() == [2.0, 2.0, 5.0, 9.0]


@pytest.mark.parametrize('regime', search_regimes.REGIMES)
def test_every_regime_has_every_planner(regime):
    """All scenarios are valid, what is compared differs, and the reference stands first."""
    cases = search_quality.comparison(regime, list(search_regimes.KINDS)).cases(False)
    assert len({case.digest() for case in cases}) == len(search_regimes.KINDS)
    assert cases[0].name == search_quality.REFERENCE


def test_the_document_keeps_what_is_around_the_table(tmp_path):
    """Writing it twice replaces the first table."""
    file = tmp_path / 'page.md'
    file.write_text(f'above\n{search_quality.BEGIN}\n{search_quality.END}\nbelow\n')
    search_quality.write(file, 'one\n')
    search_quality.write(file, 'two\n')
    expected = f'above\n{search_quality.BEGIN}\ntwo\n{search_quality.END}\nbelow\n'
    assert file.read_text() == expected


def test_a_regime_is_run_and_its_table_printed(tmp_path, capsys):
    arguments = ['one drone', '--planner', 'maasi', '--runs', '1', '--jobs', '1']
    assert search_quality.main([*arguments, '--out', str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert '**one drone** (limit 400 s)' in said and '| maasi | 1 |' in said


def test_runs_cut_short_count_as_kaplan_and_meier_have_it():
    times, whole = np.array([10.0, 20.0, 30.0]), np.ones(3, np.bool_)
    mean, error = quality.restricted_mean(times, whole, 100.0)
    assert mean == pytest.approx(20.0)
    assert error == pytest.approx(np.std(times, ddof=1) / np.sqrt(3))
    mean, _ = quality.restricted_mean(times, np.array([True, False, True]), 40.0)
    assert mean == pytest.approx(10.0 + 20.0 * 2 / 3)
    assert quality.restricted_mean(times, whole, 25.0)[0] == pytest.approx(55.0 / 3)
