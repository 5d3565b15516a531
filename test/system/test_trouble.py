"""Runs in which robots leave, nodes are killed and users interrupt."""

import math
import os
import signal
import subprocess

import pytest
import yaml
from reserved_domain import reserved_domain
from run_operator import Operator
from scenario_runs import PATIENCE, command, of_topic, processes_with, run_scenario
from test_mavlink_scenario import short_search

from maasi_filter.ros.qos import RELIABLE
from maasi_msgs.msg import AgentState, PlanDecision
from maasi_sim.scenario.loading import load_scenario

pytestmark = pytest.mark.system


def test_the_others_plan_on_when_a_robot_leaves(tmp_path):
    scenario = load_scenario('mambo_turtlebot').content()
    scenario['events'] = [
        {'at': 3.0, 'robot': 'mambo', 'do': 'leave'},
        {'at': 22.0, 'robot': 'mambo', 'do': 'back'},
    ]
    scenario['limits']['time'] = 27.0
    file = tmp_path / 'leaving.yaml'
    file.write_text(yaml.safe_dump(scenario))
    run = run_scenario(file, tmp_path / 'run', '--seed', 1, '--lockstep')
    assert run.code in (0, 1), run.output
    events = [(item['agent'], item['event']) for item in run.report['events']]
    assert ('mambo', 'lost') in events
    assert ('mambo', 'joined') in events
    alone = [
        robot['robot']
        for decision in of_topic(run, '/decisions')
        if 3.0 / 0.05 < decision['step'] < 22.0 / 0.05
        for robot in decision['robots']
    ]
    assert alone
    assert set(alone) == {'turtlebot'}
    later = [
        robot['robot']
        for decision in of_topic(run, '/decisions')
        if decision['step'] >= 22.0 / 0.05
        for robot in decision['robots']
    ]
    assert 'mambo' in later


def kill(folder, name):
    """Kill a node of a run."""
    victims = [pid for pid in processes_with(f'{folder}/') if name in _command_line(pid)]
    os.kill(victims[0], signal.SIGKILL)


def _command_line(pid):
    with open(f'/proc/{pid}/cmdline', 'rb') as file:
        return file.read().decode()


class Watcher(Operator):
    """Hears where the robots of a run are, and where the planner sends them."""

    def __init__(self, domain, robots):
        super().__init__(domain)
        self.states = {name: [] for name in robots}
        self.waypoints = {}
        node = self.node
        for name, states in self.states.items():
            node.create_subscription(AgentState, f'/{name}/state', states.append, RELIABLE)
        node.create_subscription(PlanDecision, '/decisions', self._on_decision, RELIABLE)

    def _on_decision(self, message):
        for robot in message.robots:
            self.waypoints[robot.robot, robot.decision + 1] = robot.waypoint

    def passes(self, name):
        """Return whether a robot is on its way after a waypoint at which it did not stop."""
        states = self.states[name]
        last = states[-1].goal_id
        before = {item.goal_status for item in states if item.goal_id == last - 1}
        return states[-1].goal_status == AgentState.MOVING and before == {AgentState.MOVING}

    def under_way(self):
        """Return whether all robots pass waypoints."""
        sent = all(states and states[-1].goal_id for states in self.states.values())
        return sent and all(map(self.passes, self.states))

    def arrived(self):
        return all(states[-1].goal_status == AgentState.REACHED for states in self.states.values())


def test_robots_whose_planner_is_killed_while_they_pass_waypoints_stop_at_the_last_one(
    tmp_path, monkeypatch
):
    file, folder, robots = short_search(tmp_path), tmp_path / 'run', ('drone', 'other')
    content = yaml.safe_load(file.read_text())
    del content['robots']['rov']
    content['robots']['other']['link'] = 'topics'
    file.write_text(yaml.safe_dump(content))
    with reserved_domain() as domain:
        for name, value in domain.environment().items():
            monkeypatch.setenv(name, value)
        watcher = Watcher(domain, robots)
        process = subprocess.Popen(
            command(file, folder, '--domain-id', domain.number, '--no-record'),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            watcher.until(watcher.under_way, 'the robots pass waypoints')
            # It would stop the robots at once.
            process.send_signal(signal.SIGSTOP)
            kill(folder, 'planner_node')
            watcher.until(watcher.arrived, 'the robots reach their last waypoints')
            heard = {name: len(states) for name, states in watcher.states.items()}
            watcher.until(
                lambda: all(len(watcher.states[name]) > heard[name] + 40 for name in robots),
                'states of robots that stand',
            )
            process.send_signal(signal.SIGCONT)
            output, _ = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
            watcher.close()
    assert process.returncode == 3, output
    assert '/planner_node was killed by SIGKILL' in output
    for name, states in watcher.states.items():
        point = watcher.waypoints[name, states[-1].goal_id]
        for state in states[heard[name] + 20 :]:
            place, speed = state.pose.pose.position, state.twist.linear
            assert state.goal_status == AgentState.REACHED
            assert math.dist((place.x, place.y), (point.x, point.y)) < 1.0
            assert math.hypot(speed.x, speed.y, speed.z) < 0.3
