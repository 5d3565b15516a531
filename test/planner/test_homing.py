"""Robots with batteries and closed zones in the hands of the coordinator, in all modes."""

import math

import numpy as np
import pytest

from maasi_drivers.agent.waypoint_follower import Goal, GoalStatus, WaypointFollower
from maasi_filter.ros.keep_outs import with_keep_outs
from maasi_planner.coordinator import Coordinator
from maasi_planner.endurance import NOT_CHARGED, NOTHING_AFFORDABLE, Phase
from maasi_planner.homing import CUT_OFF, TOO_FAR
from maasi_planner.motion import RobotState, make_motion
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.robot_plan import PresentRobot
from maasi_planner.team import TAKEN

STEP = 0.2
# 5 m/s; a full battery lasts for a minute of flight.
USE = {'per_second': 1.0 / 80.0, 'per_metre': 1.0 / 1200.0}
RESERVE = 0.25


def robot(start, chargers=None, reserve=RESERVE, **endurance):
    own = USE | {'reserve': reserve, 'chargers': chargers or []} | endurance
    return {
        'candidates': {'grid': [5, 5], 'spacing': 10.0, 'corner': [10.0, 10.0]},
        'motion': {
            'model': 'constant_speed',
            'speed': 5.0,
            'acceleration': 4.0,
            'tolerance': 0.3,
            'clearance': 0.5,
        },
        'sensor': {
            'detection': {'kind': 'box', 'probability': 0.9, 'lower': [-6, -6], 'upper': [6, 6]},
            'noise': {'range': 0.1, 'bearing': 0.1},
            'period': 1.0,
        },
        'radius': 0.4,
        'start': [*start, 10.0],
        'endurance': own,
    }


class Flight:
    """A coordinator with simulated bodies and batteries; goals take effect a step later."""

    def __init__(self, robots, planner='nearest_widest', **environment):
        area = {'bounds': [[0.0, 60.0], [0.0, 60.0]], 'expected_targets': 4.0} | environment
        self.settings = PlannerNodeSettings.model_validate(
            {
                'step': STEP,
                'environment': area,
                'planner': {'name': planner},
                'robots': robots,
            }
        )
        self.coordinator = Coordinator(self.settings)
        self.step = 0
        self.decisions = []
        self.modes = dict.fromkeys(robots, 'searching')
        self.charges = dict.fromkeys(robots, 1.0)
        self.heard = dict.fromkeys(robots, True)  # whether its charge is reported
        self.drain, self.charger = 1.0, 1.0 / 30.0  # share of a full battery each second
        self.followers, self.bodies, self.traces = {}, {}, {name: [] for name in robots}
        for name, known in self.coordinator.robots.items():
            settings = self.settings.robots[name]
            area = self.coordinator.area
            self.followers[name] = WaypointFollower(make_motion(settings.motion, area, 0.4))
            self.bodies[name] = known.facts.motion.body(RobotState.at_rest(settings.start))

    def place(self, name):
        return np.array(self.bodies[name].robot_state().pose.position)

    def put(self, name, position):
        motion = self.coordinator.robots[name].facts.motion
        self.bodies[name] = motion.body(RobotState.at_rest(position))

    def present(self):
        robots = {}
        for name, follower in self.followers.items():
            plan, mode = self.coordinator.robots[name].plan, self.modes[name]
            ended = follower.goal is not None and follower.goal.id == plan.goal_id
            free = plan.staying or (ended and follower.status != GoalStatus.MOVING)
            robots[name] = PresentRobot(
                self.bodies[name].robot_state(),
                free,
                self.charges[name] if self.heard[name] else math.nan,
                searches=mode == 'searching',
                returns=mode != 'waiting',
            )
        return robots

    def fly(self, seconds, until=lambda: False):
        """Step for a time, or until something is so; return whether it is."""
        for _ in range(round(seconds / STEP)):
            commands = {}
            for name, body in self.bodies.items():
                state = body.robot_state()
                commands[name] = self.followers[name].update(state, self.step)[0]
            robots = self.present()
            decision = self.coordinator.plan(self.step, robots)
            if decision is not None:
                self.decisions.append(decision)
                for name, chosen in decision.robots.items():
                    if not chosen.stays:
                        number = self.coordinator.robots[name].plan.goal_id
                        self.followers[name].adopt(Goal(number, self.step, chosen.waypoint))
            members = self.coordinator.measure(self.step, robots)
            self.coordinator.absorb({m.robot: robots[m.robot].state.pose for m in members}, [])
            if until():
                return True
            for name, body in self.bodies.items():
                before = self.place(name)
                body.step(commands[name], STEP)
                self._use(name, math.dist(before, self.place(name)))
                self.traces[name].append((self.place(name), self.charges[name]))
            self.step += 1
        return until()

    def _use(self, name, metres):
        endurance = self.coordinator.robots[name].endurance
        home = endurance.is_home(self.place(name)) and metres < 0.1 * STEP
        change = self.charger * STEP
        if not (home and self.charger > 0.0):
            change = -self.drain * (USE['per_second'] * STEP + USE['per_metre'] * metres)
        self.charges[name] = min(max(self.charges[name] + change, 0.0), 1.0)

    def close(self, *zones):
        area = with_keep_outs(self.settings.environment, zones)
        self.coordinator.adopt_area(area)
        for follower in self.followers.values():
            follower.motion.adopt_area(area, 0.4)

    def reasons(self, name):
        return [d.robots[name].reason for d in self.decisions if name in d.robots]

    def is_outside(self):
        """Return whether robot `a` is in no closed zone."""
        keep_out = self.coordinator.robots['a'].facts.motion.keep_out
        return keep_out.exit_from(self.place('a')) is None

    def at_home(self, name):
        return self.coordinator.robots[name].endurance.is_home(self.place(name))


@pytest.mark.parametrize('planner', ['nearest_widest', 'maasi', 'tour', 'lawnmower', 'maas'])
def test_after_the_search_robots_with_batteries_come_home_and_then_it_has_ended(planner):
    flight = Flight({'a': robot([3.0, 3.0]), 'b': robot([57.0, 57.0])}, planner)
    assert flight.fly(15.0, lambda: not flight.at_home('a') and not flight.at_home('b'))
    flight.coordinator.exploration.values[...] = 0.0
    assert flight.fly(60.0, lambda: flight.coordinator.finished is not None)
    assert flight.coordinator.ended is None and not flight.at_home('a')
    assert flight.fly(60.0, lambda: flight.coordinator.ended is not None)
    assert flight.at_home('a') and flight.at_home('b')
    end = flight.decisions[-1]
    assert not end.robots and end.reason == flight.coordinator.ended
    assert 'goes home: the search has ended' in flight.reasons('a')
    # They stay there.
    number = len(flight.decisions)
    flight.fly(30.0)
    assert len(flight.decisions) == number and flight.at_home('a')
    # A new search begins with nothing explored.
    flight.coordinator.begin_again()
    for known in flight.coordinator.robots.values():
        assert known.exploration is None or (known.exploration.values == 1.0).all()
    assert flight.fly(20.0, lambda: not flight.at_home('a'))


def test_a_paused_robot_comes_home_in_time_and_stays_and_one_that_waits_is_not_moved():
    flight = Flight({'a': robot([3.0, 3.0]), 'b': robot([57.0, 57.0])})
    flight.modes['b'] = 'waiting'
    flight.put('b', [30.0, 57.0, 10.0])
    flight.charges['b'] = 0.9
    assert flight.fly(40.0, lambda: math.dist(flight.place('a'), [3.0, 3.0, 10.0]) > 20.0)
    flight.modes['a'] = 'paused'
    flight.followers['a'].end(GoalStatus.CANCELED, 'paused')
    flight.coordinator.robots['a'].clear_plan()
    place = flight.place('a')
    flight.fly(2.0)
    assert math.dist(flight.place('a'), place) < 4.0
    assert flight.fly(90.0, lambda: flight.at_home('a'))
    arrival = flight.charges['a']
    assert RESERVE - 0.02 <= arrival <= RESERVE + 0.06
    flight.fly(60.0)
    # It is charged, and stays until it is resumed.
    assert flight.at_home('a') and flight.charges['a'] > 0.95
    assert flight.coordinator.robots['a'].endurance.phase is Phase.AVAILABLE
    assert flight.place('b').tolist() == [30.0, 57.0, 10.0] and not flight.reasons('b')
    flight.modes['a'] = 'searching'
    assert flight.fly(20.0, lambda: not flight.at_home('a'))


@pytest.mark.parametrize('seed', range(12))
def test_with_any_drain_robots_are_home_with_about_the_reserve(seed):
    """By the true charges, of batteries of which robots know less; the ratio is learned."""
    rng = np.random.default_rng(seed)
    planner = ['nearest_widest', 'maasi', 'tour'][seed % 3]
    chargers = rng.uniform(5.0, 55.0, (int(rng.integers(1, 3)), 2))
    starts = rng.uniform(5.0, 55.0, (2, 2))
    robots = {
        name: robot(start.tolist(), [[*place.tolist(), 0.0] for place in own])
        for name, start, own in zip('ab', starts, (chargers, chargers[::-1] + 2.0))
    }
    flight = Flight(robots, planner)
    flight.drain = float(rng.uniform(1.0, 1.3))
    flight.fly(140.0)
    for name in 'ab':
        charges = np.array([charge for _, charge in flight.traces[name]])
        assert charges.min() > 0.0
        rises = np.diff(charges) > 0.0
        arrivals = charges[1:-1][rises[1:] & ~rises[:-1]]
        # A step's use, and what is left to learn.
        least = RESERVE - 0.01 - 0.25 * (flight.drain - 1.0)
        waits = any('all chargers are taken' in reason for reason in flight.reasons(name))
        assert waits or (arrivals >= least).all(), (flight.drain, arrivals)
    gaps = np.array([a[0] for a in flight.traces['a']]) - [b[0] for b in flight.traces['b']]
    assert np.linalg.norm(gaps, axis=1).min() >= 0.8


def test_a_charge_that_is_not_reported_any_more_is_estimated():
    flight = Flight({'a': robot([3.0, 3.0])})
    endurance = flight.coordinator.robots['a'].endurance
    flight.drain = 1.2
    assert flight.fly(60.0, lambda: flight.charges['a'] < 0.7)
    assert not flight.coordinator.homing.estimates()
    flight.heard['a'] = False
    flight.fly(8.0)
    assert endurance.estimated and abs(endurance.charge - flight.charges['a']) < 0.02
    (text,) = flight.coordinator.homing.estimates()
    assert text.startswith('a: ') and 'estimated' in text
    flight.charger = 0.0
    assert flight.fly(90.0, lambda: endurance.phase is Phase.CHARGING)
    assert flight.charges['a'] > RESERVE - 0.05
    flight.heard['a'] = True
    flight.fly(1.0)
    assert not endurance.estimated


def test_a_robot_that_is_not_charged_stays_at_home_and_the_search_goes_on_without_it():
    flight = Flight({'a': robot([3.0, 3.0]), 'b': robot([57.0, 57.0])})
    flight.charger = 0.0
    flight.charges['b'] = 0.6
    endurance = flight.coordinator.robots['b'].endurance
    assert flight.fly(120.0, lambda: endurance.phase is Phase.DONE)
    assert endurance.done_reason == NOT_CHARGED and flight.at_home('b')
    assert f'b: {NOT_CHARGED}' in flight.coordinator.homing.news
    assert flight.fly(120.0, lambda: flight.coordinator.ended is not None)
    assert NOTHING_AFFORDABLE in flight.coordinator.ended and flight.at_home('a')
    # With another battery it goes out again.
    flight.coordinator.begin_again()
    flight.charges['b'] = 1.0
    assert flight.fly(20.0, lambda: not flight.at_home('b'))


@pytest.mark.parametrize('seed', range(20))
def test_a_robot_whose_charge_falls_until_it_rests_on_its_charger_is_charged(seed):
    random = np.random.default_rng(seed)
    flight = Flight({'a': robot([3.0, 3.0])})
    endurance = flight.coordinator.robots['a'].endurance
    state, charge, k = flight.bodies['a'].robot_state(), random.uniform(0.1, 0.5), 0
    endurance.begin(Phase.RETURNING)
    # A small battery: hovering uses up to 2 % of it a second.
    settles, use, rate = random.uniform(0.0, 9.0), random.uniform(0.0, 0.02), 0.03
    while charge < endurance.settings.full:
        endurance.update(k, state, charge, True)
        assert endurance.phase is Phase.CHARGING
        charge += STEP * (rate if k * STEP > settles else -min(use, charge / 10.0))
        k += 1


@pytest.mark.parametrize('planner', ['nearest_widest', 'maasi', 'tour', 'lawnmower'])
def test_a_robot_that_affords_nothing_with_a_full_battery_is_done_and_says_so_once(planner):
    flight = Flight({'a': robot([3.0, 3.0], reserve=0.97)}, planner)
    flight.charges['a'] = 0.9
    assert flight.fly(60.0, lambda: flight.coordinator.ended is not None)
    said = [reason for reason in flight.reasons('a') if NOTHING_AFFORDABLE in reason]
    assert len(said) <= 1 and len(flight.reasons('a')) < 40
    assert NOTHING_AFFORDABLE in flight.coordinator.ended and flight.at_home('a')
    assert math.dist(flight.place('a'), [3.0, 3.0, 10.0]) < 0.7


def test_a_robot_leaves_a_zone_that_is_closed_over_it_in_every_mode_but_waiting():
    for mode in ('searching', 'paused', 'waiting'):
        flight = Flight({'a': robot([30.0, 30.0])})
        flight.modes['a'] = 'waiting'
        flight.put('a', [30.0, 33.0, 10.0])
        flight.fly(1.0)
        flight.modes['a'] = mode
        flight.close('30 30 8')
        left = flight.fly(6.0, flight.is_outside)
        assert left == (mode != 'waiting')
        if left:
            assert flight.reasons('a')[0] == 'leaves the closed zone'
            # About 6 m at 5 m/s, with its acceleration.
            assert flight.step * STEP < 1.0 + 4.0
            assert np.linalg.norm(flight.place('a')[:2] - 30.0) >= 8.0


def test_a_robot_that_a_zone_cuts_off_from_its_charger_waits_with_an_alarm_until_it_is_open():
    flight = Flight({'a': robot([3.0, 3.0])})
    assert flight.fly(40.0, lambda: flight.place('a')[0] > 30.0)
    flight.close('POLYGON ((20 -1, 24 -1, 24 61, 20 61, 20 -1))')
    assert flight.fly(30.0, lambda: flight.coordinator.homing.alarms == {'a': CUT_OFF})
    assert flight.fly(20.0, lambda: f'waits: {CUT_OFF}' in flight.reasons('a'))
    place = flight.place('a')
    flight.fly(10.0)
    assert math.dist(place, flight.place('a')) < 0.5 and place[0] > 24.0
    flight.close()
    assert flight.fly(60.0, lambda: flight.at_home('a'))
    assert not flight.coordinator.homing.alarms


def test_a_battery_that_does_not_last_to_any_charger_is_an_alarm():
    flight = Flight({'a': robot([3.0, 3.0])})
    flight.put('a', [50.0, 50.0, 10.0])
    for charge, alarms in ((0.35, {}), (0.1, {'a': TOO_FAR})):
        flight.charges['a'] = charge
        flight.fly(0.4)
        assert flight.coordinator.homing.alarms == alarms
    assert flight.reasons('a')[0].startswith('goes home to charge')


def test_a_search_with_nothing_left_but_closed_ground_waits_for_it_and_goes_on():
    flight = Flight({'a': robot([3.0, 3.0])}, 'maasi')
    flight.coordinator.exploration.values[:, :27] = 0.0
    zone = 'POLYGON ((-1 26, 61 26, 61 61, -1 61, -1 26))'
    flight.close(zone)
    assert flight.fly(30.0, lambda: any('closed zones' in text for text in flight.reasons('a')))
    (reason,) = {text for text in flight.reasons('a') if text.startswith('waits: closed zones')}
    assert reason.endswith(' expected targets')
    flight.fly(40.0)
    assert flight.coordinator.finished is None
    flight.close()
    assert flight.fly(60.0, lambda: flight.place('a')[1] > 26.0)
    # A search that was finished goes on with ground that is opened.
    flight.coordinator.exploration.values[...] = 0.0
    assert flight.fly(60.0, lambda: flight.coordinator.ended is not None)
    flight.close(zone)
    flight.coordinator.exploration.values[...] = 1.0
    flight.close()
    assert flight.coordinator.finished is None
    assert flight.fly(30.0, lambda: not flight.at_home('a'))


def test_two_robots_that_share_one_charger_charge_in_turn():
    shared = [[30.0, 30.0, 0.0]]
    flight = Flight({'a': robot([26.0, 30.0], shared), 'b': robot([34.0, 30.0], shared)})
    flight.charger = 1.0 / 20.0
    homes = {'a': 0, 'b': 0}
    for _ in range(60):
        flight.coordinator.exploration.values[...] = 1.0
        flight.fly(5.0)
        for name in 'ab':
            homes[name] += flight.at_home(name)
    for name in 'ab':
        charges = [charge for _, charge in flight.traces[name]]
        assert min(charges) > 0.0 and homes[name] > 2
    assert any(TAKEN in text for n in 'ab' for text in flight.reasons(n))


@pytest.mark.parametrize('charge', [1.0, 0.2])
def test_queries_change_nothing(charge):
    flight = Flight({'a': robot([3.0, 3.0]), 'b': robot([57.0, 57.0])})
    flight.charges['a'] = charge
    flight.fly(10.0)
    coordinator, known = flight.coordinator, flight.coordinator.robots['a']
    homing, endurance = coordinator.homing, known.endurance
    state = flight.bodies['a'].robot_state()

    def facts():
        parts = [coordinator, homing, endurance, known.plan, known.schedule, known]
        fixed = '_paths', 'robots', '_robots', 'plan', 'schedule', 'endurance'
        return [{k: repr(v) for k, v in vars(part).items() if k not in fixed} for part in parts]

    before = facts()
    for _ in range(2):
        present = flight.present()
        paths = known.facts.motion.predict(state, known.candidates.at(state.pose.position), STEP)
        first = endurance.affords(paths, STEP).tolist()
        endurance.range_from(state.pose.position)
        endurance.chargers_within(state.pose.position)
        coordinator.planning(flight.step, present)
        errands = homing.errands(flight.step, present, True)
        homing.waiting(flight.step, present, errands)
        homing.settled(present)
        known.view(flight.step, present['a'], False)
        assert endurance.affords(paths, STEP).tolist() == first and facts() == before
