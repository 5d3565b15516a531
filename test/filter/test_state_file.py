"""Saved and loaded filters continue to the bit; damaged files are refused with a reason."""

import json

import numpy as np
import pytest
from searches import CUBE, cube_sensor, observe, wander

from maasi_filter import (
    AgentMeasurement,
    FilterSettings,
    Pose,
    StateFileError,
    load_filter,
    make_filter,
)
from maasi_filter.state_file import generator_state, restored_generator, write_state


def searched(steps=25, preset='paper_000', generator=None):
    """Return a filter in the middle of a search, and the measurements to come."""
    noise = np.random.default_rng(3)
    targets = noise.uniform(90.0, 170.0, (6, 3))
    sensor = cube_sensor()
    measurements = []
    for step, position in enumerate(wander(noise, 2 * steps)):
        pose = Pose(position)
        values = observe(noise, sensor, targets, pose)
        measurements.append(AgentMeasurement('drone', pose, sensor, values, None, step))
    search = make_filter(FilterSettings(preset=preset), CUBE, generator or np.random.default_rng(1))
    for step in range(steps):
        search.step([measurements[step]], 1, float(step))
    return search, measurements[steps:]


def outcome(search, measurements):
    """Return everything that comes out of the steps to come, as bytes."""
    out = []
    for step, measurement in enumerate(measurements):
        result = search.step([measurement], 1, 100.0 + step)
        out.append(
            (
                search.particles.tobytes(),
                search.weights.tobytes(),
                [(c.position.tobytes(), c.covariance.tobytes(), c.mass) for c in result.clusters],
                [
                    (t.id, t.position.tobytes(), t.covariance.tobytes(), t.robot, t.time)
                    for t in search.found_targets
                ],
            )
        )
    return out


@pytest.mark.parametrize('preset', ['paper_000', 'paper_003'])
def test_a_loaded_filter_continues_to_the_bit(tmp_path, preset):
    search, rest = searched(preset=preset)
    search.save(tmp_path / 'state')
    loaded = load_filter(tmp_path / 'state')
    assert loaded.settings == search.settings
    assert len(loaded.clusters) == len(search.clusters)
    assert outcome(loaded, rest) == outcome(search, rest)
    assert len(search.found_targets) >= 1


@pytest.mark.parametrize('name', ['PCG64', 'PCG64DXSM', 'Philox', 'SFC64', 'MT19937'])
def test_every_generator_continues(name):
    generator = np.random.Generator(getattr(np.random, name)(5))
    generator.standard_normal(7)
    generator.integers(0, 2**31, 3, dtype=np.uint32)
    copy = restored_generator(generator_state(generator))
    np.testing.assert_array_equal(copy.random(20), generator.random(20))
    np.testing.assert_array_equal(
        copy.integers(0, 9, 5, dtype=np.uint32), generator.integers(0, 9, 5, dtype=np.uint32)
    )


def test_saving_replaces_the_file_and_leaves_nothing_beside_it(tmp_path):
    search, _ = searched(3)
    search.save(tmp_path / 'state')
    first = (tmp_path / 'state').read_bytes()
    search.step([], 1, 50.0)
    search.weights = search.weights * 0.5
    search.save(tmp_path / 'state')
    assert (tmp_path / 'state').read_bytes() != first
    assert [path.name for path in tmp_path.iterdir()] == ['state']


def test_damage_is_noticed_wherever_it_is(tmp_path):
    search, _ = searched(5)
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
        (lambda content: content[:-100], 'bytes of state where'),
        (lambda content: content + b'x', 'bytes of state where'),
        (lambda content: b'', 'not a state'),
        (lambda content: b'\x00' * 5000, 'not a state'),
        (lambda content: b'{}\n' + content, 'not a state'),
        (lambda content: b'[1]\n' + content, 'not a state'),
    ],
)
def test_other_files_are_refused_with_a_reason(tmp_path, change, reason):
    search, _ = searched(3)
    path = tmp_path / 'state'
    search.save(path)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(StateFileError, match=reason):
        load_filter(path)


def test_another_version_is_refused_by_number(tmp_path):
    search, _ = searched(3)
    path = tmp_path / 'state'
    search.save(path)
    line, _, payload = path.read_bytes().partition(b'\n')
    header = json.loads(line)
    header['version'] = 99
    path.write_bytes(json.dumps(header).encode() + b'\n' + payload)
    with pytest.raises(StateFileError, match='version: got 99, allowed is 2'):
        load_filter(path)


def test_a_missing_file_is_told(tmp_path):
    with pytest.raises(StateFileError, match='cannot be read'):
        load_filter(tmp_path / 'nothing')


def _set(name, value):
    def change(state):
        state[name][...] = value

    return change


def _replace(name, make):
    def change(state):
        state[name] = make(state[name])

    return change


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        (_set('particles', np.nan), 'particles: got a number that is not finite'),
        (_set('weights', np.inf), 'weights: got a number that is not finite'),
        (_set('weights', -1.0), 'weights: got -1.0, allowed are numbers from 0'),
        (_set('exploration', np.nan), 'exploration: got a number'),
        (_replace('exploration', lambda a: a[:1]), 'exploration: got shape'),
        (_replace('particles', lambda a: a[:, :2]), 'particles: got shape'),
        (_replace('weights', lambda a: a[:-1]), 'weights: got shape'),
        (_replace('weights', lambda a: a.astype(str)), 'weights: got type'),
        (_set('found_positions', np.nan), 'found_positions: got a number that is not finite'),
        (_set('found_covariances', -1.0), 'found_covariances: of target'),
        (_set('found_ids', 1), 'found_ids: got'),
        (_replace('found_times', lambda a: a[:-1]), 'found_times: got shape'),
        (_replace('robots', lambda a: np.frombuffer(b'[1, 2]', np.uint8)), 'robots: got'),
        (_replace('bounds', lambda a: a * np.nan), 'bounds: got'),
        (lambda state: state.pop('weights'), "no 'weights'"),
    ],
)
def test_a_state_with_a_right_checksum_and_wrong_content_is_refused(tmp_path, change, reason):
    search, _ = searched(preset='paper_000')
    assert len(search.weights) and len(search.found_targets) > 2
    path = tmp_path / 'state'
    state = {name: np.array(array) for name, array in search.state().items()}
    change(state)
    write_state(path, state)
    with pytest.raises(StateFileError, match=f'does not hold a usable state: .*{reason}'):
        load_filter(path)
