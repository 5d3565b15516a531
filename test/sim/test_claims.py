"""Tests of the papers' claims: verdicts by the stated rule, what stands in the cells, the page."""

import math

import numpy as np
import pytest
from test_experiments import ERROR, STEPS

from maasi_sim.experiments import claims, tables
from maasi_sim.experiments.claims import Finding
from maasi_sim.experiments.experiment import Case, Claim, Experiment, Published, Results, Run
from maasi_sim.experiments.searches import lane_share

LIMIT = 200


def results(claim, published=(), **values):
    """Return runs of cases with these steps, None for one that did not get there."""

    def run(case, number, steps):
        facts = {'steps': steps, 'limit': LIMIT, 'error': 0.1 * (steps or LIMIT)}
        at = {'number': number, 'seed': number, 'digest': '', 'machine': {}}
        return Run(facts, experiment='000-toy', case=case, **at)

    experiment = Experiment(
        name='000-toy',
        title='A toy',
        cases=lambda small: [],
        run=lambda settings, seed: None,
        quantities=(STEPS, ERROR),
        draw=lambda figure, results: None,
        published=published,
        claims=(claim,),
    )
    runs = {case: [run(case, n, one) for n, one in enumerate(v)] for case, v in values.items()}
    return Results(experiment, [Case(name, {}) for name in values], runs)


def finding(expects='less', published=(), quantity='steps', **values):
    names = {'case': 'a'} if expects == 'number' else {'first': 'a', 'second': 'b'}
    claim = Claim('a claim', quantity, expects=expects, **names)
    found = claims.findings(results(claim, published, **values))
    return found[0] if found else None


LOW, HIGH = [90, 100, 95, 105, 98, 102], [140, 155, 150, 149, 151, 156]
NEAR, WIDE = [101, 91, 104, 97, 103, 96], [20, 190, 40, 180, 30, 170]


@pytest.mark.parametrize(
    ('expects', 'first', 'second', 'verdict'),
    [
        ('less', LOW, HIGH, 'holds'),
        ('less', HIGH, LOW, 'not here'),
        ('less', LOW, NEAR, 'not shown'),
        ('greater', HIGH, LOW, 'holds'),
        ('greater', LOW, HIGH, 'not here'),
        ('alike', LOW, NEAR, 'holds'),
        ('alike', LOW, WIDE, 'not shown'),
        ('alike', LOW, HIGH, 'not here'),
        # Alike to 20 %, but significantly different.
        ('alike', LOW, [one + 5 for one in LOW], 'not here'),
        ('less', [90], [140], 'no interval'),
    ],
)
def test_verdict_on_two_cases(expects, first, second, verdict):
    assert finding(expects, a=first, b=second).verdict() == verdict


@pytest.mark.parametrize(
    ('number', 'half_width', 'runs', 'verdict'),
    [
        (100.0, 5.0, 10, 'holds'),
        (150.0, 5.0, 10, 'differs'),
        (100.0, 60.0, 10, 'not shown'),
        # One run of the paper is one of ours: 110 is no other method's, 150 is.
        (110.0, None, 1, 'not shown'),
        (150.0, None, 1, 'differs'),
    ],
)
def test_verdict_on_a_number_of_the_paper(number, half_width, runs, verdict):
    published = (Published('a', 'steps', number, half_width, runs),)
    found = finding('number', published, a=LOW)
    assert found.verdict() == verdict
    assert ('(one run)' in found.paper) == (runs == 1)
    assert found.gap == pytest.approx(np.mean(LOW) - number)


def test_runs_that_did_not_finish_count_with_the_limit_and_are_counted():
    found = finding(a=[90, None, 95, 105], b=[140, None, None, 149, 151])
    assert found.gap == pytest.approx((90 + 200 + 95 + 105 - 140 - 200 - 200 - 149) / 4)
    assert 'finished 3 of 4, 2 of 4' in found.here
    # More than half of the second are not there: no median.
    assert 'medians 100, -' in found.here
    nobody = finding(a=[None] * 3, b=[None] * 3)
    assert nobody.verdict() == 'not shown' and 'none in any of 3 runs' in nobody.here
    assert 'finished 0 of 3, 0 of 3' in nobody.here
    capped = tables.capped(np.array([3.0, math.nan, 90.0]), 40.0)
    np.testing.assert_array_equal(capped, [3.0, 40.0, 40.0])
    # On the page only what is not complete is counted, without medians and ratios.
    assert found.brief().split('<br>')[0] == '122 and 172' and '(medians' not in found.brief()
    assert 'finished 3/4, 2/4' in found.brief() and ', x' not in found.brief()
    assert 'finished' not in finding(a=LOW, b=HIGH).brief()
    # What each run has is not counted.
    assert 'finished' not in finding(quantity='error', a=LOW, b=HIGH).here


def test_ratio_is_that_of_pairs_with_its_interval():
    noisy = [one + 20 + 3 * n for n, one in enumerate(LOW)]
    here = finding(a=LOW, b=noisy).here
    ratio = np.exp(np.mean(np.log(LOW) - np.log(noisy)))
    low, high = map(float, here.split(' [')[1].split(']')[0].split(', '))
    assert f'x {ratio:.3g} [' in here and low < ratio < high
    assert ' x ' not in finding(a=[0, 10, 5], b=[10, 20, 30]).here


def found_with(half_width, gap=-10.0, says='a claim', expects='less'):
    return Finding(says, expects, 'less', 'here', gap, half_width, 9.0, 100.0)


def test_bold_is_what_the_correction_leaves():
    clear, bare = found_with(1.0), found_with(9.5)
    level = claims.corrected_level({'a': [clear, bare] * 20, 'b': [found_with(None)]})
    assert level == (40, pytest.approx(1.0 - 0.05 / 40))
    assert clear.marked(level[1]) == '**holds**' and bare.marked(level[1]) == 'holds'
    # With one interval there is nothing to correct.
    assert bare.marked(0.95) == '**holds**'
    assert found_with(20.0).marked(0.95) == 'not shown'


def test_page_and_summary_have_each_claim_of_each_experiment():
    claim = Claim('a claim', 'steps', 'a', 'b', note='as printed', cause='the wind')
    known = {'000-toy': results(claim).experiment}
    page = claims.claims_page('{intervals} {level} {page}', known, {}, 'there.md')
    row = '| a claim (as printed), [000-toy](there.md#000-toy) |'
    assert f'{row}  |  | not run |' in page and page.startswith('0 95.00 there.md')
    against = {'000-toy': [found_with(1.0, gap=10.0)]}
    page = claims.claims_page('{intervals} {level}', known, against, 'there.md')
    assert f'{row} less | here | **not here**: the wind |' in page and page.startswith('1 95.00')
    holds = {'000-toy': [found_with(1.0)]}
    assert 'the wind' not in claims.claims_page('', known, holds, 'there.md')
    assert '| 000 | 1 | 1 (1) | 0 | 0 (0) | 0 |' in claims.summary(known, holds)
    one_run = {'000-toy': [found_with(None)]}
    assert '| no interval |' in claims.claims_page('', known, one_run, 'there.md')
    text = f'before\n{claims.BEGIN}old\n{claims.END}after\n'
    new = claims.with_summary(text, 'table\n')
    assert new == f'before\n{claims.BEGIN}\ntable\n\n{claims.END}after\n'
    assert claims.with_summary(new, 'table\n') == new
    assert claims.with_summary('no marks\n', 'table\n') == 'no marks\n'


def test_lanes_are_long_straight_and_along_an_axis():
    along = np.arange(0.0, 101.0, 10.0)
    lane = np.stack([along, 0 * along, 0 * along], 1)
    back = np.add(lane[::-1], [0.0, 10.0, 0.0])
    assert lane_share(lane, 100.0) == 1.0
    assert lane_share(np.vstack([lane, back]), 100.0) == pytest.approx(200.0 / 210.0)
    # Too short, askew, to and fro, nowhere.
    assert lane_share(lane[:5], 100.0) == 0.0
    assert lane_share(lane @ [[0.7, 0.7, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], 100.0) == 0.0
    assert lane_share(np.vstack([lane[:4], lane[:3][::-1]] * 5), 100.0) == 0.0
    assert lane_share(lane[:1], 100.0) == 0.0
