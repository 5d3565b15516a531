"""Home in time: no robot's battery is empty before it is home, whatever the planner."""

import copy
import math

import numpy as np
import pytest
from small_field import SMALL_FIELD

from maasi_filter.area import Area
from maasi_planner import MotionSettings, RobotState, make_motion
from maasi_planner.endurance import Endurance, EnduranceSettings
from maasi_planner.planners import Planner
from maasi_planner.team import Decision, single_choice
from maasi_sim.scenario.loading import scenario_from_values
from maasi_sim.search import search
from maasi_sim.simulation.robots import Battery

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


def scenario(rng):
    """Return a search with two drones whose batteries hold a fifth less than they say."""
    capacity = float(rng.uniform(12e3, 25e3))
    drone = {
        'type': 'ranging_drone',
        'candidates': {'grid': [8, 8], 'spacing': 25.0, 'corner': [12.5, 12.5]},
        'sensor': {'detection': {'kind': 'box', 'lower': [-15.0] * 3, 'upper': [15.0] * 3}},
        'endurance': {'per_second': IDLE / capacity, 'per_metre': MOTION / capacity},
        'battery': {
            'capacity': 0.8 * capacity,
            'idle_power': IDLE,
            'motion_power': MOTION,
            'charging_power': 1000.0,
        },
    }
    values = copy.deepcopy(SMALL_FIELD) | {
        'environment': {'bounds': [[0.0, 200.0], [0.0, 200.0]], 'expected_targets': 8.0},
        'targets': {'count': 8, 'separation': 5.0, 'margin': 5.0},
        'robots': {
            name: drone | {'start': [*rng.uniform(5.0, 195.0, 2).tolist(), 10.0]} for name in 'ab'
        },
        'limits': {'time': 150.0},
    }
    return scenario_from_values(values, 'test')


# Two hundred searches take minutes.
@pytest.mark.timeout(1800)
@pytest.mark.parametrize('planner', ['maasi', 'tour', 'lawnmower', 'nearest_widest', Careless])
def test_nobody_runs_dry_and_who_is_charged_comes_back(planner, monkeypatch, request):
    lowest, drain = [], Battery.drain

    def watched(battery, *arguments):
        drain(battery, *arguments)
        lowest.append(battery.charge)

    monkeypatch.setattr(Battery, 'drain', watched)
    homes = 0
    for seed in range(*request.config.getoption('--search-seeds')):
        result = search(scenario(np.random.default_rng(seed)), seed, planner=planner)
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
    assert min(lowest) > 0.0 and homes >= 4


def test_a_way_is_afforded_if_the_way_home_is_left_with_the_reserve():
    """By hand: 10 m/s, 0.01 of the battery each second, nothing for metres."""
    motion = make_motion(MotionSettings(speed=10.0, approach_rate=5.0), Area([[0.0, 500.0]] * 2))
    settings = EnduranceSettings(per_second=0.01, reserve=0.2, chargers=[[0, 0, 0], [400, 0, 0]])
    endurance = Endurance(settings, motion, [0.0, 0.0, 0.0])
    state = RobotState.at_rest([0.0, 0.0, 0.0])
    goals = [[100.0, 0.0, 0.0], [200.0, 0.0, 0.0], [300.0, 0.0, 0.0], [390.0, 0.0, 0.0]]
    ways = motion.predict(state, goals, 0.1)
    # There 0.1, 0.2, 0.3, 0.39; home 0.11, 0.22, 0.11, 0.01; in use some 0.005 for each stop.
    for charge, allowed in (
        (math.nan, [True] * 4),
        (0.64, [True] * 4),
        (0.62, [True, False, True, True]),
        (0.45, [True, False, False, False]),
        (0.3, [False] * 4),
    ):
        endurance.hear(charge)
        assert endurance.affords(ways, 0.1).tolist() == allowed, charge
    endurance.hear(0.3)
    assert endurance.must_return([200.0, 0.0, 0.0]) and not endurance.must_return([10.0, 0.0, 0.0])
    endurance.hear(-1.0)
    assert not endurance.must_return([200.0, 0.0, 0.0])
    endurance.charging = True
    endurance.hear(0.94)
    assert endurance.charging
    endurance.hear(0.96)
    assert not endurance.charging
    # The way table of each charger is made once.
    assert motion.table.cache_info().misses == 2
