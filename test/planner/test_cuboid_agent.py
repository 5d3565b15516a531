"""One robot of the distributed search: battery, what it makes of others, and when solves fail."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cuboid_instances import AREA, two_buildings

from maasi_planner.buildings import (
    Activity,
    Broadcast,
    Dynamics,
    HazardSettings,
    SearchAgent,
    plan_mission,
)
from maasi_planner.buildings.guidance import WayFinder, assigned
from maasi_planner.buildings.robot_model import Hazard, HeardPlan, rewards

HOME = [166.0, 235.0, 5.0]
NEVER = HazardSettings(failures=False)


def make_agent(name='purple', hazard=NEVER, home=HOME, **settings):
    options = two_buildings(time_limit=1e9, **settings)
    return SearchAgent(name, options, plan_mission(options, AREA), Dynamics(), hazard, home)


def heard_from(agent, **others):
    message = Broadcast(
        robot='red',
        step=agent.step,
        position=np.array([185.0, 235.0, 5.0]),
        velocity=np.zeros(3),
        searching=True,
        visited=np.zeros(32, dtype=bool),
        flight_steps=1,
        plan={},
        hazard=agent.hazard,
        predicted=np.array([185.0, 235.0, 5.0]),
    )
    return replace(message, **others)


def test_hazard_is_equation_3():
    hazard = Hazard(30.0, 0.3)
    for steps in (0, 20, 35, 60):
        assert hazard(steps) == pytest.approx(1 / (1 + 30 * math.exp(-0.3 * (steps - 30))))
    assert Hazard(30.0, 0.3, failures=False)(1000) == 0.0
    assert Hazard(1000.0, 100.0)(0) == pytest.approx(0.0)


def test_rewards_are_drawn_with_the_probabilities_of_11_to_14():
    hazard = Hazard(20.0, 0.3)
    heard = [HeardPlan({4: 3, 7: 5}, 25, hazard), HeardPlan({4: 6}, 28, hazard)]
    p4 = [hazard(25 + 3 - 1), hazard(28 + 6 - 1)]
    p7 = [hazard(25 + 5 - 1)]
    own = hazard(3 + 10)

    def chance(fails):
        expected = sum(1 - p for p in fails)
        joins = 1 - 1 / (1 + 2.0 * math.exp(-0.5 * (expected - 2.0)))
        return max((1 - own) * math.prod(fails), joins)

    rng = np.random.default_rng(0)
    draws = np.array(
        [rewards(10, 3, 10, hazard, heard, 2.0, 0.5, 'low_hazard', rng) for _ in range(4000)]
    )
    rates = draws.mean(axis=0)
    assert rates[4] == pytest.approx(chance(p4), abs=0.03)
    assert rates[7] == pytest.approx(chance(p7), abs=0.03)
    assert (np.delete(rates, [4, 7]) == 1.0).all()


def test_printed_condition_leaves_13_out_while_the_battery_is_good():
    hazard = Hazard(100.0, 0.3)
    heard = [HeardPlan({4: 3}, 1, hazard)]
    rng = np.random.default_rng(0)
    draws = [rewards(6, 1, 10, hazard, heard, 2.0, 0.5, 'printed', rng)[4] for _ in range(200)]
    assert not any(draws)


def test_assignment_shares_the_nearest_cuboids():
    centres = np.array([[0.0, 0, 0], [10.0, 0, 0], [50.0, 0, 0]])
    places = np.array([[1.0, 0, 0], [2.0, 0, 0]])
    unvisited = np.array([0, 1, 2])
    assert [assigned(places, own, centres, unvisited) for own in (0, 1)] == [0, 1]
    # The nearest to both is given to one of them, the sum being least.
    places = np.array([[9.0, 0, 0], [1.0, 0, 0]])
    assert [assigned(places, own, centres, unvisited) for own in (0, 1)] == [1, 0]
    assert assigned(places, 0, centres, np.array([0])) is None
    assert assigned(places, 1, centres, np.array([0])) == 0
    assert assigned(places, 0, centres, np.array([], dtype=int)) is None


def test_way_around_a_wall():
    wall = np.array([[[48.0, 52.0], [0.0, 80.0], [0.0, 80.0]]])
    area = np.array([[0.0, 100.0], [0.0, 100.0], [0.0, 80.0]])
    ways = WayFinder(wall, area, 15.0, 3.0)
    place, target = np.array([20.0, 20.0, 5.0]), np.array([80.0, 20.0, 5.0])
    corner = ways.first_corner(place, target)
    assert corner[0] == pytest.approx(45.0) and corner[1] == pytest.approx(83.0)
    assert (ways.first_corner(corner, target)[:2] == [55.0, 83.0]).all()
    clear = np.array([20.0, 90.0, 5.0])
    assert (ways.first_corner(place, clear) == clear).all()
    closed = WayFinder(np.array([[[48.0, 52.0], [-1.0, 101.0], [-1.0, 81.0]]]), area, 15.0, 3.0)
    assert not closed.reaches(place, target)
    assert ways.reaches(place, target)


def test_snapshot_looks_along_the_normal_and_says_its_probability():
    agent = make_agent()
    agent.observe(0, agent.mission.centres[5] + np.array([1.0, 0.5, -2.0]), np.zeros(3))
    assert np.flatnonzero(agent.visited).tolist() == [5]
    (shot,) = agent.snapshots
    cell = agent.mission.cells[5]
    assert shot.direction == pytest.approx(-cell.normal)
    distance = (shot.position - cell.centre) @ cell.normal
    assert shot.distance == pytest.approx(distance)
    assert shot.detection_probability == pytest.approx(1 - (distance - 17) / 73)
    agent.observe(1, agent.mission.centres[5], np.zeros(3))
    assert len(agent.snapshots) == 1


def test_maps_are_merged_and_not_visited_again():
    agent = make_agent()
    agent.observe(0, HOME, np.zeros(3))
    theirs = np.ones(32, dtype=bool)
    theirs[9] = False
    choice = agent.decide([heard_from(agent, visited=theirs)], np.random.default_rng(0))
    assert np.flatnonzero(~agent.visited).tolist() == [9]
    assert {n for _, n in choice.plan.visits} <= {9}


def test_nothing_left_to_do_holds_the_place():
    agent = make_agent()
    place, speed = np.array([100.0, 200.0, 40.0]), np.array([3.0, 0.0, 0.0])
    agent.visited[:] = True
    for step in range(30):
        agent.observe(step, place, speed)
        choice = agent.decide([], np.random.default_rng(step))
        place, speed = agent.dynamics.next(place, speed, choice.control)
    assert agent.done and np.abs(speed).max() < 0.2
    assert np.linalg.norm(place - [100.0, 200.0, 40.0]) < 25.0


def test_battery_fails_recharges_and_takes_up_its_work():
    agent = make_agent(hazard=HazardSettings(alpha=5.0, beta=2.0, recharge_steps=[4, 4]))
    place, speed = np.array(HOME), np.zeros(3)
    seen = []
    for step in range(60):
        message = agent.observe(step, place, speed)
        assert (message is None) == (agent.activity is Activity.RECHARGING)
        choice = agent.decide([], np.random.default_rng(step))
        seen.append(agent.activity)
        place, speed = agent.dynamics.next(place, speed, choice.control)
        if agent.activity is Activity.RETURNING:
            assert choice.plan.visits == []
    assert Activity.RETURNING in seen and Activity.RECHARGING in seen
    first = seen.index(Activity.RECHARGING)
    assert np.linalg.norm(place - HOME) < 100.0
    after = seen[first:].index(Activity.SEARCHING)
    assert after in (3, 4)
    assert seen[0] is Activity.SEARCHING


def test_one_that_recharges_or_is_away_is_no_obstacle():
    agent = make_agent()
    agent.observe(0, HOME, np.zeros(3))
    alone = agent.decide([], np.random.default_rng(0))
    other = make_agent()
    other.observe(0, HOME, np.zeros(3))
    away = heard_from(other, searching=False, plan=dict.fromkeys(range(32), 2))
    assert (other.decide([away], np.random.default_rng(0)).control == alone.control).all()


def test_a_failed_solve_flies_the_plan_before_then_brakes(monkeypatch):
    agent = make_agent()
    agent.observe(0, HOME, np.zeros(3))
    first = agent.decide([], np.random.default_rng(0))
    assert first.how == 'optimal'
    monkeypatch.setattr(agent.solver, 'solve', lambda problem: None)
    place, speed = agent.dynamics.next(HOME, np.zeros(3), first.control)
    agent.observe(1, place, speed)
    second = agent.decide([], np.random.default_rng(1))
    assert second.how == 'shifted'
    assert second.control == pytest.approx(first.plan.controls[1])
    # A gust: the plan before is not that of this place.
    agent.observe(2, place + np.array([20.0, 0.0, 0.0]), np.array([8.0, 0.0, -2.0]))
    third = agent.decide([], np.random.default_rng(2))
    assert third.how == 'brake'
    assert third.control == pytest.approx(agent.dynamics.braking([8.0, 0.0, -2.0]))
    assert agent.failed == 2


def test_a_missed_step_forgets_the_plan():
    agent = make_agent()
    agent.observe(0, HOME, np.zeros(3))
    agent.decide([], np.random.default_rng(0))
    message = agent.observe(7, HOME, np.zeros(3))
    assert message is not None and message.plan == {}


def test_bad_input():
    with pytest.raises(ValueError, match=r'purple: start: read .*inside the area'):
        make_agent(home=[300.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r'purple: start: .*inside an object'):
        make_agent(home=[175.0, 130.0, 10.0])
    cage = [
        {'centre': [166, 225], 'size': [40, 2, 80]},
        {'centre': [166, 245], 'size': [40, 2, 80]},
        {'centre': [150, 235], 'size': [2, 40, 80]},
        {'centre': [182, 235], 'size': [2, 40, 80]},
    ]
    with pytest.raises(ValueError, match=r'no cuboid can be reached: obstacles close it in'):
        make_agent(obstacles=cage)
    agent = make_agent()
    with pytest.raises(ValueError, match=r'purple: state: got'):
        agent.observe(0, [np.nan, 0.0, 0.0], np.zeros(3))
    with pytest.raises(ValueError, match='recharge_steps: got'):
        HazardSettings(recharge_steps=[5, 2])
