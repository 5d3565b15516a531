"""Decisions before a robot arrives: when, what is measured there, and where it stops."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_coordinator import ROBOT, there

from maasi_planner.coordinator import Coordinator, Member
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planners.intermittent import Intermittent
from maasi_planner.team import Decision, single_choice, stay
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.search import search

GOALS = ((3.0, 1.0), (3.0, 4.0), (7.0, 4.0))


def make(monkeypatch, radius=0.5, goals=GOALS, period=0.4, **planner):
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
    coordinator = Coordinator(
        PlannerNodeSettings.model_validate(
            {
                'step': 0.1,
                'environment': {'bounds': [[0.0, 10.0], [0.0, 10.0]]},
                'planner': planner,
                'robots': {'a': ROBOT | {'motion': motion, 'sensor': sensor}},
            }
        )
    )
    coordinator.plan(0, there(a=(1.0, 1.0)))
    return coordinator


def on_the_way(*place):
    return there(free=False, a=place)


def radii(planner=(), **motion):
    robot = ROBOT | {'motion': ROBOT['motion'] | motion}
    settings = {
        'step': 0.1,
        'environment': {'bounds': [[0.0, 10.0], [0.0, 10.0]]},
        'planner': dict(planner),
        'robots': {'a': robot},
    }
    return Coordinator(PlannerNodeSettings.model_validate(settings))._plans['a'].arrival_radius


def test_the_default_is_where_it_brakes_at_most_what_the_sensor_sees():
    # Speed per distance left is 5 1/s, or acceleration over speed.
    assert radii() == pytest.approx(0.2)
    assert radii(acceleration=2.0) == pytest.approx(0.5)
    assert radii(acceleration=0.5) == pytest.approx(1.0)
    assert radii(arrival_radius=0.3) == 0.3


@pytest.mark.parametrize('planner', [{'objective': 'paper'}, {'name': 'maas'}])
def test_robots_of_the_papers_stop_at_each_waypoint(planner):
    assert radii(planner) == 0.0
    assert radii(planner, arrival_radius=0.3) == 0.3


def test_the_next_waypoint_is_decided_within_the_radius(monkeypatch):
    coordinator = make(monkeypatch)
    assert coordinator.plan(1, on_the_way(2.4, 1.0)) is None
    decision = coordinator.plan(2, on_the_way(2.6, 1.0))
    assert_allclose(decision.robots['a'].waypoint[:2], GOALS[1])
    assert coordinator.decision_index('a') == 1
    assert coordinator.plan(3, on_the_way(2.7, 1.0)) is None


def test_without_a_radius_it_is_decided_on_arrival(monkeypatch):
    coordinator = make(monkeypatch, radius=0.0)
    assert coordinator.plan(1, on_the_way(3.0, 1.0)) is None
    assert coordinator.plan(2, there(a=(3.0, 1.0))) is not None


def test_a_robot_with_nowhere_further_to_go_keeps_its_waypoint_and_plans_there(monkeypatch):
    coordinator = make(monkeypatch, goals=GOALS[:1])
    assert coordinator.plan(2, on_the_way(2.6, 1.0)) is None
    assert_allclose(coordinator.path('a')[-1][:2], GOALS[0], atol=0.2)
    assert coordinator.decision_index('a') == 0 and not coordinator.is_idle('a')
    assert coordinator.plan(3, on_the_way(2.7, 1.0)) is None
    assert coordinator.plan(6, there(a=(3.0, 1.0))).robots['a'].stays


def test_a_search_is_not_over_before_the_robot_has_arrived(monkeypatch):
    coordinator = make(monkeypatch)
    coordinator.exploration.values[...] = 0.0
    assert coordinator.plan(2, on_the_way(2.6, 1.0)) is None
    assert coordinator.finished is None
    assert 'explored' in coordinator.plan(5, there(a=(3.0, 1.0))).reason
    assert coordinator.finished is not None


def test_a_waypoint_within_the_radius_is_gone_to_until_it_is_reached(monkeypatch):
    coordinator = make(monkeypatch, goals=(GOALS[0], (3.0, 1.3), GOALS[2]))
    coordinator.plan(2, on_the_way(2.6, 1.0))
    assert coordinator.plan(3, on_the_way(2.9, 1.2)) is None
    assert coordinator.plan(5, there(a=(3.0, 1.3))) is not None


def test_the_measurement_at_a_waypoint_is_taken_at_the_closest_point(monkeypatch):
    coordinator = make(monkeypatch, period=0.8)
    assert coordinator.measuring(0, there(a=(1.0, 1.0))) == [Member('a', 0, 0)]
    way = {2: (2.6, 1.0), 3: (2.8, 1.1), 4: (2.85, 1.3), 5: (2.9, 1.6), 6: (3.0, 1.9)}
    measured = []
    for step, place in way.items():
        coordinator.plan(step, on_the_way(*place))
        measured += [step] * len(coordinator.measuring(step, on_the_way(*place)))
    # At step 4 it begins to get farther away, and the period begins.
    assert measured == [4]
    steps = range(7, 21)
    measured = [step for step in steps if coordinator.measuring(step, on_the_way(3.0, 3.0))]
    assert measured == [12, 20]


def test_of_two_waypoints_passed_in_a_row_each_is_measured(monkeypatch):
    coordinator = make(monkeypatch, goals=((3.0, 1.0), (3.6, 1.0), (7.0, 4.0)), period=10.0)
    coordinator.measuring(0, there(a=(1.0, 1.0)))
    coordinator.plan(2, on_the_way(2.6, 1.0))
    assert coordinator.measuring(2, on_the_way(2.6, 1.0)) == []
    robots = there(free=False, a=(2.95, 0.6))
    coordinator._plans['a'].turning_distance = 1.0
    assert coordinator.plan(3, robots) is not None
    assert [item.robot for item in coordinator.measuring(3, robots)] == ['a']


def test_a_robot_of_another_client_is_not_sent_further(monkeypatch):
    coordinator = make(monkeypatch)
    coordinator.lend('a', 1)
    assert coordinator.plan(2, on_the_way(2.9, 1.0)) is None


def test_a_search_passes_waypoints_without_slowing_down():
    scenario = load_scenario('mambo')
    robot = scenario.robots['mambo']
    content = scenario.model_dump(by_alias=True, exclude_unset=True)
    content['limits']['time'] = 30.0
    speeds = {}
    for radius in (0.0, 0.3):
        content['robots']['mambo']['motion']['arrival_radius'] = radius
        result = search(type(scenario).model_validate(content), 1)
        places = np.array([item.positions['mambo'] for item in result.progress])
        times = np.array([item.time for item in result.progress])
        speeds[radius] = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times)
    slow = {radius: np.mean(values < 0.15) for radius, values in speeds.items()}
    assert slow[0.3] < 0.5 * slow[0.0]
    assert robot.motion.arrival_radius is None


def test_the_experiments_of_the_papers_stop_at_each_waypoint():
    from maasi_sim.experiments.papers import experiments

    for name, experiment in experiments().items():
        for case in experiment.cases(True):
            robots = case.settings.get('scenario', {}).get('robots', {})
            for robot in robots.values():
                assert robot['motion']['arrival_radius'] == 0.0, (name, case.name)
