"""A flying robot behind a link, its driver in this process or its own, and the team around it."""

import signal
import subprocess
from functools import partial

import numpy as np
from action_msgs.msg import GoalStatus
from rclpy.executors import SingleThreadedExecutor
from robot_team import Team, parameters_of

from maasi_msgs.msg import AgentState


class LinkedFlight:
    """All of it; the tests of each link add the drone as `drone`, which has `state` and `close`."""

    def __init__(self, context, settings):
        self.context = context
        self.settings = settings
        self.driver = None
        self.executor = SingleThreadedExecutor(context=context)
        self.team = team = Team(context, settings, self.executor, deaf=True)
        # It is not reached by topics.
        team.used = [item for item in team.used if item not in (team.odometry, team.battery)]
        self.call = partial(team.call, until=self.until)

    def run_node(self, make):
        """Run the driver as a node of this process."""
        overrides = parameters_of(self.settings)
        self.driver = make(context=self.context, namespace='/rover', parameter_overrides=overrides)
        self.executor.add_node(self.driver)
        assert self.driver.trigger_configure().name == 'SUCCESS', self.driver.problem
        assert self.driver.trigger_activate().name == 'SUCCESS'
        self.team.connect()
        return self

    def run_process(self, process, name):
        """Run the driver as a process of its own, by the fixture `process`."""
        self.driver = process(program=(name,), settings=self.settings)
        self.team.connect()
        return self

    def close(self):
        if self.driver is not None and not isinstance(self.driver, subprocess.Popen):
            self.driver.halt()
            self.driver.destroy_node()
        self.drone.close()
        self.team.destroy_node()
        self.executor.shutdown()

    @property
    def where(self):
        return self.drone.state.pose.position

    @property
    def speed(self):
        """Over the ground [m/s]."""
        return float(np.linalg.norm(self.drone.state.velocity[:2]))

    @property
    def reason(self):
        return self.team.state.reason if self.team.states else 'silent'

    @property
    def status(self):
        return self.team.state.goal_status if self.team.states else None

    def until(self, condition, what=''):
        self.team.until(condition, what or (lambda: f'{self.status}, {self.reason!r}'))

    def away(self, point):
        return float(np.linalg.norm(self.where - point))

    def arm(self):
        # Refused until the drone is heard.
        self.until(lambda: self.call('arm').success)
        return self

    def until_it_flies(self):
        self.until(lambda: self.status in (AgentState.IDLE, AgentState.ABORTED))
        return self

    def slowest_past(self, first, second, near):
        """Return the lowest speed from `near` one waypoint to near the next one, where it stops."""
        _, replaced = self.team.send_accepted(first, number=1)
        self.until(lambda: self.away(first) < near)
        _, result = self.team.send_accepted(second, number=2)
        speeds = []
        self.until(lambda: speeds.append(self.speed) or self.away(second) < near)
        assert replaced.done() and replaced.result().result.reason == 'replaced'
        self.until(result.done)
        assert result.result().result.reached
        self.until(lambda: self.speed < 0.05)
        return min(speeds)

    def restarts_by_its_clock(self, result, set_back, goal):
        """Check that a jump back of the clock stops it, and that it takes goals again."""
        set_back(self.driver, 1000.0)
        self.until(result.done)
        assert result.result().result.reason == 'the time jumped back'
        self.until(lambda: self.speed < 0.1)
        _, result = self.until_it_flies().team.send_accepted(goal)
        self.until(result.done)
        assert result.result().result.reached

    def is_sent(self, number, result):
        """Send a signal to the driver's process, and wait for its end."""
        self.driver.send_signal(number)
        self.until(lambda: self.driver.poll() is not None)
        if number == signal.SIGINT:
            assert self.driver.returncode == 0
            self.until(result.done)
            assert result.result().result.reason == 'the driver stops'

    def gives_up(self, result, reason):
        """Check that the goal ends, that the planner hears why, and that it is not sent on."""
        self.until(lambda: self.status == AgentState.UNAVAILABLE and reason in self.reason)
        self.until(result.done)
        assert result.result().status == GoalStatus.STATUS_ABORTED
        assert reason in result.result().result.reason
        assert self.team.refused(self.team.settings.start)
