"""Home in time: no robot's battery is empty before it is home, whatever the planner."""

import copy
import itertools
import math

import numpy as np
import pytest
from small_field import SMALL_FIELD

from maasi_filter.geometry.area import Area
from maasi_planner import MotionSettings, RobotState, make_motion
from maasi_planner.endurance import Endurance, EnduranceSettings, Phase
from maasi_planner.planners import Planner
from maasi_planner.team import Decision, single_choice
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.search import search
from maasi_sim.simulation.robots import Simulation

IDLE, MOTION = 100.0, 20.0  # W, and W for each m/s


class Careless(Planner):
    """Sends each robot to one of its candidates at random, and asks for no battery."""

    def decide(self, team):
        """See `Planner.decide`."""
        decision, rng = Decision(team.step), np.random.default_rng(team.step)
        for name in team.planning():
            view = team.robots[name]
            point = rng.choice(view.candidates)[None]
            way = view.motion.predict(view.state, point, team.step_time)
            decision.robots[name] = single_choice(point, way, 0, 'anywhere')
        return decision


AREAS = {
    'bounds': {'bounds': [[0.0, 200.0], [0.0, 200.0]]},
    # A corridor between two fields, and a hole.
    'corridor': {
        'area': (
            'POLYGON ((0 0, 90 0, 90 90, 110 90, 110 0, 200 0, 200 200, 110 200, 110 100, 90 100, '
            '90 200, 0 200, 0 0), (140 90, 170 90, 170 120, 140 120, 140 90))'
        )
    },
}


def scenario(rng, weak, area='bounds'):
    """Return a search with two drones, whose batteries may hold a fifth less than they say."""
    capacity = float(rng.uniform(12e3, 25e3))
    drone = {
        'type': 'ranging_drone',
        'candidates': {'grid': [8, 8], 'spacing': 25.0, 'corner': [12.5, 12.5]},
        'motion': {'clearance': 0.5, 'tolerance': 0.5},
        'sensor': {'detection': {'kind': 'box', 'lower': [-15.0] * 3, 'upper': [15.0] * 3}},
        'odometry': {'position_noise': 0.0, 'heading_noise': 0.0, 'velocity_noise': 0.0},
        'endurance': {'per_second': IDLE / capacity, 'per_metre': MOTION / capacity},
        'battery': {
            'capacity': (0.8 if weak else 1.0) * capacity,
            'idle_power': IDLE,
            'motion_power': MOTION,
            'charging_power': 1000.0,
        },
    }
    starts = rng.uniform(5.0, 85.0, 2), rng.uniform(115.0, 195.0, 2)
    values = copy.deepcopy(SMALL_FIELD) | {
        'environment': AREAS[area] | {'expected_targets': 8.0},
        'targets': {'count': 8, 'separation': 5.0, 'margin': 5.0},
        'robots': {
            name: drone | {'start': [*start.tolist(), 10.0]} for name, start in zip('ab', starts)
        },
        'limits': {'time': 150.0},
    }
    return scenario_from_values(values, 'test')


class Watch:
    """The true positions and charges of the robots of a search, step by step."""

    def __init__(self, monkeypatch):
        self.positions, self.charges, self.homes, advance = [], [], [], Simulation.advance
        self.radii = np.zeros(0)

        def watched(simulation):
            advance(simulation)
            robots = [simulation.robots[name] for name in sorted(simulation.robots)]
            self.positions.append([robot.state.pose.position for robot in robots])
            self.charges.append([robot.battery.charge for robot in robots])
            self.radii = np.array([robot.settings.radius for robot in robots])

        monkeypatch.setattr(Simulation, 'advance', watched)

    def clear(self):
        self.positions, self.charges = [], []

    def lowest(self):
        """Return the lowest charge of all."""
        return float(np.min(self.charges))

    def on_arrival(self):
        """Return the charges with which robots came home: where they begin to rise."""
        rises = np.diff(np.array(self.charges), axis=0) > 0.0
        begins = rises[1:] & ~rises[:-1]
        return np.array(self.charges)[1:-1][begins]

    def nearest(self):
        """Return the least distance of two robots beyond their radii [m]; inf of a single one."""
        places, least = np.array(self.positions), math.inf
        for i, j in itertools.combinations(range(places.shape[1]), 2):
            gaps = np.linalg.norm(places[:, i] - places[:, j], axis=1)
            least = min(least, float(gaps.min() - self.radii[i] - self.radii[j]))
        return least


# Two hundred searches take minutes.
@pytest.mark.timeout(1800)
@pytest.mark.parametrize('planner', ['maasi', 'tour', 'lawnmower', 'nearest_widest', Careless])
def test_nobody_runs_dry_and_who_is_charged_comes_back(planner, monkeypatch, request):
    watch, homes = Watch(monkeypatch), 0
    for seed in range(*request.config.getoption('--search-seeds')):
        rng = np.random.default_rng(seed)
        weak, area = bool(seed % 2), ('bounds', 'corridor')[seed // 2 % 2]
        made = scenario(rng, weak, area)
        watch.clear()
        result = search(made, seed, planner=planner)
        for name in 'ab':
            reasons = [
                decision.robots[name].reason
                for decision in result.decisions
                if name in decision.robots
            ]
            home = [i for i, reason in enumerate(reasons) if reason.startswith('goes home')]
            homes += len(home)
            # It decides again after it was charged.
            assert all(i + 1 in home or i + 1 < len(reasons) for i in home[:-1])
        endurance = made.robots['a'].endurance
        speed = made.robots['a'].motion.speed
        step = made.step * (endurance.per_second + endurance.per_metre * speed)
        # A battery that holds less is known after a while only.
        least = endurance.reserve - (0.05 if weak else 0.0) - step
        assert watch.lowest() > 0.0 and watch.nearest() >= 0.0
        assert (watch.on_arrival() >= least).all(), (seed, watch.on_arrival())
    assert homes >= 4


def test_a_way_is_afforded_if_the_path_home_is_left_with_the_reserve():
    """By hand: 10 m/s, 0.01 of the battery each second, nothing for metres."""
    motion = make_motion(MotionSettings(speed=10.0, approach_rate=5.0), Area([[0.0, 500.0]] * 2))
    settings = EnduranceSettings(per_second=0.01, reserve=0.2, chargers=[[0, 0, 0], [400, 0, 0]])
    endurance = Endurance(settings, motion, [0.0, 0.0, 0.0])
    state = RobotState.at_rest([0.0, 0.0, 0.0])
    goals = [[100.0, 0.0, 0.0], [200.0, 0.0, 0.0], [300.0, 0.0, 0.0], [390.0, 0.0, 0.0]]
    ways = motion.predict(state, goals, 0.1)
    # There 0.104, 0.204, 0.304, 0.394, and home 0.104, 0.204, 0.104, 0.014, as each stop takes
    # 0.4 s longer; the reserve; and 0.004 and 3 % of the path home on top.
    for charge, allowed in (
        (math.nan, [True] * 4),
        (0.62, [True] * 4),
        (0.617, [True, False, True, True]),
        (0.45, [True, False, False, False]),
        (0.3, [False] * 4),
    ):
        endurance.update_charge(charge)
        assert endurance.affords(ways, 0.1).tolist() == allowed, charge
    # With a factor for the path home the second needs 0.204 + 1.5 x 0.204 + 0.2 at least.
    windy = Endurance(settings.model_copy(update={'return_factor': 1.5}), motion, [0.0, 0.0, 0.0])
    for charge, allowed in ((0.73, True), (0.70, False)):
        windy.update_charge(charge)
        assert windy.affords(ways, 0.1)[1] == allowed


def test_a_robot_turns_home_where_the_reserve_would_be_used_and_learns_what_it_uses():
    motion = make_motion(MotionSettings(speed=10.0, approach_rate=5.0), Area([[0.0, 500.0]] * 2))
    settings = EnduranceSettings(per_second=0.01, reserve=0.2)

    def at(x, charge, before=None):
        endurance = Endurance(settings, motion, [0.0, 0.0, 0.0])
        for step, (place, was) in enumerate([*(before or []), (x, charge)]):
            endurance.update(step, RobotState.at_rest([place, 0.0, 0.0]), was, False)
        return endurance

    # Home takes 0.204 from 200 m, and two steps 0.002.
    assert at(200.0, 0.405).must_return and not at(200.0, 0.407).must_return
    assert not at(10.0, 0.3).must_return and not at(200.0, math.nan).must_return
    # It uses a fifth more: after 0.2 of the battery the ratio is known to a hundredth.
    flown = [(1.0 * k, 1.0 - 0.0012 * k) for k in range(200)]
    endurance = at(200.0, 0.76, flown)
    assert 1.17 < endurance.use_ratio <= 1.2
    assert endurance.use_home([200.0, 0.0, 0.0]) == pytest.approx(0.204 * endurance.use_ratio)
    # An unknown charge is the last one less the use, as it was learned.
    for step in range(201, 301):
        endurance.update(step, RobotState.at_rest([200.0, 0.0, 0.0]), -1.0, False)
    assert endurance.estimated
    assert endurance.charge == pytest.approx(0.76 - 0.1 * endurance.use_ratio, abs=0.002)
    # Paths that take twice the time cost twice as much.
    endurance = at(200.0, 0.9)
    for _ in range(600):
        endurance.note_pace(0.2, 0.1)
    assert 1.8 < endurance.time_ratio <= 2.0
    assert endurance.use_home([200.0, 0.0, 0.0]) == pytest.approx(0.204 * endurance.time_ratio)


def test_a_charger_on_the_ground_is_home_for_a_drone_above_it_in_2d():
    motion = make_motion(MotionSettings(speed=10.0), Area([[0.0, 500.0]] * 2))
    settings = EnduranceSettings(chargers=[[100.0, 100.0, 0.0]])
    endurance = Endurance(settings, motion, [0.0, 0.0, 20.0])
    assert endurance.chargers.tolist() == [[100.0, 100.0, 20.0]]
    assert endurance.is_home([100.0, 100.0, 20.0]) and endurance.is_home([100.0, 100.0, 0.0])
    endurance.begin(Phase.CHARGING)
    for step, (charge, phase) in enumerate(((0.94, Phase.CHARGING), (0.96, Phase.AVAILABLE))):
        endurance.update(step, RobotState.at_rest([100.0, 100.0, 20.0]), charge, True)
        assert endurance.phase is phase
    solid = make_motion(MotionSettings(speed=10.0), Area([[0.0, 500.0]] * 3))
    assert not Endurance(settings, solid, [0.0, 0.0, 20.0]).is_home([100.0, 100.0, 20.0])
