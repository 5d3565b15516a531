"""Every planner: against brute force on small cases, and in whole searches."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from planner_helpers import random_team

from maasi_filter.geometry.area import Area
from maasi_filter.geometry.environment import EnvironmentSettings
from maasi_filter.models.pose import Pose
from maasi_filter.records import Cluster
from maasi_filter.unexplored_map import UnexploredMap
from maasi_planner import (
    CandidateSet,
    CandidateSettings,
    RobotState,
    make_motion,
    make_planner,
    planner_settings,
)
from maasi_planner.endurance import Endurance, EnduranceSettings
from maasi_planner.planners.home_path import go_home
from maasi_planner.planners.lawnmower import lanes
from maasi_planner.planners.mutual_information import intensity, mutual_information
from maasi_planner.planners.separation import keep_apart
from maasi_planner.team import TAKEN, Decision, single_choice, stay
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.search import search

NAMES = ('maasi', 'maas', 'mutual_information', 'nearest_widest')


def one_robot(seed=0, **options):
    """Return a team of one robot with three candidates and no clusters, and its view."""
    options = {'dimension': 2, 'planning': 1, 'waiting': 0, 'candidates': 3} | options
    team = random_team(np.random.default_rng(seed), **options)
    team.clusters = []
    return team, team.robots[team.planning()[0]]


def decide(name, team):
    decision = make_planner(name).decide(team)
    return decision.robots[team.planning()[0]]


def at(x, y):
    return RobotState.at_rest([x, y, 0.0])


def cluster(place, radius=0.1, mass=0.9):
    return Cluster(np.array(place), radius**2 * np.eye(2), radius, mass)


def test_finished_says_why():
    team, view = one_robot(1, kinds=('box',))
    planner = make_planner('maasi')
    for unseen, clusters, reason in (
        (0.0, [], '100.0 %'),
        (0.0, [cluster([1.0, 1.0], mass=0.5)], None),
        (0.0, [cluster([1.0, 1.0], mass=0.01)], '100.0 %'),
        (0.5, [], None),
    ):
        team.exploration.values[...] = unseen
        team.clusters = clusters
        found = planner.finished(team)
        assert (found is None) == (reason is None) and (reason or '') in (found or '')
    # A corner that is out of reach of every candidate.
    team.exploration = UnexploredMap(team.bounds, 0.1)
    team.exploration.values[...] = 0.0
    team.exploration.values[-4:, -4:] = 1.0
    view.state = at(0.3, 0.3)
    view.candidates = np.array([[0.1, 0.1, 0.0], [0.5, 0.2, 0.0]])
    planner.decide(team)
    assert 'candidate' in planner.finished(team)


# ---- active search ------------------------------------------------------------------------------


def brute_active_search(team, settings, seen):
    """Return the best joint value over all sequences (001, 002), T of each is seen(robot, it)."""
    low, high = team.bounds[:, 0] - 1e-9, team.bounds[:, 1] + 1e-9

    def scored(name):
        view = team.robots[name]
        here = view.state.pose.position
        for steps in itertools.product(view.candidates - here, repeat=settings.horizon):
            way = here + np.cumsum(steps, axis=0)
            if ((way[:, :2] >= low) & (way[:, :2] <= high)).all():
                yield seen(name, way), [float(team.exploration.at(place)[0]) for place in way]

    return max(
        sum(part for part, _ in joint)
        + settings.alpha * sum(map(math.prod, zip(*(explored for _, explored in joint))))
        for joint in itertools.product(*(list(scored(name)) for name in team.planning()))
    )


def ring_team(seed, planning):
    rng = np.random.default_rng(seed)
    team = random_team(
        rng, dimension=2, planning=planning, waiting=0, candidates=1, kinds=('exponential',)
    )
    for view in team.robots.values():
        view.state = at(*rng.uniform(0.6, 1.4, 2))
        change = {'model': 'constant_speed', 'heading': 'keep'}
        view.motion = make_motion(view.motion.settings.model_copy(update=change))
        ring = CandidateSet(CandidateSettings(ring=4, distance=0.25), team.bounds)
        view.candidates = ring.at(view.state.pose.position)
    return team


def detected(team, name, way, points):
    """Return pi of points from each place of a way, (n, m)."""
    detection = team.robots[name].sensor.detection
    return np.array([detection.probability(points, Pose.from_yaw(place, 0.0)) for place in way])


@pytest.mark.parametrize(
    ('planning', 'horizon', 'kind'),
    [
        *((1, horizon, 'centres') for horizon in (1, 2, 3)),
        *((2, horizon, 'centres') for horizon in (1, 2, 3)),
        *((3, horizon, 'centres') for horizon in (1, 2)),
        *((1, horizon, 'mutual_information') for horizon in (2, 3)),
        (2, 2, 'mutual_information'),
    ],
)
def test_active_search_is_brute_force(planning, horizon, kind):
    """001, eq. (10) to (13) of mutual information: what empty measurements tell together."""
    alpha = 0.8 if kind == 'centres' else 0.1
    settings = planner_settings(name='maas', alpha=alpha, horizon=horizon, refinement=kind)
    for seed in range(3):
        team = ring_team(seed, planning)
        points, weights = intensity(team)
        centres = np.array([item.position for item in team.clusters])

        def seen(name, way, team=team, points=points, weights=weights, centres=centres):
            if kind == 'mutual_information':
                missed = (1.0 - detected(team, name, way, points)).prod(axis=0)
                return mutual_information(missed, weights)
            return float(detected(team, name, way, centres).sum())

        decision = make_planner('maas', settings).decide(team)
        expected = brute_active_search(team, settings, seen)
        assert decision.objective == pytest.approx(expected, rel=1e-9)
        assert decision.exact
        for robot in decision.robots.values():
            assert robot.objective[robot.chosen] == pytest.approx(decision.objective, rel=1e-9)


def test_active_search_in_turn_is_close_to_the_optimum():
    """Where sequences are too many to compare jointly, robots choose in turn."""
    for seed in range(6):
        team = ring_team(seed, 3)
        settings = planner_settings(name='maas', alpha=0.8, horizon=2)
        exact = make_planner('maas', settings).decide(team)
        few = settings.model_copy(update={'enumeration_limit': 10})
        decision = make_planner('maas', few).decide(team)
        assert not decision.exact
        assert exact.objective >= decision.objective >= 0.98 * exact.objective


# ---- mutual information -------------------------------------------------------------------------


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
    assert mutual_information(np.ones(3), np.full(3, 0.5)) == 0.0
    assert mutual_information(np.zeros(0), np.zeros(0)) == 0.0
    # A certain view of one place with mass m: the event says all about "is there any".
    value = mutual_information(np.zeros(1), np.full(1, 0.7))
    assert value == pytest.approx(entropy(math.exp(-0.7)), rel=1e-9)


def test_mutual_information_chooses_the_most_informative_pair():
    team = random_team(np.random.default_rng(4), dimension=2, planning=2, waiting=0, candidates=4)
    points, weights = intensity(team)
    assert len(points)
    decision = make_planner('mutual_information').decide(team)
    missed = []
    for view in (team.robots[name] for name in team.planning()):
        settings = view.motion.settings
        turns = settings.model == 'unicycle' or settings.heading == 'travel'
        ways = view.candidates - view.state.pose.position
        yaws = np.arctan2(ways[:, 1], ways[:, 0]) if turns else [view.state.pose.yaw] * 4
        poses = [Pose.from_yaw(place, yaw) for place, yaw in zip(view.candidates, yaws)]
        missed.append([1.0 - view.sensor.detection.probability(points, pose) for pose in poses])
    best = max(mutual_information(a * b, weights) for a, b in itertools.product(*missed))
    assert decision.objective == pytest.approx(best, rel=1e-9)


def test_without_information_robots_go_straight_on():
    team = ring_team(3, 1)
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


# ---- nearest, widest and the lawnmower ----------------------------------------------------------


def test_nearest_then_widest():
    team, view = one_robot()
    view.state = at(0.2, 0.2)
    near, wide = np.array([0.5, 0.4]), np.array([1.7, 1.6])
    team.clusters = [cluster(wide, 0.4), cluster(near)]
    planner = make_planner('nearest_widest')
    robots = [next(iter(planner.decide(team).robots.values())) for _ in range(4)]
    assert np.allclose([robot.waypoint[:2] for robot in robots], [near, wide, near, wide])
    team.clusters = []
    robot = next(iter(planner.decide(team).robots.values()))
    assert robot.chosen == int(np.argmax(team.exploration.at(view.candidates)))
    assert 'no cluster' in robot.reason


@pytest.mark.parametrize('bounds', [[[-0.3, 2.4]] * 2, [[0.0, 260.0]] * 3])
def test_lanes_cover_everything_within_half_a_spacing(bounds):
    bounds = np.array(bounds)
    spacing = float((bounds[:, 1] - bounds[:, 0]).max()) / 6.5
    found = lanes(bounds, spacing, spacing, 0.5 * spacing)
    for place in np.random.default_rng(0).uniform(bounds[:, 0], bounds[:, 1], (200, len(bounds))):
        gaps = []
        for start, end in found:
            across = np.abs(place[1:] - start[1 : len(bounds)])
            along = max(0.0, min(start[0], end[0]) - place[0], place[0] - max(start[0], end[0]))
            gaps.append(max(along, across.max()))
        assert min(gaps) <= 0.5 * spacing + 1e-9
    for (_, before), (after, _) in itertools.pairwise(found):
        assert (np.abs(after - before) > 1e-9).sum() == 1


def test_lawnmowers_cover_the_floor_and_meet_in_the_middle():
    result = search(load_scenario('no_targets'), 1, planner='lawnmower')
    assert result.end_reason == 'planner_done'
    rows = {'mambo': [], 'turtlebot': []}
    for decision in result.decisions:
        for name, robot in decision.robots.items():
            if not robot.stays:
                rows[name].append(robot.waypoint[1])
    assert rows['mambo'][0] > 1.8
    assert rows['turtlebot'][0] < 0.3
    assert min(rows['mambo']) > max(rows['turtlebot']) - 1e-6
    # Lanes are no further apart than the turtlebot sees.
    assert np.diff(sorted({*rows['mambo'], *rows['turtlebot']})).max() < 0.31


# ---- what every planner keeps to ----------------------------------------------------------------


@pytest.mark.parametrize('name', NAMES)
def test_robots_are_not_sent_to_one_place(name):
    team, _ = one_robot(planning=2, radius=0.1)
    team.clusters = [cluster([1.0, 0.5])]
    for view in team.robots.values():
        view.candidates = np.array([[0.7, 0.5, 0.0], [1.0, 0.5, 0.0], [0.5, 1.4, 0.0]])
    decision = make_planner(name).decide(team)
    one, two = (robot.waypoint for robot in decision.robots.values())
    assert np.linalg.norm(one - two) >= 0.4 - 1e-9


@pytest.mark.parametrize('name', NAMES)
def test_idle_robots_and_goals_of_others_count(name):
    team, view = one_robot(waiting=2, radius=0.1)
    first, second = (item for item in team.robots.values() if item is not view)
    first.remaining_path = first.remaining_yaws = second.remaining_yaws = None
    first.state = at(0.5, 0.5)
    second.remaining_path = np.array([[1.9, 1.9, 0.0], [1.5, 1.5, 0.0]])
    view.state = at(0.1, 1.9)
    view.candidates = np.array([[0.55, 0.5, 0.0], [1.5, 1.45, 0.0], [0.4, 1.5, 0.0]])
    assert decide(name, team).waypoint == pytest.approx([0.4, 1.5, 0.0])


@pytest.mark.parametrize('name', NAMES)
@pytest.mark.parametrize(
    ('start', 'candidates', 'chosen', 'reason'),
    [
        ((0.2, 1.2), [], None, 'no candidates'),
        ((0.2, 1.2), [[3.0, 1.0, 0.0]], None, 'outside the area'),
        ((0.2, 1.2), [[0.2, 1.2, 0.0]], None, 'already'),
        # At the edge of the obstacle.
        ((0.997, 1.0), [[1.6, 1.0, 0.0], [1.7, 1.0, 0.0]], None, 'in obstacles'),
        # Outside: the way from the obstacle towards the robot ends there, too.
        ((2.6, 1.0), [[1.7, 1.0, 0.0]], None, 'no candidate is usable'),
        ((0.2, 1.2), [[3.0, 1.0, 0.0], [np.nan, 0.0, 0.0], [0.3, 1.4, 0.0]], [0.3, 1.4, 0.0], ''),
    ],
)
def test_robots_without_a_usable_candidate_stay(name, start, candidates, chosen, reason):
    team, view = one_robot()
    zone = {'centre': [1.6, 1.0], 'radius': 0.5}
    place = {'bounds': [[0.0, 9.0]] * 2, 'obstacles': [zone]}
    area = Area(EnvironmentSettings.model_validate(place))
    view.motion = make_motion(view.motion.settings, area, 0.1)
    view.state = at(*start)
    view.candidates = np.array(candidates).reshape(-1, 3)
    robot = decide(name, team)
    assert robot.stays == (chosen is None) and reason in robot.reason
    assert robot.waypoint == pytest.approx(chosen or [*start, 0.0])


@pytest.mark.parametrize('name', ['maasi', 'nearest_widest', 'lawnmower'])
def test_robots_keep_apart_on_their_ways(name):
    """In 200 random teams: at no step nearer than their radii, or than they are now."""
    waits = moves = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        team = random_team(rng, planning=3, waiting=2, candidates=8, radius=0.04)
        for view in team.robots.values():
            if view.remaining_path is not None:
                view.state = RobotState.at_rest(view.remaining_path[0])
        decision = make_planner(name).decide(team)
        keep_apart(team, decision, {})
        ways = {key: robot.positions for key, robot in decision.robots.items()}
        moving = {key for key, robot in decision.robots.items() if not robot.stays}
        for key, view in team.robots.items():
            if not view.planning:
                standing = view.state.pose.position[None, :]
                ways[key] = standing if view.remaining_path is None else view.remaining_path
        for one, other in itertools.combinations(ways, 2):
            # Who stands, or is on its way, cannot make room now.
            if not moving & {one, other}:
                continue
            steps = np.arange(max(len(ways[one]), len(ways[other])))
            first, second = (
                way[np.minimum(steps, len(way) - 1)] for way in (ways[one], ways[other])
            )
            gaps = np.linalg.norm(first - second, axis=1)
            least = min(team.robots[one].radius + team.robots[other].radius, gaps[0])
            assert gaps.min() >= least - 1e-9, (seed, one, other)
        waits += sum('waits' in robot.reason for robot in decision.robots.values())
        moves += sum(not robot.stays for robot in decision.robots.values())
    assert moves > 400 and waits > 0


def test_a_robot_waits_for_one_that_is_still_on_its_present_way():
    team, view = one_robot(waiting=1, radius=0.1)
    [name] = team.planning()
    [other] = [key for key in team.robots if key != name]
    team.robots[other].planning = True
    view.state, team.robots[other].state = at(0.2, 1.0), at(1.0, 0.2)
    prediction = view.motion.predict(view.state, np.array([[1.8, 1.0, 0.0]]), team.step_time)
    goes = single_choice(np.array([[1.8, 1.0, 0.0]]), prediction, 0, 'goes')
    for rest, waits in ((np.tile([1.0, 0.2, 0.0], (9, 1)), False), (goes.positions[::-1], True)):
        decision = Decision(0, robots={name: goes, other: stay(team.robots[other], 'stays')})
        keep_apart(team, decision, {other: rest})
        assert decision.robots[name].stays == waits


def test_the_way_home_is_to_another_charger_where_the_nearest_is_taken_if_the_battery_allows():
    team, view = one_robot(waiting=1, radius=0.1)
    [name] = team.planning()
    [other] = [robot for key, robot in team.robots.items() if key != name]
    settings = EnduranceSettings(per_metre=0.1, chargers=[[2.0, 1.0, 0.0], [0.2, 4.0, 0.0]])
    view.endurance = Endurance(settings, view.motion, np.zeros(3))
    view.state, other.state, other.remaining_path = at(0.2, 1.0), at(2.0, 1.0), None
    for charge, reached in ((0.34, True), (0.28, False)):
        view.endurance.update_charge(charge)
        decision = Decision(0, robots={name: stay(view, 'stays')})
        chosen = decision.robots[name] = go_home(team, name, decision, 'goes home')
        assert (chosen.waypoint.tolist() == settings.chargers[1]) == reached
        keep_apart(team, decision, {})
        assert not decision.robots[name].stays
        # Else it waits near the one that is taken.
        near = np.linalg.norm(chosen.waypoint - settings.chargers[0])
        assert reached or (0.4 < near < 1.6 and chosen.reason.endswith(TAKEN))


def test_the_way_home_leads_past_a_robot_that_stands_on_it():
    team, view = one_robot(waiting=1, radius=0.1)
    [name] = team.planning()
    [other] = [robot for key, robot in team.robots.items() if key != name]
    view.motion = make_motion(view.motion.settings, Area([[0.0, 9.0]] * 2), view.radius)
    view.endurance = Endurance(EnduranceSettings(), view.motion, [2.0, 1.0, 0.0])
    other.remaining_path = None

    def step_home():
        decision = Decision(0, robots={name: stay(view, 'stays')})
        decision.robots[name] = go_home(team, name, decision, 'goes home')
        keep_apart(team, decision, {})
        return decision.robots[name]

    view.state, other.state = at(0.2, 1.0), at(1.0, 1.0)
    length, legs = 0.0, 0
    while not view.endurance.is_home(view.state.pose.position):
        chosen, legs = step_home(), legs + 1
        assert not chosen.stays and legs < 6
        gaps = np.linalg.norm(chosen.positions - other.state.pose.position, axis=1)
        assert gaps.min() >= view.radius + other.radius - 1e-9
        length += np.linalg.norm(np.diff(chosen.positions, axis=0), axis=1).sum()
        view.state = RobotState.at_rest(chosen.positions[-1])
    assert legs > 1 and length < 1.3 * 1.8
    # It steps aside for one that comes towards it, and turns off.
    corners = np.array([[1.2, 1.0, 0.0], [0.7, 1.0, 0.0], [0.7, 1.9, 0.0]])
    legs = [np.linspace(*pair, 40) for pair in itertools.pairwise(corners)]
    view.state, other.state, other.remaining_path = at(0.2, 1.0), at(1.2, 1.0), np.vstack(legs)
    chosen = step_home()
    steps = np.arange(max(len(chosen.positions), 80))
    first = chosen.positions[np.minimum(steps, len(chosen.positions) - 1)]
    gaps = np.linalg.norm(first - other.remaining_path[np.minimum(steps, 79)], axis=1)
    assert not chosen.stays and gaps.min() >= view.radius + other.radius - 1e-9
    other.remaining_path = None
    # It waits near the charger until that is free.
    view.state, other.state = at(0.2, 1.0), at(2.0, 1.0)
    view.state = RobotState.at_rest(step_home().positions[-1])
    chosen = step_home()
    assert chosen.stays and chosen.reason == f'waits: {TAKEN}'


def test_wrong_team_is_refused():
    team, view = one_robot()
    for change in (
        {'period_steps': 0},
        {'radius': math.nan},
        {'remaining_path': np.array([[0.0, 0.0]])},
        {'candidates': np.zeros((3, 2))},
    ):
        with pytest.raises(ValueError, match=next(iter(change))):
            dataclasses.replace(view, **change)
    with pytest.raises(ValueError, match='step_time'):
        dataclasses.replace(team, step_time=0.0)
