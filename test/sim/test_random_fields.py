"""Searches of random fields: robots stay inside and apart, come home, and end for true reasons.

Option `--fields FIRST LAST` runs others of the block `development`; `random_fields.py` prints a
table of what is wrong.
"""

import numpy as np
import pytest
from field_checker import SearchChecker
from field_maker import KINDS, PLANNERS, make_field
from quality_conditions import SEEDS
from random_fields import FieldSearch, run_field

from maasi_sim.scenario.loading import scenario_from_values

BASE = SEEDS['development'].start


def pytest_generate_tests(metafunc):
    """Make a test of each field that is asked for."""
    if 'number' in metafunc.fixturenames:
        metafunc.parametrize('number', range(*metafunc.config.getoption('--fields')))


def test_a_random_field_is_searched_without_faults(number):
    outcome = run_field(BASE + number)
    found = [f'{fault.kind} at step {fault.step}: {fault.text}' for fault in outcome.faults]
    assert not found, f'{number} {outcome.end} {outcome.made.describe()}'


def test_fields_are_of_all_kinds_and_the_same_for_the_same_seed():
    fields = [make_field(BASE + number) for number in range(300)]
    assert {field.kind for field in fields} == set(KINDS)
    assert {field.planner for field in fields} == set(PLANNERS)
    teams = [{robot['type'] for robot in field.values['robots'].values()} for field in fields]
    assert sum(len(team) == 2 for team in teams) >= 30
    assert sum(field.weak for field in fields) >= 30
    kinds = {change.kind for field in fields for change in field.changes}
    assert kinds == {'appear', 'cut', 'cover', 'home', 'most'}
    assert sum(bool(field.changes) for field in fields) >= 100
    assert make_field(BASE + 7) == fields[7]


@pytest.fixture(scope='module')
def searched():
    """Return a field with two robots, batteries and a zone, its scenario and its search."""
    number = next(
        number
        for number in range(BASE, BASE + 300)
        if (field := make_field(number)).kind == 'bounds'
        and len(field.values['robots']) == 2
        and all('endurance' in robot for robot in field.values['robots'].values())
        and field.values['environment']['keep_outs']
        and field.values['environment']['obstacles']
    )
    made = make_field(number)
    made.changes.clear()
    made.weak = False
    made.values['limits']['time'] = 8.0
    scenario = scenario_from_values(made.values, 'test')
    running = FieldSearch(made, scenario)
    return made, scenario, running, running.run(None)


def _kinds(searched, positions=None, charges=None, finished='-', ended=None):
    """Return the kinds of faults of a search whose facts are changed from step 20 on."""
    made, scenario, running, result = searched
    track = running.track
    before = track.positions, track.charges, result.end_reason
    try:
        for name, change in (('positions', positions), ('charges', charges)):
            rows = np.array(getattr(track, name))
            if change is not None:
                rows[20:] = change(rows[20:])
            setattr(track, name, list(rows))
        result.end_reason = ended or result.end_reason
        faults = SearchChecker(made, scenario, track, result, finished).faults()
    finally:
        track.positions, track.charges, result.end_reason = before
    return {fault.kind.split(' (')[0] for fault in faults}


def _moved_to(place):
    def move(rows):
        rows = rows.copy()
        rows[:, 0, : len(place)] = place
        return rows

    return move


def _together(rows):
    rows = rows.copy()
    rows[:, 1] = rows[:, 0]
    return rows


def test_the_checker_finds_faults(searched):
    """A search as it was, and the same with true positions, charges and ends changed."""
    made, _, _, _ = searched
    environment = made.values['environment']
    zones = {key: environment[key][0] for key in ('keep_outs', 'obstacles')}
    middle = {
        key: zone.get('centre') or np.mean(zone['polygon'], axis=0).tolist()
        for key, zone in zones.items()
    }
    unfinished = _kinds(searched)
    assert not unfinished
    assert 'outside' in _kinds(searched, _moved_to([-0.5, 5.0]))
    assert 'nan' in _kinds(searched, _moved_to([np.nan, 5.0]))
    assert 'entered' in _kinds(searched, _moved_to(middle['keep_outs'][:2]))
    assert 'solid' in _kinds(searched, _moved_to(middle['obstacles'][:2]))
    assert 'apart' in _kinds(searched, _together)
    assert 'dry' in _kinds(searched, charges=lambda rows: 0.0 * rows)
    assert {'gives up', 'false share'} <= _kinds(
        searched, finished='99.9 % of the environment is explored', ended='planner_done'
    )
