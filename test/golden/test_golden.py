"""Runs do what they did when they were stored."""

import pytest
from golden_files import FOLDER, differences, path_of, read, tolerance_for
from golden_runs import runs

GOLDEN = runs()


@pytest.mark.parametrize('name', GOLDEN)
def test_runs_are_as_stored(name):
    stored, elsewhere = read(path_of(name))
    assert stored.keys() == GOLDEN[name].keys()
    tolerance = tolerance_for(elsewhere)
    found = []
    for key, run in GOLDEN[name].items():
        found += differences(f'{name}, {key}', stored[key], run(), tolerance)
    assert not found, '\n'.join(
        [
            f'moved, tolerance {tolerance:g} (./scripts/golden --write stores what is meant):',
            *map(str, found),
            f'stored on another machine: {elsewhere}' if elsewhere else '',
        ]
    )


def test_nothing_is_stored_that_is_not_run():
    assert sorted(path.name for path in FOLDER.iterdir()) == sorted(
        path_of(name).name for name in GOLDEN
    )
