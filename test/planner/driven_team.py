"""A planner, two real drivers and the robots that they drive, over real topics."""

import gc
import io
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stdout
from unittest.mock import patch

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from own_context import own_context
from player import Player, parameters
from rcl_interfaces.msg import Log
from rclpy.action import ActionClient
from waiting import wait_until

from maasi_drivers.drivers import TurtlebotDriver
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.models.pose import Pose, compose, inverse
from maasi_filter.ros.conversions import pose_to_ros, stamp_to_ros
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE
from maasi_msgs.action import GoToWaypoint, SearchTargets
from maasi_msgs.msg import AgentState, FilterUpdate, PlanDecision
from maasi_planner.motion import RobotState, make_motion
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planner_node import PlannerNode

ROBOTS = ('a', 'b')
START = {'a': (0.5, 0.5), 'b': (1.5, 1.5)}
SETTINGS = PlannerNodeSettings.model_validate(
    {
        'environment': {'bounds': [[0.0, 2.0], [0.0, 2.0]]},
        'planner': {'name': 'maasi'},
        'state_timeout': 30.0,
        'search_on_start': True,
        'robots': {
            name: {
                'candidates': {'grid': [3, 3], 'spacing': 0.5, 'corner': [0.5, 0.5]},
                'motion': {'model': 'constant_speed', 'speed': 0.5},
                'sensor': {
                    'detection': {
                        'kind': 'box',
                        'probability': 0.98,
                        'lower': [-0.5, -0.5],
                        'upper': [0.5, 0.5],
                    },
                    'noise': {'range': 0.01, 'bearing': 0.03},
                    'period': 0.5,
                },
                'start': [*START[name], 0.0],
            }
            for name in ROBOTS
        },
    }
)
STEP = 0.05
# Wall time of a step of the robots, where odometry is lost at most [s].
TURN, LONGEST_TURN = 0.01, 1.0
# Share of its way that a robot goes while something is listened for.
SLOW = 0.02
_DRIVER = {
    'step': STEP,
    'environment': {'bounds': [[0.0, 2.0], [0.0, 2.0]]},
    'odometry_timeout': 30.0,
    'sensor_timeout': 0.0,
    'motion': {'model': 'unicycle', 'speed': 0.5, 'acceleration': 2.0},
    'sensor': {'detection': {'kind': 'box', 'lower': [-0.1, -0.1], 'upper': [0.2, 0.2]}},
    'camera': {
        'focal_length': [120.0, 120.0],
        'mount': {'position': [0.05, 0.05, 0.4], 'rpy': [0.0, 1.5708, 0.0]},
    },
}


class Robot:
    """A robot that obeys `cmd_vel`, and what is heard of it."""

    def __init__(self, world, name):
        self.settings = DriverSettings.model_validate({**_DRIVER, 'start': [*START[name], 0.0]})
        self.start = Pose.from_yaw(self.settings.start, 0.0)
        motion = make_motion(self.settings.motion, radius=self.settings.radius)
        self.body = motion.body(RobotState(self.start))
        self.commands = world.collect(TwistStamped, f'{name}/cmd_vel')
        self.states = world.collect(AgentState, f'{name}/state')
        self.odometry = world.node.create_publisher(Odometry, f'{name}/odom', RELIABLE)
        self.go_to = ActionClient(world.node, GoToWaypoint, f'{name}/go_to')

    @property
    def command(self):
        if not self.commands:
            return [0.0] * 4
        twist = self.commands[-1].twist
        return [twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z]

    def move(self, step, share=1.0):
        self.body.step(self.command, share * STEP)
        state = self.body.robot_state()
        message = Odometry()
        message.header.frame_id = 'odom'
        message.header.stamp = stamp_to_ros(round(step * STEP * 1e9))
        message.pose.pose = pose_to_ros(compose(inverse(self.start), state.pose))
        velocity = state.pose.rotation().T @ state.velocity
        message.twist.twist.linear.x = float(velocity[0])
        message.twist.twist.angular.z = float(state.angular_velocity[2])
        self.odometry.publish(message)

    @property
    def state(self):
        return self.states[-1]

    @property
    def place(self):
        return tuple(self.body.robot_state().pose.position)

    def is_near(self, x, y, distance):
        return np.hypot(self.place[0] - x, self.place[1] - y) < distance

    @property
    def stands(self):
        speed = np.abs(self.body.robot_state().velocity).max()
        return self.command == [0.0] * 4 and speed < 1e-9

    @property
    def moves(self):
        return bool(self.states) and self.state.goal_status == AgentState.MOVING


class World(Player):
    """The planner (`planner`), the robots (by name in `robots`), and a client of both."""

    def __init__(self, context, settings):
        super().__init__(context, 'world')
        self.settings = settings
        node, self.step, self.status = self.node, 0, {}
        self.robots = {name: Robot(self, name) for name in ROBOTS}
        self._logs = self.collect(Log, '/rosout', LATCHED_ALL)
        self.decisions = self.collect(PlanDecision, 'decisions')
        node.create_subscription(DiagnosticArray, '/diagnostics', self._take_diagnostics, 10)
        self.updates = node.create_publisher(FilterUpdate, 'filter_update', LATCHED)
        self.search = ActionClient(node, SearchTargets, 'search')
        self.drivers = []
        for name, robot in self.robots.items():
            driver = TurtlebotDriver(
                context=context,
                namespace=f'/{name}',
                parameter_overrides=parameters(robot.settings),
            )
            assert driver.trigger_configure().name == 'SUCCESS'
            assert driver.trigger_activate().name == 'SUCCESS'
            self.executor.add_node(driver)
            self.drivers.append(driver)
        self.start_planner()

    def start_planner(self):
        self.planner = self.start(PlannerNode, self.settings)
        goals = self.planner.goals.clients.values()
        self.until(
            lambda: (
                all(client.server_is_ready() for client in goals)
                and all(robot.go_to.server_is_ready() for robot in self.robots.values())
                and self.search.server_is_ready()
                and self.node.count_publishers('decisions') == 1
                and set(self.planner.states) == set(ROBOTS)
            ),
            'not connected',
        )

    def end_planner(self):
        self.planner = None
        self.end()

    def close(self):
        self.planner = None
        super().close()
        while self.drivers:
            self.drivers.pop().destroy_node()

    def _take_diagnostics(self, message):
        for status in message.status:
            if 'planner_node' in status.name:
                self.status = {item.key: item.value for item in status.values}
                self.status |= {'level': status.level, 'message': status.message}

    def listen(self, condition, *what):
        """Let the robots get hardly any further until something is true."""
        wait_until(condition, lambda: self.turn(SLOW), *what)

    def turn(self, share=1.0):
        """Do one step of the robots, or a share of one, and what follows from it."""
        self.step += 1
        for robot in self.robots.values():
            robot.move(self.step, share)
        now = time.monotonic()
        # On a busy machine a driver may not have answered the present step.
        while time.monotonic() < now + TURN or (
            time.monotonic() < now + LONGEST_TURN
            and any(item.states and item.state.step < self.step for item in self.robots.values())
        ):
            super().turn()

    def pass_steps(self, steps):
        """Let the robots do some steps, each heard by the planner."""
        heard = self.planner.states
        last = min(item.step for item in heard.values()) + steps
        self.until(lambda: min(item.step for item in self.planner.states.values()) >= last)

    def logged(self, text):
        return [item.msg for item in self._logs if text in item.msg]

    def send(self, name, position, number):
        """Send a goal as another client; return its handle and the future of its result."""
        goal = GoToWaypoint.Goal(goal_id=number)
        goal.waypoint.header.frame_id = 'map'
        goal.waypoint.pose.position.x, goal.waypoint.pose.position.y = position
        return self._accepted(self.robots[name].go_to, goal)

    def ask(self, **fields):
        """Send a goal of the action search; return its handle and the future of its result."""
        return self._accepted(self.search, SearchTargets.Goal(**fields))

    def _accepted(self, client, goal):
        future = client.send_goal_async(goal)
        self.until(future.done)
        assert future.result().accepted
        return future.result(), future.result().get_result_async()

    @property
    def _domain(self):
        return {'ROS_DOMAIN_ID': str(self.context.get_domain_id())}

    def run(self, *words):
        return subprocess.Popen(
            [sys.executable, *words],
            env=os.environ | self._domain,
            stdout=subprocess.PIPE,
            text=True,
        )

    def command(self, main, *words):
        """Return exit code and output of a command that runs here, while the robots go on."""
        with (
            patch.dict(os.environ, self._domain),
            # Only the main thread has signals.
            patch('signal.signal'),
            redirect_stdout(io.StringIO()) as said,
            ThreadPoolExecutor() as pool,
        ):
            ended = pool.submit(main, words)
            self.until(ended.done, 'the command does not end')
        gc.collect()
        return ended.result(), said.getvalue()

    def ended(self, process):
        """Return exit code and output of a process, while the robots go on."""
        try:
            self.until(lambda: process.poll() is not None, 'the command does not end')
            return process.returncode, process.stdout.read()
        finally:
            process.kill()
            process.communicate()

    def moving(self):
        return all(robot.moves for robot in self.robots.values())

    def standing(self):
        return all(robot.stands and not robot.moves for robot in self.robots.values())


@contextmanager
def driven(**changes):
    """Run a planner with two drivers and their robots."""
    with own_context() as context:
        settings = SETTINGS.model_copy(update={'filter_timeout': 0.0, **changes})
        world = World(context, settings)
        try:
            yield world
        finally:
            world.close()
