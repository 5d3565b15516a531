"""A flying robot behind a link, its driver in this process or its own, and the team around it."""

import os
import subprocess

import numpy as np
import yaml
from action_msgs.msg import GoalStatus
from rclpy.executors import SingleThreadedExecutor
from robot_team import Team, parameters_of

from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.ros.parameters import flatten
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

    def run_node(self, make):
        """Run the driver as a node of this process."""
        self.driver = make(
            context=self.context,
            namespace='/rover',
            parameter_overrides=parameters_of(self.settings),
        )
        self.executor.add_node(self.driver)
        assert self.driver.trigger_configure().name == 'SUCCESS', self.driver.problem
        assert self.driver.trigger_activate().name == 'SUCCESS'
        self.team.connect()
        return self

    def run_process(self, name, folder):
        """Run the driver as a process of its own."""
        file = folder / 'parameters.yaml'
        flat = flatten(DriverSettings.model_validate(self.settings))
        file.write_text(yaml.safe_dump({'/**': {'ros__parameters': flat}}))
        command = [name, '--ros-args', '--remap', '__ns:=/rover', '--params-file', str(file)]
        self.driver = subprocess.Popen(command, env=os.environ.copy())
        self.team.connect()
        return self

    def close(self):
        if isinstance(self.driver, subprocess.Popen):
            self.driver.kill()
            self.driver.wait()
        elif self.driver is not None:
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
    def doing(self):
        """What the drone does, for messages."""
        return ''

    @property
    def reason(self):
        return self.team.state.reason if self.team.states else 'silent'

    @property
    def status(self):
        return self.team.state.goal_status if self.team.states else None

    def until(self, condition, what=''):
        self.team.until(
            condition, what or (lambda: f'{self.doing}, {self.status}, {self.reason!r}')
        )

    def call(self, name):
        return self.team.call(name, self.until)

    def arm(self):
        # Refused until the drone is heard.
        self.until(lambda: self.call('arm').success)
        return self

    def until_it_flies(self):
        self.until(lambda: self.status in (AgentState.IDLE, AgentState.ABORTED))
        return self

    def gives_up(self, result, reason):
        """Check that the goal ends, that the planner hears why, and that it is not sent on."""
        self.until(lambda: self.status == AgentState.UNAVAILABLE and reason in self.reason)
        self.until(result.done)
        assert result.result().status == GoalStatus.STATUS_ABORTED
        assert reason in result.result().result.reason
        assert self.team.refused(self.team.settings.start)
