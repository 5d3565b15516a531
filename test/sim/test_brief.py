"""Tests of the short tables on the page of the experiments."""

import pytest

from maasi_sim.experiments.brief import brief_cell, brief_tables
from maasi_sim.experiments.experiment import Claim, Comparison, Experiment, Quantity


@pytest.mark.parametrize(
    ('stored', 'shown'),
    [
        ('132 ± 12.8 (median 130)', '132 ± 12.8'),
        ('132 ± 12.8 (median 99)', '132 ± 12.8 (median 99)'),
        ('12 ± 0', '12'),
        ('0.8 ± 3.1e-16', '0.8'),
        ('758 ± 122, 1 runs', '758 ± 122, 1 run'),
        ('more than 900', 'more than 900'),
        ('132 ± 12 (median 130)<br>paper 117 ± 11 (table 1)<br>difference +15.3 ± 16', None),
        ('132 ± 12<br>paper 90 ± 11<br>difference +42 ± 16', '132 ± 12<br>paper **90 ± 11**'),
        ('103<br>paper 75 (VI-A)<br>difference +28', '103<br>paper 75'),
    ],
)
def test_cell_has_what_its_numbers_do_not_imply(stored, shown):
    assert brief_cell(stored) == (shown or '132 ± 12<br>paper 117 ± 11')


def experiment(comparisons=(), claims=()):
    return Experiment(
        name='000-toy',
        title='A toy',
        cases=lambda small: [],
        run=lambda settings, seed: None,
        quantities=(Quantity('steps', 'steps'), Quantity('step_time', 'computation', 's')),
        draw=lambda figure, results: None,
        comparisons=comparisons,
        claims=claims,
    )


def test_cases_in_two_parts_become_a_matrix():
    names = [f'alpha {a}, beta {b}' for a in (1, 2, 3, 4) for b in (1, 2, 3)]
    cases = {name: {'runs': '5', 'steps': f'{n}'} for n, name in enumerate(names)}
    table, words, paired = brief_tables(experiment(), cases, [])
    assert table.splitlines()[0] == '| steps | beta 1 | beta 2 | beta 3 |'
    assert table.splitlines()[2] == '| alpha 1 | 0 | 1 | 2 |' and not words and not paired


def test_differences_to_one_case_are_a_column_and_those_of_claims_are_left_out():
    comparisons = [Comparison(one, 'a', 'steps') for one in 'bcd'] + [Comparison('b', 'c', 'steps')]
    toy = experiment(comparisons, [Claim('d is faster', 'steps', 'd', 'a')])
    cells = {'runs': '5', 'computation [s]': '0.1 ± 0.01'}
    cases = {name: {**cells, 'steps': f'1{n} ± 2'} for n, name in enumerate('abcd')}
    pairs = [[f'{item.first} minus {item.second}', 'steps', '5', '+1 ± 3'] for item in comparisons]
    table, words, paired = brief_tables(toy, cases, pairs)
    lines = table.splitlines()
    assert lines[0] == '| case | steps | minus a |' and lines[3] == '| b | 11±2 | +1±3 |'
    assert lines[5] == '| d | 13±2 |  |'
    assert 'b minus c' in paired and 'minus a' not in paired and 'computation' not in words
    # Where some runs are of an earlier campaign, their number stands in each row.
    cases['b']['runs'] = '5 (earlier)'
    assert brief_tables(toy, cases, pairs)[0].startswith('| case | runs | steps |')
