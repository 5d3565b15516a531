"""The team's planning from step to step: who plans, who measures when, and on the fly."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from maasi_planner.coordinator import Coordinator
from maasi_planner.endurance import Endurance, EnduranceSettings, Phase
from maasi_planner.motion import RobotState
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planners.intermittent import Intermittent
from maasi_planner.robot_plan import Member, PresentRobot
from maasi_planner.team import TAKEN, Decision, single_choice, stay

ROBOT = {
    'candidates': {'grid': [4, 4], 'spacing': 2.0, 'corner': [2.0, 2.0]},
    'motion': {'model': 'constant_speed', 'speed': 1.0, 'tolerance': 0.1},
    'sensor': {
        'detection': {'kind': 'box', 'probability': 0.9, 'lower': [-1, -1], 'upper': [1, 1]},
        'noise': {'range': 0.1, 'bearing': 0.1},
        'period': 0.4,
    },
    'radius': 0.1,
}
BOTH = {'a': ROBOT, 'b': ROBOT}


def make(robots=BOTH, spacing=None, **planner):
    return Coordinator(
        PlannerNodeSettings.model_validate(
            {
                'step': 0.1,
                'environment': {'bounds': [[0.0, 10.0], [0.0, 10.0]]},
                'planner': planner,
                'robots': robots,
                'exploration_spacing': spacing,
            }
        )
    )


def there(free=True, **at):
    return {name: PresentRobot(RobotState.at_rest([*at[name], 0.0]), free) for name in at}


def started(**planner):
    """Return a coordinator whose two robots are on their way since step 0."""
    coordinator = make(**planner)
    coordinator.plan(0, there(a=(1.0, 1.0), b=(9.0, 9.0)))
    return coordinator


def test_free_robots_plan_together_and_measure_at_once_then_every_period():
    coordinator = make()
    robots = there(a=(1.0, 1.0), b=(9.0, 9.0))
    decision = coordinator.plan(0, robots)
    assert sorted(decision.robots) == ['a', 'b'] and decision.reason.startswith('maasi: a: ')
    assert coordinator.measure(0, robots) == [Member('a', 0, 0), Member('b', 0, 0)]
    moving = there(free=False, a=(1.1, 1.0), b=(9.0, 8.9))
    for step in (1, 2, 3):
        assert coordinator.plan(step, moving) is None
        assert coordinator.measure(step, moving) == []
    assert coordinator.measure(4, moving) == [Member('a', 0, 1), Member('b', 0, 1)]


def test_who_arrives_plans_alone_and_starts_its_period_anew():
    coordinator = started()
    robots = there(a=(2.0, 2.0)) | there(free=False, b=(8.5, 8.5))
    # The planner receives the other's destination and its next measurement.
    view = coordinator.robots['b'].view(5, robots['b'], False)
    assert view.phase == 3
    assert view.remaining_path == pytest.approx(coordinator.robots['b'].plan.positions[5:])
    assert list(coordinator.plan(6, robots).robots) == ['a']
    assert coordinator.robots['a'].plan.decision == 1
    assert coordinator.robots['b'].plan.decision == 0
    for step, name in ((6, 'a'), (8, 'b'), (10, 'a')):
        assert [item.robot for item in coordinator.measure(step, robots)] == [name]


def test_a_measurement_waits_for_an_image():
    coordinator = started()
    robots = there(a=(1.0, 1.0), b=(9.0, 9.0))
    assert [item.robot for item in coordinator.measure(0, robots, ['b'])] == ['b']
    assert [item.robot for item in coordinator.measure(1, robots, ['a', 'b'])] == ['a']
    assert coordinator.measure(2, robots, ['a', 'b']) == []


def test_one_left_alone_plans_alone_and_the_other_joins_again():
    coordinator = started()
    coordinator.robots['b'].clear_plan()
    assert list(coordinator.plan(5, there(a=(2.0, 2.0))).robots) == ['a']
    robots = there(free=False, a=(3.0, 2.0)) | there(b=(9.0, 9.0))
    assert list(coordinator.plan(9, robots).robots) == ['b']


@pytest.mark.parametrize(
    'planner',
    [
        {'measurement': 'event', 'trigger': 'absolute', 'threshold': 100.0},
        {'name': 'maas'},
        {'name': 'mutual_information'},
    ],
)
def test_without_measurements_on_the_way_those_at_waypoints_are_left(planner):
    coordinator = make(**planner)
    robots = there(a=(1.0, 1.0))
    coordinator.plan(0, robots)
    assert len(coordinator.measure(0, robots)) == 1
    for step in (4, 8, 12):
        assert coordinator.measure(step, there(free=False, a=(2.0, 1.0))) == []
    arrived = there(a=(2.0, 2.0))
    assert coordinator.plan(14, arrived) is not None
    assert len(coordinator.measure(14, arrived)) == 1


def test_nothing_is_planned_any_more_once_all_is_explored():
    coordinator = make()
    coordinator.exploration.values[...] = 0.0
    decision = coordinator.plan(0, there(a=(1.0, 1.0), b=(9.0, 9.0)))
    assert decision.robots == {}
    assert 'explored' in decision.reason
    assert coordinator.finished == decision.reason
    assert coordinator.plan(1, there(a=(1.0, 1.0))) is None


def test_a_refused_goal_is_planned_anew_at_the_next_period():
    coordinator = make()
    robots = there(a=(1.0, 1.0))
    coordinator.plan(0, robots)
    coordinator.robots['a'].plan.staying = True
    assert coordinator.plan(2, robots) is None
    assert list(coordinator.plan(4, robots).robots) == ['a']


def test_places_of_robots_that_plan_for_themselves_are_kept_clear():
    robots = there(a=(1.0, 1.0))
    free = make(name='nearest_widest').plan(0, robots).robots['a'].waypoint
    again = make(name='nearest_widest')
    other = again.plan(0, robots, taken=[(free, 0.1)]).robots['a'].waypoint
    assert np.linalg.norm(other - free) >= 0.2
    assert again.robots['a'].plan.destination(robots['a'].state) == pytest.approx(other, abs=0.1)
    again.robots['a'].plan.staying = True
    assert again.robots['a'].plan.destination(robots['a'].state) == pytest.approx([1.0, 1.0, 0.0])


# ---- decisions before a robot arrives -----------------------------------------------------------

GOALS = ((3.0, 1.0), (3.0, 4.0), (7.0, 4.0))


def flying(monkeypatch, radius=0.5, goals=GOALS, period=0.4):
    """Return the coordinator of one robot that is sent to `goals` one by one, then stays."""
    left = list(goals)

    def decide(self, team):
        view = team.robots['a']
        if not left:
            return Decision(team.step, {'a': stay(view, 'no more')})
        points = np.array([[*left.pop(0), 0.0]])
        prediction = view.motion.predict(view.state, points, team.step_time)
        return Decision(team.step, {'a': single_choice(points, prediction, 0, 'the next')})

    monkeypatch.setattr(Intermittent, 'decide', decide)
    motion = ROBOT['motion'] | {'arrival_radius': radius}
    sensor = ROBOT['sensor'] | {'period': period}
    coordinator = make({'a': ROBOT | {'motion': motion, 'sensor': sensor}})
    coordinator.plan(0, there(a=(1.0, 1.0)))
    assert coordinator.measure(0, there(a=(1.0, 1.0))) == [Member('a', 0, 0)]
    return coordinator


def on_the_way(*place):
    return there(free=False, a=place)


@pytest.mark.parametrize(
    ('planner', 'motion', 'radius'),
    [
        # Where it brakes, at most what the sensor sees: speed per distance left is 5 1/s, or
        # acceleration over speed.
        ({}, {}, 0.2),
        ({}, {'acceleration': 2.0}, 0.5),
        ({}, {'acceleration': 0.5}, 1.0),
        ({}, {'arrival_radius': 0.3}, 0.3),
        # Robots of the papers stop at each waypoint.
        ({'objective': 'paper'}, {}, 0.0),
        ({'name': 'maas'}, {}, 0.0),
        ({'name': 'maas'}, {'arrival_radius': 0.3}, 0.3),
    ],
)
def test_radius_within_which_the_next_waypoint_is_decided(planner, motion, radius):
    robot = ROBOT | {'motion': ROBOT['motion'] | motion}
    assert make({'a': robot}, **planner).robots['a'].facts.arrival_radius == pytest.approx(radius)


def test_the_next_waypoint_is_decided_within_the_radius(monkeypatch):
    coordinator = flying(monkeypatch)
    assert coordinator.plan(1, on_the_way(2.4, 1.0)) is None
    decision = coordinator.plan(2, on_the_way(2.6, 1.0))
    assert_allclose(decision.robots['a'].waypoint[:2], GOALS[1])
    assert coordinator.robots['a'].plan.decision == 1
    assert coordinator.plan(3, on_the_way(2.7, 1.0)) is None


def test_without_a_radius_or_for_another_client_it_is_decided_on_arrival(monkeypatch):
    coordinator = flying(monkeypatch, radius=0.0)
    assert coordinator.plan(1, on_the_way(3.0, 1.0)) is None
    assert coordinator.plan(2, there(a=(3.0, 1.0))) is not None
    coordinator = flying(monkeypatch)
    coordinator.robots['a'].on_external_goal(1)
    assert coordinator.plan(2, on_the_way(2.9, 1.0)) is None


def test_a_robot_with_nowhere_further_to_go_keeps_its_waypoint_and_plans_there(monkeypatch):
    coordinator = flying(monkeypatch, goals=GOALS[:1])
    assert coordinator.plan(2, on_the_way(2.6, 1.0)) is None
    assert_allclose(coordinator.robots['a'].plan.positions[-1][:2], GOALS[0], atol=0.2)
    assert coordinator.robots['a'].plan.decision == 0 and not coordinator.robots['a'].plan.staying
    assert coordinator.plan(3, on_the_way(2.7, 1.0)) is None
    assert coordinator.plan(6, there(a=(3.0, 1.0))).robots['a'].stays


def test_a_search_is_not_over_before_the_robot_has_arrived(monkeypatch):
    coordinator = flying(monkeypatch)
    coordinator.exploration.values[...] = 0.0
    assert coordinator.plan(2, on_the_way(2.6, 1.0)) is None
    assert coordinator.finished is None
    assert 'explored' in coordinator.plan(5, there(a=(3.0, 1.0))).reason
    assert coordinator.finished is not None


def test_a_waypoint_within_the_radius_is_gone_to_until_it_is_reached(monkeypatch):
    coordinator = flying(monkeypatch, goals=(GOALS[0], (3.0, 1.3), GOALS[2]))
    coordinator.plan(2, on_the_way(2.6, 1.0))
    assert coordinator.plan(3, on_the_way(2.9, 1.2)) is None
    assert coordinator.plan(5, there(a=(3.0, 1.3))) is not None


def test_the_measurement_at_a_waypoint_is_taken_at_the_closest_point(monkeypatch):
    coordinator = flying(monkeypatch, period=0.8)
    way = {2: (2.6, 1.0), 3: (2.8, 1.1), 4: (2.85, 1.3), 5: (2.9, 1.6), 6: (3.0, 1.9)}
    measured = []
    for step in range(2, 21):
        robots = on_the_way(*way.get(step, (3.0, 3.0)))
        if step in way:
            coordinator.plan(step, robots)
        measured += [step] * len(coordinator.measure(step, robots))
    # At step 4 it begins to get farther away, and the period begins.
    assert measured == [4, 12, 20]


def test_of_two_waypoints_passed_in_a_row_each_is_measured(monkeypatch):
    goals = ((3.0, 1.0), (3.6, 1.0), (7.0, 4.0))
    coordinator = flying(monkeypatch, goals=goals, period=10.0)
    coordinator.plan(2, on_the_way(2.6, 1.0))
    assert coordinator.measure(2, on_the_way(2.6, 1.0)) == []
    robots = on_the_way(2.95, 0.6)
    coordinator.robots['a'].plan.turning_distance = 1.0
    assert coordinator.plan(3, robots) is not None
    assert [item.robot for item in coordinator.measure(3, robots)] == ['a']


def test_a_robot_that_must_turn_home_does_so_as_soon_as_its_charger_is_free():
    coordinator = make({'a': ROBOT | {'endurance': {'per_metre': 0.01, 'chargers': [[1, 1, 0]]}}})
    here = RobotState.at_rest([5.0, 5.0, 0.0])
    coordinator.plan(0, {'a': PresentRobot(here, True, 1.0)})
    low = {'a': PresentRobot(here, False, 0.1)}
    occupied = [(np.array([1.0, 1.0, 0.0]), 0.1)]
    chosen = coordinator.plan(1, low, occupied).robots['a']
    assert chosen.reason.endswith(TAKEN)
    near = np.linalg.norm(chosen.waypoint - [1.0, 1.0, 0.0])
    assert 0.2 < near < 2.0
    # Near it, it waits; as soon as it is free it goes there.
    low = {'a': PresentRobot(RobotState.at_rest(chosen.waypoint), True, 0.1)}
    assert coordinator.plan(20, low, occupied).robots['a'].reason == f'waits: {TAKEN}'
    assert coordinator.plan(22, low, occupied) is None
    chosen = coordinator.plan(24, low).robots['a']
    assert chosen.reason.startswith('goes home') and chosen.waypoint.tolist() == [1.0, 1.0, 0.0]
    # Over its charger it is not home before it has stopped there.
    over = RobotState.at_rest([1.0, 1.0, 0.0])
    assert coordinator.plan(40, {'a': PresentRobot(over, False, 0.01)}) is None
    assert coordinator.robots['a'].endurance.phase is Phase.RETURNING
    landed = coordinator.plan(41, {'a': PresentRobot(over, True, 0.01)}).robots['a']
    assert landed.reason == 'charges: its battery is at 1 %'
    assert coordinator.plan(60, {'a': PresentRobot(over, True, 0.5)}) is None
    assert coordinator.plan(80, {'a': PresentRobot(over, True, 0.96)}).robots['a'].chosen >= 0


def test_who_is_sent_further_than_its_battery_affords_goes_home(monkeypatch):
    """By hand: 2.9 m there, and 3.5 m and a tenth home, use 0.34 of the battery."""
    for charge, waypoint in ((0.6, GOALS[1]), (0.58, (1.0, 1.0))):
        coordinator = flying(monkeypatch)
        robot = coordinator.robots['a']
        settings = EnduranceSettings(per_metre=0.05, reserve=0.25)
        robot.endurance = Endurance(settings, robot.facts.motion, [1.0, 1.0, 0.0])
        arrived = PresentRobot(RobotState.at_rest([*GOALS[0], 0.0]), True, charge)
        assert_allclose(coordinator.plan(30, {'a': arrived}).robots['a'].waypoint[:2], waypoint)
