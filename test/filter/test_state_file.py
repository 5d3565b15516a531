"""Saved and loaded filters continue to the bit; damaged files are refused with a reason."""

import json

import numpy as np
import pytest
from searches import CUBE, cube_sensor, observe, same, wander

from maasi_filter import AgentMeasurement, FilterSettings, Pose, StateFileError, load_filter
from maasi_filter.make_filter import make_filter
from maasi_filter.records import Label
from maasi_filter.state_file import SavedState, write_state

PHD = FilterSettings()
PMB = FilterSettings(method='pmb', found_radius=4.0, pmb={'particles': 100})
OFFSETS = FilterSettings(
    method='pmb', found_radius=4.0, pmb={'particles': 100, 'offset': {'deviation': 1.0}}
)


def searched(settings=PHD, steps=25, generator=None, labels=False):
    """Return a filter in the middle of a search, and the measurements to come."""
    noise = np.random.default_rng(3)
    targets = noise.uniform(90.0, 170.0, (6, 3))
    sensor = cube_sensor()
    measurements = []
    for step, position in enumerate(wander(noise, 2 * steps)):
        pose = Pose(position)
        values = observe(noise, sensor, targets, pose)
        names = [Label('box', 0.5, f'{i}') for i in range(len(values))] if labels else ()
        measurements.append(
            AgentMeasurement('ab'[step % 2], pose, sensor, values, None, step, labels=names)
        )
    search = make_filter(settings, CUBE, generator or np.random.default_rng(1))
    play(search, measurements[:steps])
    return search, measurements[steps:]


def play(search, measurements):
    """Let a filter have measurements one by one."""
    for measurement in measurements:
        search.step([measurement], 1, float(measurement.index))


@pytest.mark.parametrize(
    ('settings', 'labels'),
    [
        (PHD, False),
        (FilterSettings(preset='paper_003'), False),
        (PMB, True),
        (OFFSETS, False),
    ],
)
def test_a_loaded_filter_continues_to_the_bit(tmp_path, settings, labels):
    search, rest = searched(settings, labels=labels)
    assert search.clusters or search.found_targets
    search.save(tmp_path / 'state')
    assert [path.name for path in tmp_path.iterdir()] == ['state']
    loaded = load_filter(tmp_path / 'state')
    assert loaded.settings == search.settings
    same(search, loaded)
    play(search, rest)
    play(loaded, rest)
    same(search, loaded)
    # The file is replaced.
    search.save(tmp_path / 'state')
    same(search, load_filter(tmp_path / 'state'))


def test_an_empty_filter_is_saved(tmp_path):
    search = make_filter(PMB, CUBE, np.random.default_rng(1))
    search.save(tmp_path / 'state')
    same(search, load_filter(tmp_path / 'state'))


@pytest.mark.parametrize('name', ['PCG64', 'PCG64DXSM', 'Philox', 'SFC64', 'MT19937'])
def test_every_generator_continues(tmp_path, name):
    generator = np.random.Generator(getattr(np.random, name)(5))
    generator.standard_normal(7)
    generator.integers(0, 2**31, 3, dtype=np.uint32)
    write_state(tmp_path / 'state', {'generator': generator})
    copy = SavedState(tmp_path / 'state').read('generator', np.random.Generator)
    np.testing.assert_array_equal(copy.random(20), generator.random(20))
    np.testing.assert_array_equal(
        copy.integers(0, 9, 5, dtype=np.uint32), generator.integers(0, 9, 5, dtype=np.uint32)
    )


def test_damage_is_noticed_wherever_it_is(tmp_path):
    search, _ = searched(steps=5)
    path = tmp_path / 'state'
    search.save(path)
    content = path.read_bytes()
    generator = np.random.default_rng(0)
    start = content.index(b'\n')
    for place in generator.integers(start, len(content), 20).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 0x10
        path.write_bytes(bytes(damaged))
        with pytest.raises(StateFileError, match=r'damaged|not a state'):
            load_filter(path)


def other_version(content):
    """Return a file of another version."""
    line, _, payload = content.partition(b'\n')
    return json.dumps({**json.loads(line), 'version': 99}).encode() + b'\n' + payload


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        (lambda content: content[:-100], 'checksum'),
        (lambda content: content + b'x', 'checksum'),
        (lambda content: b'', 'not a state'),
        (lambda content: b'\x00' * 5000, 'not a state'),
        (lambda content: b'{}\n' + content, 'not a state'),
        (lambda content: b'[1]\n' + content, 'not a state'),
        (other_version, 'version: got 99, allowed is 3'),
        (None, 'cannot be read'),
    ],
)
def test_other_files_are_refused_with_a_reason(tmp_path, change, reason):
    path = tmp_path / 'state'
    if change is not None:
        make_filter(PHD, CUBE, np.random.default_rng(1)).save(path)
        path.write_bytes(change(path.read_bytes()))
    with pytest.raises(StateFileError, match=f'state: .*{reason}'):
        load_filter(path)


def fill(*path, value):
    """Return a change of an array, or of a field."""

    def change(owner):
        *parents, last = path
        for part in parents:
            owner = owner[part] if isinstance(owner, (dict, list)) else getattr(owner, part)
        fields = owner if isinstance(owner, dict) else owner.__dict__
        new = value(fields[last]) if callable(value) else value
        if isinstance(fields[last], np.ndarray) and np.ndim(new) == 0:
            new = np.full_like(fields[last], new)
        fields[last] = new

    return change


def shorter(array):
    """Return an array without its last row."""
    return array[:-1]


@pytest.mark.parametrize(
    ('settings', 'change', 'reason'),
    [
        (PHD, fill('particles', value=np.nan), 'particles: got float64 .* without nan'),
        (PHD, fill('weights', value=np.inf), 'weights: got a number that is not finite'),
        (PHD, fill('weights', value=-1.0), 'weights: got -1.0, allowed are numbers from 0'),
        (PHD, fill('exploration', value=2.0), 'exploration: got a number'),
        (PHD, fill('exploration', value=shorter), 'exploration: got shape'),
        (PHD, fill('weights', value=shorter), 'particles: got shape'),
        (PHD, fill('weights', value=lambda a: a.astype(int)), 'weights: got int64 numbers'),
        (PHD, fill('bounds', value=np.inf), 'bounds: got'),
        (PHD, fill('found_targets', 0, 'robot', value=5), 'robot: got 5, allowed is str'),
        (PHD, lambda state: state.clear(), "no 'settings'"),
        (PMB, fill('components', 0, 'existence', value=2.0), 'existence 2.0'),
        (PMB, fill('components', 0, 'answers', value=shorter), 'and 4 answers'),
        (PMB, fill('components', 0, 'density', 'weights', value=shorter), 'density: got arrays'),
        (PMB, fill('components', 0, 'density', 'weights', value=-1.0), 'density: got numbers'),
        (PMB, fill('components', 0, 'density', 'heads', value=lambda a: a[:, 1:]), 'density: got'),
        (PMB, fill('components', 0, 'density', 'terms', value=shorter), 'density: got arrays'),
    ],
)
def test_a_state_with_a_right_checksum_and_wrong_content_is_refused(
    tmp_path, settings, change, reason
):
    search, _ = searched(settings)
    path = tmp_path / 'state'
    state = search.state()
    change(state[search.method])
    write_state(path, state)
    with pytest.raises(StateFileError, match=f'state: does not hold a usable state: .*{reason}'):
        load_filter(path)
