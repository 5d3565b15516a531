"""Filters of several robots that share their found targets (002, section 4)."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from searches import FLOOR, FLOOR_LENGTHS, floor_sensor

from maasi_filter import AgentMeasurement, FilterSettings, Pose, load_filter, make_filter
from maasi_filter.found_targets import merge
from maasi_filter.records import FoundTarget

POSE = Pose([1.0, 1.0, 1.0])
VALUES = np.array([[0.1, 0.3]])
PLACE = np.array([1.0 + 0.1 * np.cos(0.3), 1.0 + 0.1 * np.sin(0.3)])


@pytest.fixture(params=['ic_phd', 'pmb'])
def new_filter(request):
    """Return a function that makes a filter with the lengths of the floor."""
    method = request.param
    # A target is not found at its first detection.
    lengths = {**FLOOR_LENGTHS, 'found_radius': 0.01} if method == 'ic_phd' else {}
    settings = FilterSettings(method=method, **lengths)
    return lambda: make_filter(settings, FLOOR, np.random.default_rng(1))


def look(search, robot, times, begin=0, values=VALUES):
    """Let a robot look at one target again and again; return the last result."""
    for number in range(begin, begin + times):
        measurement = AgentMeasurement(robot, POSE, floor_sensor(), values, index=number)
        result = search.step([measurement], 1, float(number))
    return result


def target(position=PLACE, time=3.0, number=1, deviation=0.01):
    return FoundTarget(number, np.array(position), np.diag([deviation**2] * 2), 'other', 5, time)


def test_what_another_one_found_is_not_found_again(new_filter):
    alone = new_filter()
    look(alone, 'own', 12)
    assert len(alone.found_targets) == 1
    search = new_filter()
    assert search.merge({'other': [target()]})
    result = look(search, 'own', 12)
    assert [(item.robot, item.origin) for item in search.found_targets] == [('other', 1)]
    assert search.own_found_targets() == []
    assert result.expected_number < 0.2
    assert search.found_targets[0].position == pytest.approx(PLACE)


def test_particles_of_a_target_that_another_one_found_are_deleted(new_filter):
    search = new_filter()
    far = np.array([[0.1, 0.3], [0.15, -2.0]])
    look(search, 'own', 1, values=far)
    before = search.expected_number
    assert before > 1.5
    search.merge({'other': [target()]})
    assert search.expected_number == pytest.approx(before - 1.0, abs=0.2)
    # The groups that are left go on as they are.
    look(search, 'own', 6, begin=1, values=far)
    assert len(search.own_found_targets()) == 1
    assert search.own_found_targets()[0].position == pytest.approx(
        [1.0 + 0.15 * np.cos(-2.0), 1.0 + 0.15 * np.sin(-2.0)], abs=0.02
    )


@pytest.mark.parametrize(
    ('robot', 'later', 'owner'),
    [('other', -0.5, 'other'), ('other', 100.0, 'own'), ('a', 0.0, 'a'), ('z', 0.0, 'own')],
)
def test_a_target_of_two_belongs_to_who_was_first_or_is_by_name(new_filter, robot, later, owner):
    search = new_filter()
    look(search, 'own', 12)
    number, time = search.found_targets[0].id, search.found_targets[0].time
    assert search.merge({robot: [target(time=time + later)]}) == (owner == robot)
    assert [item.robot for item in search.found_targets] == [owner]
    assert search.found_targets[0].id == number
    assert bool(search.own_found_targets()) == (owner == 'own')


def test_the_estimate_is_that_of_its_owner(new_filter, tmp_path):
    search = new_filter()
    search.merge({'other': [target()]})
    assert not search.merge({'other': [target()]})
    moved = PLACE + 0.004
    assert search.merge({'other': [target(moved), target([0.0, 2.0], number=2)]})
    assert len(search.found_targets) == 2
    assert search.found_targets[0].position == pytest.approx(moved)
    look(search, 'own', 5)
    assert search.found_targets[0].position == pytest.approx(moved)
    search.save(tmp_path / 'state')
    loaded = load_filter(tmp_path / 'state')
    assert [item.origin for item in loaded.found_targets] == [1, 2]
    assert not loaded.merge({'other': [target(moved), target([0.0, 2.0], number=2)]})


def test_bad_targets_are_refused_and_change_nothing(new_filter):
    search = new_filter()
    wrong = [target([np.nan, 1.0]), target(deviation=np.inf), target(deviation=0.0)]
    for item in wrong:
        with pytest.raises(ValueError, match='other: target 1'):
            search.merge({'other': [target([0.0, 0.0], number=2), item]})
    with pytest.raises(ValueError, match='dimensions'):
        search.merge({'other': [target([1.0, 1.0, 1.0])]})
    with pytest.raises(ValueError, match='different ones from 1'):
        search.keep_found([target(), target()])
    assert search.found_targets == []


def test_a_target_that_another_one_withdraws_is_not_found_any_more(new_filter, tmp_path):
    search = new_filter()
    search.merge({'other': [target(), target([0.0, 2.0], number=2)]})
    search.merge({'third': [target([2.0, 0.0], number=1)]})
    assert search.merge({'other': [target([0.0, 2.0], number=2)]})
    assert [(item.robot, item.origin) for item in search.found_targets] == [
        ('other', 2),
        ('third', 1),
    ]
    assert not search.merge({'other': [target([0.0, 2.0], number=2)]})
    search.save(tmp_path / 'state')
    for again in (search, load_filter(tmp_path / 'state')):
        # Neither does it rise from a single detection, nor where nothing is seen.
        look(again, 'own', 1)
        look(again, 'own', 20, begin=1, values=np.empty((0, 2)))
        assert [item.id for item in again.found_targets] == [2, 3]
        assert again.expected_number < 0.5
        # Detections of this filter find it again, as a new one.
        look(again, 'own', 40, begin=21)
        assert [item.origin for item in again.found_targets] == [2, 1, 0]
        assert again.found_targets[-1].id == 4


def test_a_target_kept_over_a_restart_is_still_that_of_its_filter(new_filter):
    search = new_filter()
    kept = replace(target(), id=7)
    search.keep_found([kept])
    assert search.merge({'other': [target(PLACE + 0.004)]})
    assert [(item.id, item.origin) for item in search.found_targets] == [(7, 1)]
    assert search.merge({'other': []}) and search.found_targets == []


@pytest.mark.parametrize('seed', range(10))
def test_what_is_known_of_others_is_what_they_published_last(new_filter, seed):
    draw, search = np.random.default_rng(seed), new_filter()
    places = [[0.4 * n, 0.2 + 0.5 * k] for k in range(4) for n in range(5)]
    published = {}
    for _ in range(12):
        for k, robot in enumerate('abc'):
            numbers = np.flatnonzero(draw.random(5) < 0.5)
            published[robot] = [target(places[5 * k + n], number=int(n) + 1) for n in numbers]
        before = deepcopy(search.register())
        known = merge(search.register(), published)
        assert repr(search.register()) == repr(before)
        assert not merge(known.found, published)
        search.merge(published)
        expected = {(robot, item.id) for robot, items in published.items() for item in items}
        known = [(item.robot, item.origin) for item in search.found_targets]
        assert set(known) == expected and len(known) == len(expected)
        ids = [item.id for item in search.found_targets]
        assert len(set(ids)) == len(ids)
