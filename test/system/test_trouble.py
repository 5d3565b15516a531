"""Runs in which robots leave, and a planner is killed while robots pass waypoints."""

import math
import os
import signal

import pytest
from scenario_runs import Operator, alongside, of_topic, run_scenario, start
from test_mavlink_scenario import short_search

from maasi_filter.ros.qos import RELIABLE
from maasi_msgs.msg import AgentState, PlanDecision
from maasi_sim.scenario.loading import load_scenario

pytestmark = pytest.mark.system


def test_the_others_plan_on_when_a_robot_leaves(tmp_path):
    scenario = load_scenario('mambo_turtlebot').content()
    scenario['events'] = [
        {'at': 3.0, 'robot': 'mambo', 'do': 'leave'},
        {'at': 10.0, 'robot': 'mambo', 'do': 'back'},
    ]
    scenario['limits']['time'] = 15.0
    run = run_scenario(scenario, tmp_path / 'run', '--seed', 1, '--lockstep')
    assert run.code in (0, 1), run.output
    events = {(item['agent'], item['event']) for item in run.report['events']}
    assert {('mambo', 'lost'), ('mambo', 'joined')} <= events
    alone, later = set(), set()
    for decision in of_topic(run, '/decisions'):
        robots = {robot['robot'] for robot in decision['robots']}
        if decision['step'] >= 10.0 / 0.05:
            later |= robots
        elif decision['step'] > 3.0 / 0.05:
            alone |= robots
    assert alone == {'turtlebot'}
    assert 'mambo' in later


class Watcher(Operator):
    """Hears where the robots of a run are, and where the planner sends them."""

    def __init__(self, domain):
        super().__init__(domain)
        self.states = {'drone': [], 'other': []}
        self.waypoints = {}
        node = self.node
        for name, states in self.states.items():
            node.create_subscription(AgentState, f'/{name}/state', states.append, RELIABLE)
        node.create_subscription(PlanDecision, '/decisions', self.on_decision, RELIABLE)

    def on_decision(self, message):
        for robot in message.robots:
            self.waypoints[robot.robot, robot.decision + 1] = robot.waypoint

    def passes(self, name):
        """Return whether a robot is on its way after a waypoint at which it did not stop."""
        states = self.states[name]
        if not states or not states[-1].goal_id:
            return False
        last = states[-1].goal_id
        before = {item.goal_status for item in states if item.goal_id == last - 1}
        return states[-1].goal_status == AgentState.MOVING and before == {AgentState.MOVING}

    def arrived(self):
        return all(states[-1].goal_status == AgentState.REACHED for states in self.states.values())


def test_robots_whose_planner_is_killed_while_they_pass_waypoints_stop_at_the_last_one(tmp_path):
    content = short_search()
    del content['robots']['rov']
    content['robots']['other']['link'] = 'topics'
    with alongside(Watcher) as watcher:
        states = watcher.states
        with start(content, tmp_path / 'run', *watcher.options, '--no-record') as run:
            watcher.until(lambda: all(map(watcher.passes, states)), 'the robots pass waypoints')
            # It would stop the robots at once.
            run.process.send_signal(signal.SIGSTOP)
            os.kill(*run.processes('/planner_node'), signal.SIGKILL)
            watcher.until(watcher.arrived, 'the robots reach their last waypoints')
            heard = {name: len(items) for name, items in states.items()}
            watcher.until(
                lambda: all(len(items) > heard[name] + 40 for name, items in states.items()),
                'states of robots that stand',
            )
            run.process.send_signal(signal.SIGCONT)
            run.finish()
    assert run.code == 3, run.output
    assert '/planner_node was killed by SIGKILL' in run.output
    for name, items in states.items():
        point = watcher.waypoints[name, items[-1].goal_id]
        for state in items[heard[name] + 20 :]:
            place, speed = state.pose.pose.position, state.twist.linear
            assert state.goal_status == AgentState.REACHED
            assert math.dist((place.x, place.y), (point.x, point.y)) < 1.0
            assert math.hypot(speed.x, speed.y, speed.z) < 0.3
