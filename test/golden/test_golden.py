"""Runs do what they did when they were stored."""

import pytest
from golden_files import FOLDER, differences, path_of, read
from golden_runs import runs

GOLDEN = runs()


@pytest.mark.parametrize('name', GOLDEN)
def test_runs_are_as_stored(name):
    stored = read(path_of(name))
    assert stored.keys() == GOLDEN[name].keys()
    found = []
    for key, run in GOLDEN[name].items():
        found += differences(f'{name}, {key}', stored[key], run())
    assert not found, 'moved (./scripts/golden --write stores what is meant):\n' + '\n'.join(
        map(str, found)
    )


def test_nothing_is_stored_that_is_not_run():
    assert sorted(path.name for path in FOLDER.iterdir()) == sorted(
        path_of(name).name for name in GOLDEN
    )
