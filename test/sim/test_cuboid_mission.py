"""Whole searches of buildings in one process (004)."""

import numpy as np
import pytest

from maasi_planner.buildings import (
    CuboidSettings,
    DynamicsSettings,
    HazardSettings,
    SearchAgent,
)
from maasi_sim.buildings.mission import CuboidMission, SearchRobot, summary, within_range

AREA = [[0, 300], [0, 300], [0, 80]]
BUILDING = {'centre': [175, 130], 'size': [60, 60, 60]}
STARTS = {'green': [120.0, 70.0, 5.0], 'red': [230.0, 200.0, 5.0], 'blue': [110.0, 210.0, 30.0]}


def make_mission(starts=STARTS, scheme='distributed', seed=1, hazard=None, **settings):
    battery = hazard or HazardSettings(failures=False)
    options = {'objects': [BUILDING], 'time_limit': 1e9, 'communication_range': 430.0, **settings}
    robots = {name: SearchRobot(np.array(place), hazard=battery) for name, place in starts.items()}
    return CuboidMission(CuboidSettings(**options), AREA, robots, seed=seed, scheme=scheme)


def check_complete(record):
    """Assert what holds for every mission that ends well."""
    figures = summary(record)
    assert record.complete and figures['visited'] == figures['cuboids']
    assert record.collisions == 0 and record.outside == 0
    # Every cuboid has a snapshot from inside it.
    assert {shot.cuboid for shot in record.snapshots} == set(range(figures['cuboids']))
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


def test_a_seed_gives_the_same_mission():
    first, second, other = (make_mission(seed=seed).run(200) for seed in (3, 3, 4))
    assert first.steps == second.steps
    for name in STARTS:
        assert (first.paths[name] == second.paths[name]).all()
    assert any(
        first.paths[name].shape != other.paths[name].shape
        or (first.paths[name] != other.paths[name]).any()
        for name in STARTS
    )


def test_batteries_fail_and_the_mission_goes_on():
    hazard = HazardSettings(alpha=12.0, recharge_steps=[2, 4])
    record = make_mission(hazard=hazard).run(600)
    check_complete(record)
    assert record.recharges > 2
    assert record.active.min() < 3
    # Robots that fly home or recharge come back.
    assert (np.diff(record.active) > 0).any()


def test_a_wall_in_front_of_the_target_is_flown_around():
    target = {'centre': [60, 150], 'size': [20, 20, 20], 'faces': ['east']}
    wall = {'centre': [140, 150], 'size': [10, 160, 80]}
    start = {'red': [200.0, 150.0, 5.0]}
    for horizon in (5, 10):
        record = make_mission(start, objects=[target], obstacles=[wall], horizon=horizon).run(100)
        check_complete(record)
    stuck = make_mission(
        start, objects=[target], obstacles=[wall], horizon=5, around_corners=False
    ).run(100)
    # As printed: it sticks to the wall, and does not cut it.
    assert not stuck.complete and stuck.collisions == 0
    assert np.ptp(stuck.paths['red'][-20:], axis=0).max() < 5.0


def test_undiscounted_rewards_let_a_robot_hover_and_the_discount_frees_it():
    start = {'red': [160.0, 200.0, 5.0]}
    options = {'guidance_step': 6}
    hovering = make_mission(start, discount=1.0, **options).run(200)
    assert not hovering.complete
    # It always plans to visit later.
    assert np.ptp(hovering.paths['red'][-30:], axis=0).max() < 0.1
    check_complete(make_mission(start, **options).run(200))


def test_what_is_put_off_is_discounted_more(monkeypatch):
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
    monkeypatch.undo()
    agent = make_mission({'red': [160.0, 200.0, 5.0]}).agents['red']
    rewards = [agent.solver.objective.rewards(n) for n in (0, 1, 3)]
    assert rewards[0][1] == rewards[1][1] == rewards[2][1] == 0.3
    assert rewards[1][3] == pytest.approx(0.3 * 0.95**4)
    assert rewards[2][3] == pytest.approx(0.3 * 0.95**8)


def test_what_is_planned_for_the_next_step_is_visited():
    mission = make_mission(discount=1.0)
    due, met = [], []

    def noting(agent, decide):
        def wrapped(*arguments):
            met.extend((agent.name, n) for name, n in due if name == agent.name)
            assert all(agent.visited[n] for name, n in due if name == agent.name)
            due[:] = [pair for pair in due if pair[0] != agent.name]
            choice = decide(*arguments)
            due.extend((agent.name, n) for k, n in choice.plan.visits if k == 1)
            return choice

        return wrapped

    for agent in mission.agents.values():
        agent.decide = noting(agent, agent.decide)
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
    # Far apart, the maps differ; in range, they are merged one hop a step.
    far = make_mission(communication_range=1e-3)
    far.run(20)
    near = make_mission(communication_range=430.0)
    near.run(20)
    maps = {
        name: [agent.visited for agent in mission.agents.values()]
        for name, mission in (('far', far), ('near', near))
    }
    assert any((maps['far'][0] != other).any() for other in maps['far'][1:])
    assert np.any(maps['near'], axis=0).sum() - maps['near'][0].sum() <= 3


def test_a_robot_that_cannot_fly_is_refused_before_take_off():
    robot = SearchRobot(np.array([10.0, 10.0, 5.0]), DynamicsSettings(mass=4.0))
    with pytest.raises(ValueError, match=r'cannot lift the weight'):
        CuboidMission(CuboidSettings(objects=[BUILDING]), AREA, {'heavy': robot})
