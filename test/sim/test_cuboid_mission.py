"""Whole searches of buildings in one process (004)."""

from functools import partial

import numpy as np
import pytest

from maasi_planner.buildings.agent import SearchAgent
from maasi_planner.buildings.settings import CuboidSettings, SearcherSettings
from maasi_sim.experiments.papers import find
from maasi_sim.run.buildings.mission import CuboidMission, within_range

AREA = [[0, 300], [0, 300], [0, 80]]
BUILDING = {'centre': [175, 130], 'size': [60, 60, 60]}
STARTS = {'green': [120.0, 70.0, 5.0], 'red': [230.0, 200.0, 5.0], 'blue': [110.0, 210.0, 30.0]}


def make_mission(starts=STARTS, scheme='distributed', seed=1, hazard=None, **settings):
    battery = hazard or {'failures': False}
    options = {'objects': [BUILDING], 'time_limit': 1e9, 'communication_range': 430.0, **settings}
    robots = {
        name: SearcherSettings.model_validate({'start': place, 'hazard': battery})
        for name, place in starts.items()
    }
    return CuboidMission(CuboidSettings(**options), AREA, robots, seed=seed, scheme=scheme)


def check_complete(record):
    """Assert what holds for every mission that ends well."""
    assert record.collisions == 0
    check_visits(record)


def check_visits(record):
    """Assert what holds also where corners may be cut, as printed."""
    assert record.complete and record.visited[-1] == len(record.mission.cells)
    assert record.outside == 0
    # Every cuboid has a snapshot from inside it.
    assert {shot.cuboid for shot in record.snapshots} == set(range(record.visited[-1]))
    for shot in record.snapshots:
        box = record.mission.boxes[shot.cuboid]
        assert (shot.position >= box[:, 0]).all() and (shot.position <= box[:, 1]).all()
        assert (record.paths[shot.robot][shot.step] == shot.position).all()
    for path in record.paths.values():
        assert np.abs(np.diff(path, axis=0)).max() <= 15.0 + 1e-3


@pytest.mark.parametrize('scheme', ['distributed', 'sequential', 'centralized'])
def test_all_schemes_search_everything(scheme):
    record = make_mission(scheme=scheme).run(200)
    check_complete(record)
    assert record.steps < 80
    assert record.how['optimal'] >= 0.95 * sum(record.how.values())


def test_a_wall_in_front_of_the_target_is_flown_around():
    target = {'centre': [60, 150], 'size': [20, 20, 20], 'faces': ['east']}
    wall = {'centre': [140, 150], 'size': [10, 160, 80]}
    start = {'red': [200.0, 150.0, 5.0]}
    options = {'objects': [target], 'obstacles': [wall]}
    for horizon in (5, 10):
        check_complete(make_mission(start, horizon=horizon, **options).run(100))
    stuck = make_mission(start, horizon=5, around_corners=False, **options).run(100)
    # As printed: it sticks to the wall, and does not cut it.
    assert not stuck.complete and stuck.collisions == 0
    assert np.ptp(stuck.paths['red'][-20:], axis=0).max() < 5.0


def test_undiscounted_rewards_let_a_robot_hover_and_the_discount_frees_it():
    start = {'red': [160.0, 200.0, 5.0]}
    hovering = make_mission(start, discount=1.0, guidance_step=6).run(200)
    assert not hovering.complete
    # It always plans to visit later.
    assert np.ptp(hovering.paths['red'][-30:], axis=0).max() < 0.1
    check_complete(make_mission(start, guidance_step=6).run(200))


def test_what_is_put_off_is_discounted_more(monkeypatch):
    rewards = [CuboidSettings().rewards(number) for number in (0, 1, 3)]
    assert [reward[1] for reward in rewards] == [0.3] * 3
    expected = [pytest.approx(0.3 * 0.95**power) for power in (2, 4, 8)]
    assert [reward[3] for reward in rewards] == expected
    # From here a robot hovers for ever if the discount stays as it is.
    starts = {
        'agent01': [168.24, 156.19, 63.17],
        'agent02': [259.63, 171.91, 55.61],
        'agent03': [137.75, 21.24, 30.88],
    }
    options = {'scheme': 'sequential', 'assignment': 'printed', 'alpha': 1.5, 'beta': 1.0}
    check_complete(make_mission(starts, **options).run(200))
    never = property(lambda self: 0, lambda self, value: None)
    monkeypatch.setattr(SearchAgent, 'put_off', never, raising=False)
    assert not make_mission(starts, **options).run(200).complete


def test_condition_13_as_printed_lets_robots_drop_and_take_up_the_same_cuboids_for_ever():
    starts = {'a': [59.0, 237.0, 33.0], 'b': [220.0, 269.0, 30.0], 'c': [83.0, 78.0, 41.0]}
    rows = {case.name: case.settings['mission'] for case in find('004-fig8').cases(False)}
    printed, other = (
        make_mission(starts, **rows[f'distributed, 3 agents, as printed{what}'])
        for what in ('', ' except (13)')
    )
    plans = {}

    def noting(agent, decide, *arguments):
        plan = decide(*arguments)
        plans.setdefault(agent.step, []).append({n for _, n in plan.visits})
        return plan

    for agent in printed.agents.values():
        agent.decide = partial(noting, agent, agent.decide)
    record = printed.run(100)
    assert not record.complete and set(record.how) == {'optimal'}
    assert plans[99] == plans[97] and plans[98] == plans[96]
    # All three plan the same, and at the next step none of these.
    assert set.intersection(*plans[98]) and not set.union(*plans[98]) & set.union(*plans[99])
    check_visits(other.run(100))


def test_what_is_planned_for_the_next_step_is_visited():
    mission = make_mission(discount=1.0)
    due, met = {}, []

    def noting(agent, decide, *arguments):
        met.extend(due.get(agent.name, []))
        assert agent.visited[due.get(agent.name, [])].all()
        plan = decide(*arguments)
        due[agent.name] = [n for k, n in plan.visits if k == 1]
        return plan

    for agent in mission.agents.values():
        agent.decide = partial(noting, agent, agent.decide)
    check_complete(mission.run(200))
    # Not the last, which ends the mission.
    assert len(met) >= 10


def test_robots_hear_each_other_only_in_range():
    places = {
        'a': np.array([0.0, 0.0, 0.0]),
        'b': np.array([0.0, 60.0, 80.0]),
        'c': np.array([0.0, 120.0, 160.0]),
    }
    assert within_range(places, 100.0) == {'a': ['b'], 'b': ['a', 'c'], 'c': ['b']}
    assert within_range(places, 99.0) == {'a': [], 'b': [], 'c': []}
    # Out of range all visit the same cuboids; in range, maps are merged one hop a step.
    far, near = [make_mission(communication_range=reach) for reach in (1e-3, 430.0)]
    assert near.run(30).visited[-1] > 1.5 * far.run(30).visited[-1]
    maps = np.array([agent.visited for agent in near.agents.values()])
    assert (maps.any(axis=0) & ~maps).sum(axis=1).max() <= 3
