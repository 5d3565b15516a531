"""One robot of the distributed search: battery, others, failing solves, and its messages."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cuboid_instances import AREA, robots_at, two_buildings
from std_msgs.msg import Header

from maasi_filter.colours import ROBOTS
from maasi_filter.ros.conversions import colour_of
from maasi_planner.buildings.agent import Activity, Broadcast, SearchAgent, assigned, rewards
from maasi_planner.buildings.conversions import (
    agent_markers,
    broadcast_from_ros,
    broadcast_to_ros,
    decision_to_ros,
    mission_markers,
)
from maasi_planner.buildings.preplanning import plan_mission
from maasi_planner.buildings.settings import CuboidMethodSettings, HazardSettings

HOME = [166.0, 235.0, 5.0]


def make_agent(name='purple', home=HOME, obstacles=(), depth=1e-3, **hazard):
    options = two_buildings(obstacles=list(obstacles), visit_depth=depth)
    robot = robots_at({name: home}, **hazard)[name]
    return SearchAgent(name, options, plan_mission(options, AREA), robot)


NEVER = HazardSettings(failures=False)


def heard(hazard=NEVER, **others):
    message = Broadcast(
        robot='red',
        step=0,
        position=np.array([185.0, 235.0, 5.0]),
        velocity=np.zeros(3),
        searching=True,
        visited=np.zeros(32, dtype=bool),
        flight_steps=1,
        plan={},
        hazard=hazard,
        predicted=np.array([185.0, 235.0, 5.0]),
    )
    return replace(message, **others)


def random(seed=0):
    return np.random.default_rng(seed)


def test_hazard_is_equation_3():
    hazard = HazardSettings(alpha=30.0, beta=0.3)
    for steps in (0, 20, 35, 60):
        expected = 1 / (1 + 30 * math.exp(-0.3 * (steps - 30)))
        assert hazard.failure(steps) == pytest.approx(expected)
    assert HazardSettings(failures=False).failure(1000) == 0.0
    assert HazardSettings(alpha=1000.0, beta=100.0).failure(0) == pytest.approx(0.0)


def test_rewards_are_drawn_with_the_probabilities_of_11_to_14():
    hazard = HazardSettings(alpha=20.0, beta=0.3)
    others = [
        heard(hazard, plan={4: 3, 7: 5}, flight_steps=25),
        heard(hazard, plan={4: 6}, flight_steps=28),
    ]
    own = hazard.failure(3 + 10)

    def chance(*steps):
        fails = [hazard.failure(step) for step in steps]
        expected = sum(1 - p for p in fails)
        joins = 1 - 1 / (1 + 2.0 * math.exp(-0.5 * (expected - 2.0)))
        return max((1 - own) * math.prod(fails), joins)

    settings = CuboidMethodSettings()
    many = random().random((4000, 10))
    rates = np.mean([rewards(settings, hazard, 3, others, draws) for draws in many], axis=0)
    assert rates[4] == pytest.approx(chance(25 + 3 - 1, 28 + 6 - 1), abs=0.03)
    assert rates[7] == pytest.approx(chance(25 + 5 - 1), abs=0.03)
    assert (np.delete(rates, [4, 7]) == 1.0).all()
    # As printed, (13) does not hold while the battery is good: only (12) is left.
    printed = CuboidMethodSettings(condition='printed')
    rates = np.mean([rewards(printed, hazard, 3, others, draws) for draws in many], axis=0)
    for cuboid, steps in ((4, (27, 33)), (7, (29,))):
        fails = math.prod(hazard.failure(step) for step in steps)
        assert rates[cuboid] == pytest.approx((1 - own) * fails, abs=0.03)


def test_assignment_shares_the_nearest_cuboids():
    centres = np.array([[0.0, 0, 0], [10.0, 0, 0], [50.0, 0, 0]])
    near = np.array([[1.0, 0, 0], [2.0, 0, 0]])
    # The nearest to both is given to one of them, the sum being least.
    apart = np.array([[9.0, 0, 0], [1.0, 0, 0]])
    for places, left, expected in (
        (near, [0, 1, 2], [0, 1]),
        (apart, [0, 1, 2], [1, 0]),
        (apart, [0], [None, 0]),
        (apart, [], [None, None]),
    ):
        unvisited = np.array(left, dtype=int)
        assert [assigned(places, own, centres, unvisited) for own in (0, 1)] == expected


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


@pytest.mark.parametrize('depth', [0.0, 1e-3, 0.4])
def test_planned_visits_touch_a_face_or_are_as_deep_as_wanted(depth):
    agent = make_agent(depth=depth)
    agent.observe(0, HOME, np.zeros(3))
    plan = agent.decide([], random())
    boxes = agent.mission.boxes[[n for _, n in plan.visits]]
    places = plan.positions[[k for k, _ in plan.visits]]
    inside = np.minimum(places - boxes[:, :, 0], boxes[:, :, 1] - places)
    assert len(boxes) and inside.min() == pytest.approx(depth, abs=1e-6)


def test_nothing_left_to_do_holds_the_place():
    agent = make_agent()
    place, speed = np.array([100.0, 200.0, 40.0]), np.array([3.0, 0.0, 0.0])
    agent.visited[:] = True
    for step in range(30):
        agent.observe(step, place, speed)
        plan = agent.decide([], random(step))
        place, speed = plan.positions[1], plan.velocities[1]
    assert agent.done and np.abs(speed).max() < 0.2
    assert np.linalg.norm(place - [100.0, 200.0, 40.0]) < 25.0


def test_battery_fails_recharges_and_takes_up_its_work():
    agent = make_agent(alpha=5.0, beta=2.0, recharge_steps=[4, 4])
    place, speed = np.array(HOME), np.zeros(3)
    seen = []
    for step in range(60):
        message = agent.observe(step, place, speed)
        assert (message is None) == (agent.activity is Activity.RECHARGING)
        plan = agent.decide([], random(step))
        seen.append(agent.activity)
        place, speed = plan.positions[1], plan.velocities[1]
        if agent.activity is Activity.RETURNING:
            assert plan.visits == []
    assert seen[0] is Activity.SEARCHING and Activity.RETURNING in seen
    assert np.linalg.norm(place - HOME) < 100.0
    first = seen.index(Activity.RECHARGING)
    assert seen[first:].index(Activity.SEARCHING) == 3


def test_one_that_recharges_or_is_away_is_no_obstacle():
    alone, other = make_agent(), make_agent()
    away = heard(searching=False, plan=dict.fromkeys(range(32), 2))
    controls = []
    for agent, messages in ((alone, []), (other, [away])):
        agent.observe(0, HOME, np.zeros(3))
        controls.append(agent.decide(messages, random()).controls)
    assert (controls[0] == controls[1]).all()


def test_a_failed_solve_flies_the_plan_before_then_brakes(monkeypatch):
    agent = make_agent()
    agent.observe(0, HOME, np.zeros(3))
    first = agent.decide([], random())
    assert first.how == 'optimal'
    monkeypatch.setattr(agent.solver, 'solve', lambda problem: None)
    agent.observe(1, first.positions[1], first.velocities[1])
    second = agent.decide([], random(1))
    assert second.how == 'shifted'
    assert second.controls[:-1] == pytest.approx(first.controls[1:])
    assert second.visits == [(k - 1, n) for k, n in first.visits] != []
    # A gust: the plan before is not that of this place.
    agent.observe(2, second.positions[1] + np.array([20.0, 0.0, 0.0]), [8.0, 0.0, -2.0])
    third = agent.decide([], random(2))
    assert third.how == 'brake' and third.visits == []
    assert third.controls[0] == pytest.approx(
        agent.dynamics.control_for([8.0, 0.0, -2.0], np.zeros(3))
    )
    assert agent.failed == 2
    # A missed step forgets the plan.
    message = agent.observe(7, HOME, np.zeros(3))
    assert message is not None and message.plan == {}


CAGE = [
    *({'centre': [166, y], 'size': [40, 2, 80]} for y in (225, 245)),
    *({'centre': [x, 235], 'size': [2, 40, 80]} for x in (150, 182)),
]


@pytest.mark.parametrize(
    ('make', 'words'),
    [
        (lambda: make_agent(home=[300.0, 0.0, 0.0]), r'purple: start: read .*inside the area'),
        (lambda: make_agent(obstacles=CAGE), 'no cuboid can be reached'),
        (lambda: make_agent().observe(0, [np.nan, 0.0, 0.0], np.zeros(3)), r'purple: state: got'),
        (lambda: HazardSettings(recharge_steps=[5, 2]), 'recharge_steps: got'),
    ],
)
def test_bad_input(make, words):
    with pytest.raises(ValueError, match=words):
        make()


HEADER = Header(frame_id='map')


@pytest.fixture
def agent():
    """Return a robot that has visited one cuboid and planned."""
    made = make_agent('red', alpha=100.0)
    made.observe(0, made.mission.centres[3], np.zeros(3))
    made.decide([], random())
    return made


def test_a_broadcast_is_read_back(agent):
    sent = agent.observe(1, agent.mission.centres[3], [1.0, 2.0, -3.0])
    read = broadcast_from_ros(broadcast_to_ros(sent, HEADER), 32)
    assert len(read.plan) > 0 and read.visited.sum() == 1
    for name, value in vars(sent).items():
        assert np.all(getattr(read, name) == value), name


@pytest.mark.parametrize(
    ('field', 'value', 'words'),
    [
        ('visited', [True], 'visited: read 1 cuboids, allowed are 32'),
        ('planned', [40, 2], 'planned: read 40|planned_in'),
        ('planned_in', [1] * 31, 'planned_in: read 31'),
        ('alpha', float('nan'), 'finite'),
        ('beta', 0.0, 'above 0'),
    ],
)
def test_a_wrong_broadcast_is_refused(agent, field, value, words):
    message = broadcast_to_ros(agent.observe(1, agent.mission.centres[3], np.zeros(3)), HEADER)
    setattr(message, field, value)
    with pytest.raises(ValueError, match=words):
        broadcast_from_ros(message, 32)


def test_a_decision_has_its_snapshots_and_markers(agent):
    agent.observe(1, agent.mission.centres[4], np.zeros(3))
    plan = agent.decide([], random(1))
    message = decision_to_ros(agent, plan, agent.snapshots[1:], HEADER)
    assert (message.step, message.visited, message.how) == (1, 2, 'optimal')
    assert [shot.cuboid for shot in message.snapshots] == [4]
    assert message.snapshots[0].detection_probability == pytest.approx(0.88)
    assert list(zip(message.planned_in, message.planned)) == plan.visits
    markers = agent_markers(agent, plan, HEADER).markers
    keys = [(marker.ns, marker.id) for marker in markers]
    assert len(keys) == len(set(keys)) == 32 + 3
    visited = [m.color.r for m in markers if m.ns == 'red/cuboids' and m.id in (3, 4)]
    assert len(set(visited)) == 1
    assert visited[0] != markers[0].color.r
    assert len(mission_markers(agent.mission, Header()).markers) == 2
    # The colour is that which the robot has in its team.
    agent.name = 'walker'
    for team, number in (([], 0), (['climber', 'rover', 'walker'], 2)):
        markers = agent_markers(agent, plan, HEADER, team).markers
        (robot,) = (marker for marker in markers if marker.ns == 'walker/robot')
        assert robot.color == colour_of(ROBOTS[number])
