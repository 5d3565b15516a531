"""Runs do what they did when they were stored."""

from copy import deepcopy

import pytest
from golden_runs import SEEDS, runs
from record import (
    FOLDER,
    TOLERANCE,
    TOLERANCE_ELSEWHERE,
    differences,
    moved,
    path_of,
    read,
    rounded,
)

GOLDEN = runs()
OTHER_SEEDS = [f'seed {seed}' for seed in SEEDS[1:]]


@pytest.mark.parametrize('name', GOLDEN)
def test_runs_are_as_stored(name):
    stored, elsewhere = read(path_of(name))
    tolerance = TOLERANCE_ELSEWHERE if elsewhere else TOLERANCE
    assert stored.keys() == GOLDEN[name].keys()
    # The other seeds are repeated by ./scripts/golden.
    made = {key: run() for key, run in GOLDEN[name].items() if key not in OTHER_SEEDS}
    found = moved(name, made, {key: stored[key] for key in made}, tolerance)
    assert not found, '\n'.join(
        [
            f'moved, tolerance {tolerance:g} (./scripts/golden --write stores what is meant):',
            *found,
            f'stored on another machine: {elsewhere}' if elsewhere else '',
        ]
    )


def test_nothing_is_stored_that_is_not_run():
    assert {path.name for path in FOLDER.iterdir()} == {path_of(name).name for name in GOLDEN}


def test_differences_say_where_and_by_how_much():
    before = {
        'size': 200.0,
        'found': {'step': [4, 9], 'robot': ['a', 'b'], 'position': [[1.0, 2.0], [3.0, 4.0]]},
        'end': {'steps': 20, 'rmse': float('nan')},
    }
    assert differences(before, deepcopy(before), 0.0) == []
    now = deepcopy(before)
    now['found']['position'][1][0] += 1e-4
    assert differences(before, now, 1e-6) == []
    now['found']['position'][1][0] += 3e-4
    [found] = differences(before, now, 1e-6)
    assert found.startswith('step 9: found.position: moved by 0.0004 m, 2e-06 of the size')
    now = deepcopy(before)
    now['found']['robot'] = ['c', 'd']
    now['end']['steps'] = 21
    assert differences(before, now, 1.0) == [
        'step 4: found.robot: a before, c now',
        'at the end: steps: 20 before, 21 now',
    ]
    # An event less, and a kind of event that there was not before.
    now = {**deepcopy(before), 'snapshots': {'step': [7], 'cuboid': [2]}}
    now['found'] = {column: values[:1] for column, values in now['found'].items()}
    assert differences(before, now, 1e-6) == [
        'step 7: number of snapshots: 0 before, 1 now',
        'step 9: number of found: 2 before, 1 now',
    ]
    assert moved('demo', {'seed 1': now}, {'seed 2': now}, 0.0) == [
        'demo, seed 2: run: one before, none now',
        'demo, seed 1: run: none before, one now',
    ]


def test_stored_numbers_are_rounded_below_the_tolerance():
    recording = {'size': 260.0, 'found': {'position': [[123.456789123]], 'bits': ['a']}, 'end': {}}
    stored = rounded(recording)
    assert 'bits' not in stored['found']
    moved = abs(stored['found']['position'][0][0] - 123.456789123)
    assert 0.0 < moved <= 0.1 * TOLERANCE * 260.0
    # Events without a step are none.
    recording['found']['step'] = stored['found']['step'] = [3]
    assert differences(stored, recording, TOLERANCE) == []
