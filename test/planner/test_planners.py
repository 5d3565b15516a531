"""Every planner: against brute force on small cases, and in whole searches."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from planner_helpers import random_team

from maasi_filter.models.pose import Pose
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import (
    CandidateSet,
    CandidateSettings,
    Obstacles,
    PlannerSettings,
    RobotState,
    make_motion,
    make_planner,
)
from maasi_planner.planners.lawnmower import lanes
from maasi_planner.planners.mutual_information import intensity, mutual_information
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.search import search

NAMES = ('maasi', 'asi', 'maas', 'as', 'mutual_information', 'nearest_widest', 'lawnmower')


def test_unknown_planner_is_refused():
    with pytest.raises(ValueError, match='known are'):
        make_planner('best')


def test_aliases_are_the_same_planner():
    for one, other in (('maasi', 'asi'), ('maas', 'as')):
        assert type(make_planner(one)) is type(make_planner(other))


# Finishing


def test_finished_says_why():
    rng = np.random.default_rng(1)
    team = random_team(rng, dimension=2, planning=1, waiting=0, candidates=3)
    planner = make_planner('maasi')
    team.exploration.values[...] = 0.0
    team.clusters = []
    assert '100.0 %' in planner.finished(team)
    team.clusters = [Cluster(np.array([1.0, 1.0]), np.eye(2), 0.5, 0.5)]
    assert planner.finished(team) is None
    team.clusters = [Cluster(np.array([1.0, 1.0]), np.eye(2), 0.5, 0.01)]
    assert planner.finished(team) is not None
    team.exploration.values[...] = 0.5
    assert planner.finished(team) is None


def test_finished_when_no_candidate_can_show_more():
    rng = np.random.default_rng(2)
    team = random_team(rng, dimension=2, planning=1, waiting=0, candidates=3, kinds=('box',))
    name = team.planning()[0]
    team.clusters = []
    team.exploration.values[...] = 0.0
    # A corner that is out of reach of every candidate.
    team.exploration = UnexploredMap(team.bounds, 0.1)
    team.exploration.values[...] = 0.0
    team.exploration.values[-4:, -4:] = 1.0
    view = team.robots[name]
    view.state = RobotState.at_rest([0.3, 0.3, 0.0])
    view.candidates = np.array([[0.1, 0.1, 0.0], [0.5, 0.2, 0.0]])
    planner = make_planner('maasi')
    planner.decide(team)
    assert 'no candidate of any robot' in planner.finished(team)


# Active search


def brute_active_search(team, settings, seen=None):
    """Return the best joint value over all first waypoints and sequences (001, 002).

    T is the sum of pi at the cluster centres, or seen(robot, sequence).
    """
    names = team.planning()
    centres = [cluster.position for cluster in team.clusters]

    def sequences(name):
        view = team.robots[name]
        here = view.state.pose.position
        steps = view.candidates - here
        found = [[here + step] for step in steps]
        for _ in range(settings.horizon - 1):
            found = [[*past, past[-1] + step] for past in found for step in steps]
        bounds = team.bounds
        return [
            past
            for past in found
            if all(
                (place[:2] >= bounds[:, 0] - 1e-9).all()
                and (place[:2] <= bounds[:, 1] + 1e-9).all()
                for place in past
            )
        ]

    def refinement(name, past):
        detection = team.robots[name].sensor.detection
        return sum(
            float(detection.probability(np.array(centres), Pose.from_yaw(place, 0.0)).sum())
            for place in past
        )

    scored = [
        [
            (
                (seen or refinement)(name, past),
                [float(team.exploration.at(place)[0]) for place in past],
            )
            for past in sequences(name)
        ]
        for name in names
    ]
    return max(
        sum(part for part, _ in joint)
        + settings.alpha
        * sum(math.prod(explored[j] for _, explored in joint) for j in range(settings.horizon))
        for joint in itertools.product(*scored)
    )


def ring_team(rng, planning):
    team = random_team(
        rng, dimension=2, planning=planning, waiting=0, candidates=1, kinds=('exponential',)
    )
    for view in team.robots.values():
        place = np.append(rng.uniform(0.6, 1.4, 2), 0.0)
        view.state = RobotState.at_rest(place)
        settings = view.motion.settings.model_copy(
            update={'model': 'constant_speed', 'heading': 'keep'}
        )
        view.motion = make_motion(settings)
        ring = CandidateSet(CandidateSettings(ring=4, distance=0.25), team.bounds)
        view.candidates = ring.at(place)
    return team


@pytest.mark.parametrize(
    ('planning', 'horizon'),
    [(1, 1), (1, 2), (1, 3), (2, 1), (2, 2), (2, 3), (3, 1), (3, 2)],
)
def test_active_search_is_brute_force(planning, horizon):
    settings = PlannerSettings(name='maas', alpha=0.8, horizon=horizon)
    for seed in range(4):
        team = ring_team(np.random.default_rng(seed), planning)
        decision = make_planner('maas', settings).decide(team)
        assert decision.objective == pytest.approx(brute_active_search(team, settings), rel=1e-9)
        assert decision.exact
        for robot in decision.robots.values():
            assert robot.objective[robot.chosen] == pytest.approx(decision.objective, rel=1e-9)


@pytest.mark.parametrize(('planning', 'horizon'), [(1, 2), (1, 3), (2, 2)])
def test_active_search_by_mutual_information_is_brute_force(planning, horizon):
    """001, eq. (10) to (13): T of a sequence is what its empty measurements tell together."""
    settings = PlannerSettings(
        name='maas', alpha=0.1, horizon=horizon, refinement='mutual_information'
    )
    for seed in range(3):
        rng = np.random.default_rng(seed)
        team = ring_team(rng, planning)
        points, weights = intensity(team)
        assert len(points)

        def seen(name, past, team=team, points=points, weights=weights):
            detection = team.robots[name].sensor.detection
            missed = np.ones(len(points))
            for place in past:
                missed *= 1.0 - detection.probability(points, Pose.from_yaw(place, 0.0))
            return mutual_information(missed, weights)

        decision = make_planner('maas', settings).decide(team)
        expected = brute_active_search(team, settings, seen)
        assert decision.objective == pytest.approx(expected, rel=1e-9)
        assert decision.exact


def test_active_search_in_turn_is_close_to_the_optimum():
    """Where sequences are too many to compare jointly, robots choose in turn."""
    for seed in range(6):
        team = ring_team(np.random.default_rng(seed), 3)
        exact = make_planner('maas', PlannerSettings(name='maas', alpha=0.8, horizon=2)).decide(
            team
        )
        settings = PlannerSettings(name='maas', alpha=0.8, horizon=2, enumeration_limit=10)
        decision = make_planner('maas', settings).decide(team)
        assert not decision.exact
        assert exact.objective >= decision.objective >= 0.98 * exact.objective


# Mutual information


def entropy(p):
    return 0.0 if p <= 0.0 or p >= 1.0 else -p * math.log(p) - (1 - p) * math.log(1 - p)


def test_mutual_information_of_few_places():
    """Against the sum over all numbers of targets at each place."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        weights = rng.uniform(0.05, 0.8, 3)
        missed = rng.uniform(0.02, 0.99, 3)
        mean, conditional = 0.0, 0.0
        for counts in itertools.product(range(18), repeat=3):
            chance, left = 1.0, 1.0
            for count, weight, miss in zip(counts, weights, missed):
                chance *= math.exp(-weight) * weight**count / math.factorial(count)
                left *= miss**count
            mean += chance * left
            conditional += chance * entropy(left)
        expected = entropy(mean) - conditional
        assert mutual_information(missed, weights) == pytest.approx(expected, abs=2e-5, rel=1e-3)


def test_mutual_information_extremes():
    assert mutual_information(np.ones(3), np.full(3, 0.5)) == 0.0
    assert mutual_information(np.zeros(0), np.zeros(0)) == 0.0
    # A certain view of one place with mass m: the event says all about "is there any".
    value = mutual_information(np.zeros(1), np.full(1, 0.7))
    assert value == pytest.approx(entropy(math.exp(-0.7)), rel=1e-9)


def test_mutual_information_chooses_the_most_informative_pair():
    rng = np.random.default_rng(4)
    team = random_team(rng, dimension=2, planning=2, waiting=0, candidates=4)
    points, weights = intensity(team)
    assert len(points)
    decision = make_planner('mutual_information').decide(team)
    names = team.planning()
    missed = {}
    for name in names:
        view = team.robots[name]
        here = view.state.pose.position
        turns = view.motion.settings.model == 'unicycle' or (
            view.motion.settings.heading == 'travel'
        )
        rows = []
        for place in view.candidates:
            yaw = view.state.pose.yaw
            if turns:
                yaw = math.atan2(place[1] - here[1], place[0] - here[0])
            pose = Pose.from_yaw(place, yaw)
            rows.append(1.0 - view.sensor.detection.probability(points, pose))
        missed[name] = rows
    best = max(
        mutual_information(one * two, weights)
        for one in missed[names[0]]
        for two in missed[names[1]]
    )
    assert decision.objective == pytest.approx(best, rel=1e-9)


def test_without_information_robots_go_straight_on():
    team = ring_team(np.random.default_rng(3), 1)
    team.clusters = []
    name = team.planning()[0]
    planner = make_planner('mutual_information')
    first = planner.decide(team).robots[name]
    way = first.waypoint - team.robots[name].state.pose.position
    team.robots[name].state = RobotState.at_rest(first.waypoint)
    team.robots[name].candidates = team.robots[name].candidates + way
    second = planner.decide(team).robots[name]
    assert second.waypoint - first.waypoint == pytest.approx(way, abs=1e-9)
    assert 'straight on' in second.reason


# Nearest, widest


def test_nearest_then_widest():
    team = ring_team(np.random.default_rng(3), 1)
    name = team.planning()[0]
    team.robots[name].state = RobotState.at_rest([0.2, 0.2, 0.0])
    near, wide = np.array([0.5, 0.4]), np.array([1.7, 1.6])
    team.clusters = [
        Cluster(wide, 0.1 * np.eye(2), 0.4, 0.9),
        Cluster(near, 0.01 * np.eye(2), 0.1, 0.9),
    ]
    planner = make_planner('nearest_widest')
    waypoints = [planner.decide(team).robots[name].waypoint[:2] for _ in range(4)]
    assert np.allclose(waypoints, [near, wide, near, wide])


def test_nearest_widest_explores_without_clusters():
    team = ring_team(np.random.default_rng(3), 1)
    name = team.planning()[0]
    team.clusters = []
    decision = make_planner('nearest_widest').decide(team).robots[name]
    explored = team.exploration.at(team.robots[name].candidates)
    assert decision.chosen == int(np.argmax(explored))
    assert 'no cluster' in decision.reason


# Lawnmower


@pytest.mark.parametrize('bounds', [[[-0.3, 2.4]] * 2, [[0.0, 260.0]] * 3])
def test_lanes_cover_everything_within_half_a_spacing(bounds):
    bounds = np.array(bounds)
    spacing = float((bounds[:, 1] - bounds[:, 0]).max()) / 6.5
    found = lanes(bounds, spacing, spacing, 0.5 * spacing)
    rng = np.random.default_rng(0)
    d = len(bounds)
    for _ in range(200):
        place = rng.uniform(bounds[:, 0], bounds[:, 1])
        gaps = []
        for start, end in found:
            across = np.abs(place[1:] - start[1:d])
            along = max(0.0, min(start[0], end[0]) - place[0], place[0] - max(start[0], end[0]))
            gaps.append(max(along, across.max()))
        assert min(gaps) <= 0.5 * spacing + 1e-9
    for (_, before), (after, _) in itertools.pairwise(found):
        assert (np.abs(after - before) > 1e-9).sum() == 1


def test_lawnmowers_cover_the_floor_and_meet_in_the_middle():
    result = search(load_scenario('no_targets'), 1, planner='lawnmower')
    assert result.end_reason == 'planner_done'
    rows = {
        name: [
            robot.waypoint[1]
            for decision in result.decisions
            for own, robot in decision.robots.items()
            if own == name and not robot.stays
        ]
        for name in ('mambo', 'turtlebot')
    }
    assert rows['mambo'][0] > 1.8
    assert rows['turtlebot'][0] < 0.3
    assert min(rows['mambo']) > max(rows['turtlebot']) - 1e-6
    # Lanes are no further apart than the turtlebot sees.
    assert np.diff(sorted({*rows['mambo'], *rows['turtlebot']})).max() < 0.31


# Waypoints of several robots


@pytest.mark.parametrize('name', ['maasi', 'maas', 'mutual_information', 'nearest_widest'])
def test_robots_are_not_sent_to_one_place(name):
    rng = np.random.default_rng(0)
    team = random_team(rng, dimension=2, planning=2, waiting=0, candidates=3, radius=0.1)
    shared = np.array([[0.5, 0.5, 0.0], [1.0, 0.5, 0.0], [0.5, 1.4, 0.0]])
    team.clusters = [Cluster(np.array([1.0, 0.5]), 0.01 * np.eye(2), 0.1, 0.9)]
    for view in team.robots.values():
        view.candidates = shared.copy()
    decision = make_planner(name).decide(team)
    one, two = (robot.waypoint for robot in decision.robots.values())
    assert np.linalg.norm(one - two) >= 0.4 - 1e-9


@pytest.mark.parametrize('name', ['maasi', 'maas', 'mutual_information', 'nearest_widest'])
def test_idle_robots_and_goals_of_others_count(name):
    rng = np.random.default_rng(0)
    team = random_team(rng, dimension=2, planning=1, waiting=2, candidates=3, radius=0.1)
    planning = team.planning()[0]
    first, second = (n for n in team.names() if n != planning)
    team.robots[first].remaining_path = None
    team.robots[first].remaining_yaws = None
    team.robots[first].state = RobotState.at_rest([0.5, 0.5, 0.0])
    team.robots[second].remaining_path = np.array([[1.9, 1.9, 0.0], [1.5, 1.5, 0.0]])
    team.robots[second].remaining_yaws = None
    team.clusters = []
    team.robots[planning].state = RobotState.at_rest([0.1, 1.9, 0.0])
    team.robots[planning].candidates = np.array(
        [[0.55, 0.5, 0.0], [1.5, 1.45, 0.0], [0.4, 1.5, 0.0]]
    )
    decision = make_planner(name).decide(team)
    assert decision.robots[planning].waypoint == pytest.approx([0.4, 1.5, 0.0])


# Bad input


def one_robot(seed=0):
    team = random_team(
        np.random.default_rng(seed), dimension=2, planning=1, waiting=0, candidates=3
    )
    return team, team.planning()[0]


@pytest.mark.parametrize('name', NAMES[:-1])
def test_no_candidates_means_stay(name):
    team, robot = one_robot()
    team.clusters = []
    team.robots[robot].candidates = np.zeros((0, 3))
    decision = make_planner(name).decide(team).robots[robot]
    assert decision.stays
    assert 'no candidates' in decision.reason
    assert decision.waypoint == pytest.approx(team.robots[robot].state.pose.position)


@pytest.mark.parametrize('name', NAMES[:-1])
def test_all_candidates_in_obstacles_means_stay(name):
    team, robot = one_robot()
    team.clusters = []
    view = team.robots[robot]
    centre = np.array([[1.0, 1.0, 0.0]])
    obstacles = Obstacles(centre, np.array([0.5]), np.array([False]))
    view.motion = make_motion(view.motion.settings, obstacles, 0.1)
    # At the edge already: there is no way further towards the candidates.
    view.state = RobotState.at_rest([0.397, 1.0, 0.0])
    view.candidates = np.array([[1.0, 1.0, 0.0], [1.1, 1.0, 0.0]])
    decision = make_planner(name).decide(team).robots[robot]
    assert decision.stays
    assert 'obstacles' in decision.reason


@pytest.mark.parametrize('name', NAMES[:-1])
def test_waypoints_outside_are_never_chosen(name):
    team, robot = one_robot()
    team.clusters = []
    team.robots[robot].candidates = np.array([[3.0, 1.0, 0.0], [np.nan, 0.0, 0.0], [1.0, 1.2, 0.0]])
    decision = make_planner(name).decide(team).robots[robot]
    assert decision.waypoint == pytest.approx([1.0, 1.2, 0.0])
    team.robots[robot].candidates = np.array([[3.0, 1.0, 0.0]])
    decision = make_planner(name).decide(team).robots[robot]
    assert decision.stays
    assert 'outside the bounds' in decision.reason


def test_only_candidate_is_where_the_robot_is():
    team, robot = one_robot()
    team.clusters = []
    team.robots[robot].candidates = np.array([team.robots[robot].state.pose.position])
    decision = make_planner('maasi').decide(team).robots[robot]
    assert decision.stays
    assert 'already' in decision.reason


def test_candidate_at_the_present_place_is_not_chosen():
    team, robot = one_robot()
    here = np.array(team.robots[robot].state.pose.position)
    team.robots[robot].candidates = np.vstack([here, team.robots[robot].candidates])
    for kind in ('paper', 'information'):
        settings = PlannerSettings(objective=kind, cluster_candidates=False)
        decision = make_planner('maasi', settings).decide(team).robots[robot]
        assert decision.chosen != 0
        assert decision.lengths[0] == 0
        assert decision.objective[0] == -np.inf


def test_wrong_team_is_refused():
    team, robot = one_robot()
    for change in (
        {'period_steps': 0},
        {'radius': math.nan},
        {'remaining_path': np.array([[0.0, 0.0]])},
        {'candidates': np.zeros((3, 2))},
    ):
        with pytest.raises(ValueError, match=next(iter(change))):
            dataclasses.replace(team.robots[robot], **change)
    with pytest.raises(ValueError, match='step_time'):
        dataclasses.replace(team, step_time=0.0)


def test_nobody_plans():
    team = random_team(np.random.default_rng(0), planning=0, waiting=2)
    for name in NAMES:
        assert make_planner(name).decide(team).robots == {}
