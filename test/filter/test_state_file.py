"""Saved and loaded filters continue to the bit; damaged files are refused with a reason."""

import numpy as np
import pytest
from pydantic import TypeAdapter
from searches import CUBE, cube_sensor, observe, play, same, wander

from maasi_filter import AgentMeasurement, FilterSettings, Pose, StateFileError, load_filter
from maasi_filter.make_filter import make_filter
from maasi_filter.records import Label
from maasi_filter.state_file import VERSION, SavedGenerator, read_state, write_state

PHD = FilterSettings()
PMB = FilterSettings(method='pmb', found_radius=4.0, pmb={'particles': 100})
OFFSETS = FilterSettings(
    method='pmb', found_radius=4.0, pmb={'particles': 100, 'offset': {'deviation': 1.0}}
)


def searched(settings=PHD, steps=25, labels=False):
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
    search = make_filter(settings, CUBE, np.random.default_rng(1))
    play(search, measurements[:steps])
    return search, measurements[steps:]


@pytest.mark.parametrize(
    ('settings', 'labels', 'steps'),
    [
        (PHD, False, 25),
        (FilterSettings(preset='paper_003'), False, 25),
        (PMB, True, 25),
        (PMB, False, 0),
        (OFFSETS, False, 25),
    ],
)
def test_a_loaded_filter_continues_to_the_bit(tmp_path, settings, labels, steps):
    search, rest = searched(settings, steps, labels=labels)
    assert bool(search.clusters or search.found_targets) == bool(steps)
    search.save(tmp_path / 'state')
    assert [path.name for path in tmp_path.iterdir()] == ['state']
    loaded = load_filter(tmp_path / 'state')
    assert loaded.settings == search.settings
    same(search, loaded)
    play(search, rest, steps)
    play(loaded, rest, steps)
    same(search, loaded)
    # The file is replaced.
    search.save(tmp_path / 'state')
    same(search, load_filter(tmp_path / 'state'))


@pytest.mark.parametrize('name', ['PCG64', 'PCG64DXSM', 'Philox', 'SFC64', 'MT19937'])
def test_every_generator_continues(tmp_path, name):
    generator = np.random.Generator(getattr(np.random, name)(5))
    generator.standard_normal(7)
    generator.integers(0, 2**31, 3, dtype=np.uint32)
    write_state(tmp_path / 'state', {'generator': generator})
    saved = read_state(tmp_path / 'state')['generator']
    copy = TypeAdapter(SavedGenerator).validate_python(saved)
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


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        (lambda content: content[:-100], 'checksum'),
        (lambda content: content + b'x', 'checksum'),
        (lambda content: b'', 'not a state'),
        (lambda content: b'\x00' * 5000, 'not a state'),
        (lambda content: b'{}\n' + content, 'not a state'),
        (lambda content: b'[1]\n' + content, 'not a state'),
        (
            lambda content: content.replace(b'"version": %d' % VERSION, b'"version": 99', 1),
            f'version: got 99, allowed is {VERSION}',
        ),
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
