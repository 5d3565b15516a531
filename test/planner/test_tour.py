"""The planner `tour`: covers, keeps its plan, answers clusters, and keeps robots apart."""

import itertools

import numpy as np
import pytest
from planner_helpers import follow, planning_robot, random_team

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.detection import BoxDetection, ExponentialDetection
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import TeamView, make_planner
from maasi_planner.endurance import NOTHING_AFFORDABLE, Endurance, EnduranceSettings, Phase
from maasi_planner.planners.base import check_decision
from maasi_planner.planners.lattice import Lattice, passing, turned
from maasi_planner.team import SAVES_BATTERY
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.search import search

BOX = BoxDetection([-1.0, -1.0], [1.0, 1.0], 0.98, 'world')


def field(detection=BOX, starts=((1.0, 1.0, 0.0),), size=12.0, obstacles=None, arrival=0.0):
    bounds = np.array([[0.0, size]] * 2)
    views = [planning_robot(start, detection, obstacles) for start in starts]
    for view in views:
        view.arrival_radius = arrival
    robots = {f'robot{number}': view for number, view in enumerate(views)}
    return TeamView(0, 0.1, robots, [], UnexploredMap(bounds, size / 48.0))


def fly(planner, team, name='robot0'):
    """Send a robot to its next waypoint, with measurements on the way; return the waypoint."""
    decision = planner.decide(team)
    check_decision(planner, team, decision)
    robot = decision.robots[name]
    if robot.stays:
        return None
    follow(team, name, robot, 5)
    return robot.waypoint


def test_a_box_gives_lanes_that_cover_the_area_once():
    team, planner = field(), make_planner('tour')
    way = [np.array([1.0, 1.0, 0.0])]
    while team.exploration.explored_fraction() < 0.97:
        way.append(fly(planner, team))
    # 36 squares of 2 m: 70 m; straight runs are one leg.
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() < 72.0
    assert len(way) < 15
    while planner.finished(team) is None:
        fly(planner, team)
    assert team.exploration.explored_fraction() > 0.998


def test_lanes_lie_askew_in_a_large_area_where_the_box_is_wider_so():
    team, planner = field(size=40.0), make_planner('tour')
    way = [np.array([1.0, 1.0, 0.0])]
    while team.exploration.explored_fraction() < 0.8:
        way.append(fly(planner, team))
    steps = np.diff(way, axis=0)[:, :2]
    lengths = np.linalg.norm(steps, axis=1)
    # Along its sides, a box of 2 m sees at most 2 m2 on each metre.
    assert lengths.sum() < 0.9 * 0.8 * 40.0**2 / 2.0
    askew = np.abs(np.abs(steps[:, 0]) - np.abs(steps[:, 1])) < 0.1 * lengths
    assert lengths[askew].sum() > 0.6 * lengths.sum()
    # A corner leaves parts of a turned cell unseen: most of the path is parallel to one diagonal.
    along = np.sort(np.abs(steps @ turned(0.25 * np.pi, 2)).sum(axis=0))
    assert along[1] > 3.0 * along[0]


def test_a_wide_view_visits_few_places_and_then_those_between():
    team, planner = field(ExponentialDetection(0.98, [0.4, 0.4])), make_planner('tour')
    lattice = Lattice(team.exploration, *passing(team.robots['robot0'], 0.1, 17.0))
    chosen, gains = lattice.choose(team.exploration)
    assert 4 < len(chosen) < 0.5 * lattice.trust.size
    assert gains.sum() <= 1.0 and (np.diff(gains) < 1e-9).all()
    assert gains == pytest.approx(lattice.gains(team.exploration, chosen))
    for _ in range(60):
        fly(planner, team)
    assert team.exploration.explored_fraction() > 0.97


def test_others_keep_their_tours_until_a_cluster_appears():
    team, planner = field(starts=((1.0, 1.0, 0.0), (11.0, 11.0, 0.0))), make_planner('tour')
    planner.decide(team)
    ways = {name: list(way) for name, way in planner.routes.items()}
    other = team.robots['robot1']
    other.planning, other.remaining_path = False, np.array([[11.0, 9.0, 0.0]])
    fly(planner, team)
    assert planner.routes['robot1'] == ways['robot1']
    team.clusters = [Cluster(np.array([4.2, 6.3]), 0.01 * np.eye(2), 0.1, 0.9)]
    seen = [fly(planner, team) for _ in range(30)]
    assert min(np.linalg.norm(place[:2] - [4.2, 6.3]) for place in seen if place is not None) < 1e-6


def test_a_decision_has_the_places_that_follow_in_their_order():
    team, planner = field(starts=((1.0, 1.0, 3.0),)), make_planner('tour')
    first = planner.decide(team).robots['robot0']
    follow(team, 'robot0', first, 5)
    assert (first.tour[:, 2] == 3.0).all()
    places = [tuple(place) for place in first.tour.round(6)]
    # Straight runs are one leg, so that some are passed.
    following = [places.index(tuple(fly(planner, team).round(6))) for _ in range(6)]
    assert following == sorted(set(following)) and following[0] < 3 < following[-1]


def test_a_tour_ends_where_an_obstacle_hides_a_part():
    zone = {'centre': [6.0, 6.0], 'radius': 3.0}
    values = {'bounds': [[-99.0, 99.0]] * 2, 'obstacles': [zone]}
    around = Area(EnvironmentSettings.model_validate(values))
    team, planner = field(obstacles=around), make_planner('tour')
    legs = 0
    while planner.finished(team) is None:
        place = fly(planner, team)
        legs += 1
        assert legs < 200
        assert place is None or np.linalg.norm(place[:2] - 6.0) > 3.1 - 1e-9
    assert team.exploration.explored_fraction() < 0.95


@pytest.mark.parametrize('dimension', [2, 3])
def test_robots_keep_apart_in_random_teams(dimension):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        team = random_team(rng, dimension, planning=3, waiting=2, radius=0.02)
        planner = make_planner('tour')
        decision = planner.decide(team)
        check_decision(planner, team, decision)
        places = [(r.waypoint, team.robots[name].radius) for name, r in decision.robots.items()]
        moving = [not robot.stays for robot in decision.robots.values()]
        assert any(moving)
        for (one, a), (two, b) in itertools.compress(
            itertools.combinations(places, 2), map(any, itertools.combinations(moving, 2))
        ):
            assert np.linalg.norm(one - two) >= a + b


def test_a_team_without_targets_covers_the_floor_and_is_done():
    result = search(load_scenario('no_targets'), 1, planner='tour')
    assert result.end_reason == 'planner_done'
    assert result.steps * result.scenario.step < 150.0


@pytest.mark.parametrize(('size', 'name'), [(8.0, 'maasi'), (12.0, 'tour')])
def test_the_default_takes_tours_where_the_area_has_many_squares(size, name):
    team = field(size=size)
    team.robots['robot0'].candidates = np.array([[3.0, 3.0, 0.0], [5.0, 1.0, 0.0]])
    planner = make_planner('auto', team=team)
    decision = planner.decide(team)
    check_decision(planner, team, decision)
    assert planner.prefix == f'{name}: ' and planner.finished(team) is None
    same = make_planner(name).decide(team)
    np.testing.assert_array_equal(
        decision.robots['robot0'].waypoint, same.robots['robot0'].waypoint
    )


def test_places_that_the_battery_does_not_afford_are_passed_over_then_it_charges():
    team, planner = field(), make_planner('tour')
    view = team.robots['robot0']
    settings = EnduranceSettings(per_metre=0.01, reserve=0.2)
    view.endurance = Endurance(settings, view.motion, view.state.pose.position)
    view.endurance.update_charge(1.0)
    planner.decide(team)
    # Since it planned it has lost most of its battery: what is left is for places near it.
    view.endurance.update_charge(0.28)
    place = fly(planner, team)
    assert place is not None and np.linalg.norm(place[:2] - 1.0) < 4.0
    view.endurance.update_charge(0.21)
    chosen = planner.decide(team).robots['robot0']
    assert chosen.stays and chosen.unaffordable and SAVES_BATTERY in chosen.reason


@pytest.mark.parametrize('charge', [None, np.nan, 0.9])
def test_each_robot_has_its_own_path_home(charge):
    """A second robot without a battery, or of unknown or other charge, changes nothing of it."""
    team, planner = field(starts=((1.0, 1.0, 0.0), (11.0, 11.0, 0.0))), make_planner('tour')
    view, other = team.robots.values()
    settings = EnduranceSettings(per_metre=0.01, reserve=0.2)
    view.endurance = Endurance(settings, view.motion, view.state.pose.position)
    view.endurance.update_charge(0.5)
    if charge is not None:
        other.endurance = Endurance(settings, other.motion, other.state.pose.position)
        other.endurance.update_charge(charge)
    planner.plan(team)
    way = planner.routes['robot0']
    budget, home = view.endurance.range_from(view.state.pose.position)
    places = [view.state.pose.position[:2], *planner.points[way], home[:2]]
    length = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert len(way) > 4 and length <= budget + 1e-9 and length > 0.7 * budget
    # The other one takes what is left.
    assert sorted([*way, *planner.routes['robot1']]) == list(range(36))


def test_places_of_a_robot_that_is_done_go_to_the_others():
    team, planner = field(starts=((1.0, 1.0, 0.0), (11.0, 11.0, 0.0))), make_planner('tour')
    view = team.robots['robot0']
    view.endurance = Endurance(EnduranceSettings(), view.motion, view.state.pose.position)
    planner.decide(team)
    assert planner.routes['robot0']
    view.endurance.begin(Phase.DONE, NOTHING_AFFORDABLE)
    view.planning = False
    # Next to the robot that is done it may wait for a step.
    waits = 0
    while planner.finished(team) is None and waits < 5:
        waits += fly(planner, team, 'robot1') is None
    assert waits < 5 and 'robot0' not in planner.routes
    assert team.exploration.explored_fraction() > 0.97
