"""Tests of the table of search quality: times to find, kept runs, the document."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

import search_quality
import search_regimes

RUN = search_quality.Run(
    regime='mambo',
    kind='before',
    seed=7,
    digest='abc',
    complete=True,
    false_found=0,
    time=30.0,
    mean_time=10.0,
    measurements=100,
    distance=9.0,
    decision=0.01,
    slowest=0.02,
    took=1.0,
)


def test_find_times():
    """Each target has the time at which so many were found, those that were not the limit."""
    progress = [SimpleNamespace(time=t, true_found=n) for t, n in ((1.0, 0), (2.0, 2), (5.0, 3))]
    result = SimpleNamespace(truth=[0] * 4, progress=progress)
    assert search_quality.find_times(result, 9.0).tolist() == [2.0, 2.0, 5.0, 9.0]


@pytest.mark.parametrize('regime', search_regimes.REGIMES)
def test_every_regime_has_every_planner(regime):
    """All scenarios are valid, and what is compared differs."""
    digests = {search_quality.digest(regime, kind) for kind in search_regimes.KINDS}
    # The clairvoyant's settings are those of the default.
    assert len(digests) == len(search_regimes.KINDS) - 1


def test_a_cut_off_line_is_left_out(tmp_path):
    """A campaign that was killed while it wrote goes on."""
    file = tmp_path / 'runs.jsonl'
    text = json.dumps(asdict(RUN))
    file.write_text(text + '\n' + text[:30])
    assert search_quality.stored(file) == {RUN.key: RUN}


def test_the_table_pairs_the_seeds_of_both():
    """Differences are of the same seeds only."""
    runs = [replace(RUN, seed=seed, time=30.0 + seed) for seed in (1, 2, 3)]
    runs += [replace(RUN, kind='maasi', seed=seed, time=20.0 + 2.0 * seed) for seed in (1, 2)]
    gap = search_quality.difference(runs[3:], runs[:3], 'time')
    assert (gap.mean, gap.number) == (-8.5, 2)
    assert '| maasi | 2 | 2/2 | 0.00 | 23.0' in search_quality.table(runs)


def test_the_document_keeps_what_is_around_the_table(tmp_path):
    """Writing it twice replaces the first table."""
    file = tmp_path / 'page.md'
    file.write_text(f'above\n{search_quality.BEGIN}\n{search_quality.END}\nbelow\n')
    search_quality.write(file, 'one')
    search_quality.write(file, 'two')
    expected = f'above\n{search_quality.BEGIN}\ntwo\n{search_quality.END}\nbelow\n'
    assert file.read_text() == expected
