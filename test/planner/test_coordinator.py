"""The team's planning from step to step: who plans and who measures when."""

import numpy as np
import pytest

from maasi_filter.models.pose import Pose
from maasi_planner.coordinator import Coordinator, Member, PresentRobot
from maasi_planner.motion import RobotState
from maasi_planner.node_settings import PlannerNodeSettings

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


def make(**planner):
    return Coordinator(
        PlannerNodeSettings.model_validate(
            {
                'step': 0.1,
                'environment': {'bounds': [[0.0, 10.0], [0.0, 10.0]]},
                'planner': planner,
                'robots': {'a': ROBOT, 'b': ROBOT},
            }
        )
    )


def there(free=True, **positions):
    return {
        name: PresentRobot(RobotState.at_rest([*place, 0.0]), free)
        for name, place in positions.items()
    }


def test_free_robots_plan_together_and_measure_at_once_then_every_period():
    coordinator = make()
    robots = there(a=(1.0, 1.0), b=(9.0, 9.0))
    decision = coordinator.plan(0, robots)
    assert sorted(decision.robots) == ['a', 'b']
    assert coordinator.measuring(0, robots) == [Member('a', 0, 0), Member('b', 0, 0)]
    moving = there(free=False, a=(1.1, 1.0), b=(9.0, 8.9))
    for step in (1, 2, 3):
        assert coordinator.plan(step, moving) is None
        assert coordinator.measuring(step, moving) == []
    assert coordinator.measuring(4, moving) == [Member('a', 0, 1), Member('b', 0, 1)]


def test_who_arrives_plans_alone_and_starts_its_period_anew():
    coordinator = make()
    coordinator.plan(0, there(a=(1.0, 1.0), b=(9.0, 9.0)))
    robots = {
        **there(a=(2.0, 2.0)),
        **there(free=False, b=(8.5, 8.5)),
    }
    decision = coordinator.plan(6, robots)
    assert list(decision.robots) == ['a']
    assert coordinator.decision_index('a') == 1
    assert coordinator.decision_index('b') == 0
    assert [item.robot for item in coordinator.measuring(6, robots)] == ['a']
    assert [item.robot for item in coordinator.measuring(8, robots)] == ['b']
    assert [item.robot for item in coordinator.measuring(10, robots)] == ['a']


def test_a_planner_is_told_where_the_others_go_and_when_they_measure_next():
    coordinator = make()
    coordinator.plan(0, there(a=(1.0, 1.0), b=(9.0, 9.0)))
    robots = {**there(a=(2.0, 2.0)), **there(free=False, b=(8.5, 8.5))}
    view = coordinator._team(6, robots, ['a'], ()).robots['b']
    assert view.phase == 2
    assert view.remaining_path == pytest.approx(coordinator.path('b')[6:])


def test_a_measurement_waits_for_an_image():
    coordinator = make()
    robots = there(a=(1.0, 1.0), b=(9.0, 9.0))
    coordinator.plan(0, robots)
    assert [item.robot for item in coordinator.measuring(0, robots, ['b'])] == ['b']
    assert [item.robot for item in coordinator.measuring(1, robots, ['a', 'b'])] == ['a']
    assert coordinator.measuring(2, robots, ['a', 'b']) == []


def test_one_left_alone_plans_alone_and_the_other_joins_again():
    coordinator = make()
    coordinator.plan(0, there(a=(1.0, 1.0), b=(9.0, 9.0)))
    coordinator.leave('b')
    decision = coordinator.plan(5, there(a=(2.0, 2.0)))
    assert list(decision.robots) == ['a']
    robots = {**there(free=False, a=(3.0, 2.0)), **there(b=(9.0, 9.0))}
    decision = coordinator.plan(9, robots)
    assert list(decision.robots) == ['b']


def test_exploration_follows_the_poses_of_the_measurements():
    coordinator = make()
    coordinator.absorb({'a': Pose.from_yaw([5.0, 5.0, 0.0], 0.0)}, [])
    assert coordinator.exploration.at(np.array([[5.0, 5.0]]))[0] == pytest.approx(0.1)
    assert coordinator.exploration.at(np.array([[8.0, 8.0]]))[0] == 1.0


def test_an_event_trigger_that_is_never_met_leaves_the_measurement_at_the_decision():
    coordinator = make(measurement='event', trigger='absolute', threshold=100.0)
    robots = there(a=(1.0, 1.0))
    coordinator.plan(0, robots)
    assert len(coordinator.measuring(0, robots)) == 1
    assert coordinator.measuring(4, robots) == []


def test_nothing_is_planned_any_more_once_all_is_explored():
    coordinator = make()
    for x in np.arange(0.0, 10.1, 0.5):
        for y in np.arange(0.0, 10.1, 0.5):
            for _ in range(4):
                coordinator.absorb({'a': Pose.from_yaw([x, y, 0.0], 0.0)}, [])
    decision = coordinator.plan(0, there(a=(1.0, 1.0), b=(9.0, 9.0)))
    assert decision.robots == {}
    assert 'explored' in decision.reason
    assert coordinator.finished == decision.reason
    assert coordinator.plan(1, there(a=(1.0, 1.0))) is None


def test_a_refused_goal_is_planned_anew_at_the_next_period():
    coordinator = make()
    robots = there(a=(1.0, 1.0))
    coordinator.plan(0, robots)
    coordinator.refuse('a')
    assert coordinator.is_idle('a')
    assert coordinator.plan(2, robots) is None
    assert list(coordinator.plan(4, robots).robots) == ['a']


def test_places_of_robots_that_plan_for_themselves_are_kept_clear():
    coordinator = make(name='nearest_widest')
    robots = there(a=(1.0, 1.0))
    free = coordinator.plan(0, robots).robots['a'].waypoint
    again = make(name='nearest_widest')
    other = again.plan(0, robots, taken=[(free, 0.1)]).robots['a'].waypoint
    assert np.linalg.norm(other - free) >= 0.2
    assert again.destination('a', robots['a'].state) == pytest.approx(other, abs=0.1)
    again.refuse('a')
    assert again.destination('a', robots['a'].state) == pytest.approx([1.0, 1.0, 0.0])


@pytest.mark.parametrize('name', ['maas', 'mutual_information'])
def test_active_search_measures_at_its_waypoints_only(name):
    coordinator = make(name=name)
    robots = there(a=(1.0, 1.0))
    coordinator.plan(0, robots)
    assert len(coordinator.measuring(0, robots)) == 1
    for step in (4, 8, 12):
        assert coordinator.measuring(step, there(free=False, a=(2.0, 1.0))) == []
    arrived = there(a=(2.0, 2.0))
    assert coordinator.plan(14, arrived) is not None
    assert len(coordinator.measuring(14, arrived)) == 1
