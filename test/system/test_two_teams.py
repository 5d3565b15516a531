"""Two teams in one ROS domain, each in its namespace, of robots that another program moves."""

from contextlib import ExitStack
from itertools import pairwise

import pytest
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from scenario_runs import Operator, alongside, check_replay, start, write_scenario

from maasi_filter.ros.conversions import stamp_from_ros, stamp_of_step, stamp_to_ros
from maasi_filter.ros.qos import LATCHED_ALL, SENSOR
from maasi_msgs.msg import LockstepDone
from maasi_sim.run.bag import Bag
from maasi_sim.scenario.loading import load_scenario
from maasi_sim.simulation.robots import Simulation
from maasi_sim.simulation.sim_topics import RobotTopics

pytestmark = pytest.mark.system
STEP, FIRST = 0.05, 20_000
CANDIDATES = {'grid': [7, 7], 'spacing': 0.384, 'corner': [-0.1, -0.1]}


class Mover(Operator):
    """A program that moves a robot for each team, and publishes the time of all."""

    def __init__(self, domain):
        super().__init__(domain)
        self.clock = self.node.create_publisher(Clock, '/clock', 10)
        self.teams, self.step = [], FIRST
        self.node.create_timer(STEP, self.move)

    def add(self, team, path):
        """Move the robot of a team's scenario."""
        moved = {'test': (('robots', 'mambo', 'body'), 'simulated')}
        simulation = Simulation(load_scenario(path, moved), 1)
        node = Node('mover', namespace=team, context=self.context)
        self.executor.add_node(node)
        topics = RobotTopics(node, simulation, 'mambo', SENSOR)

        def ready(message):
            # From now on all is recorded.
            if message.node.endswith('/recorder'):
                self.teams.append((simulation, topics))

        node.create_subscription(LockstepDone, 'lockstep/ready', ready, LATCHED_ALL)

        def command(message):
            linear, turn = message.twist.linear, message.twist.angular.z
            simulation.robots['mambo'].command((linear.x, linear.y, linear.z, turn))

        node.create_subscription(TwistStamped, 'mambo/cmd_vel', command, 10)

    def move(self):
        """Move all robots by a step."""
        self.step += 1
        stamp = stamp_to_ros(stamp_of_step(self.step, STEP))
        self.clock.publish(Clock(clock=stamp))
        for simulation, topics in self.teams:
            simulation.advance()
            topics.publish_odometry(stamp)


def write(path, target, start=(1.9, 1.9, 1.0), **changes):
    robot = {'type': 'mambo', 'start': [*start], 'candidates': CANDIDATES, 'body': 'external'}
    return write_scenario(path, [target], robots={'mambo': robot}, **changes)


@pytest.fixture(scope='module')
def teams(tmp_path_factory):
    """Return the runs of two teams, by namespace."""
    folder = tmp_path_factory.mktemp('teams')
    with alongside(Mover) as mover, ExitStack() as ends:
        runs = {}
        for team, target, begin in (
            ('team_a', [1.6, 1.8], (1.9, 1.9, 1.0)),
            ('team_b', [0.5, 0.4], (0.3, 0.3, 1.0)),
        ):
            path = write(folder / f'{team}.yaml', target, begin)
            mover.add(team, path)
            run = start(path, folder / team, *mover.options, '--namespace', team)
            runs[team] = ends.enter_context(run)
        mover.until(lambda: all(run.process.poll() is not None for run in runs.values()), 'the end')
        return {team: run.finish() for team, run in runs.items()}


def test_both_teams_find_their_targets(teams):
    for run in teams.values():
        assert run.code == 0, run.output
        assert run.report['end_reason'] == 'all_found'
        assert (run.report['true_found'], run.report['false_found']) == (1, 0)
        assert 0.0 < run.report['time_to_find_all'] < 120.0


@pytest.mark.parametrize('team', ['team_a', 'team_b'])
def test_a_recording_holds_its_own_team_from_its_first_measurement_on(teams, team):
    with Bag(teams[team].bag) as bag:
        facts, counts = bag.scenario(), bag.counts
        names = {
            status.name for item in bag.messages(['/diagnostics']) for status in item.message.status
        }
        loggers = {item.message.name for item in bag.messages(['/rosout'])}
        batches = [item.message.id for item in bag.messages([f'/{team}/measurement_batch'])]
        asked = {item.message.batch_id for item in bag.messages([f'/{team}/mambo/detections'])}
        steps = [item.message for item in bag.messages([f'/{team}/lockstep/step'])]
        clock = [stamp_from_ros(item.message.clock) for item in bag.messages(['/clock'])]
    shared = {'/clock', '/diagnostics', '/rosout', '/scenario', '/ending'}
    assert {topic for topic in counts if not topic.startswith(f'/{team}/')} == shared
    assert names and all(name.startswith(f'/{team}/') for name in names)
    assert loggers and all(name.startswith(f'{team}.') for name in loggers)
    assert batches[0] == 1
    # One that is on its way as the run ends may be missing.
    assert set(batches[:-1]) <= asked <= set(batches)
    assert counts[f'/{team}/filter_update'] >= len(batches) - 1
    numbers = [step.step for step in steps]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    # The clock of the last step, too.
    tick = max(later - time for time, later in pairwise(clock))
    assert stamp_from_ros(steps[-1].stamp) <= clock[-1] + tick
    assert facts['namespace'] == team
    assert '/filter_node' in facts['nodes']
    # The time is that of the program.
    assert steps[0].step > FIRST
    assert stamp_from_ros(steps[0].stamp) == stamp_of_step(steps[0].step, STEP)


def test_a_run_ends_where_the_clock_of_another_program_stands_still(tmp_path):
    limits = {'time': 120.0, 'silence': 2.0}
    path = write(tmp_path / 'far.yaml', [0.0, 0.0], limits=limits)
    with alongside(Mover) as mover:
        mover.add('', path)
        with start(path, tmp_path / 'run', *mover.options) as run:
            file = run.bag / 'bag.mcap'
            mover.until(lambda: file.exists() and file.stat().st_size > 100_000, 'the run moves')
            run.finish()
    assert run.code == 3, run.output
    assert 'for 2 s (limits.silence)' in run.output
    assert run.report['end_reason'] == 'clock_stopped'
    with Bag(run.folder) as recorded:
        *_, last = recorded.messages(['/mambo/cmd_vel'])
    assert last.message.twist.linear.x == last.message.twist.linear.y == 0.0


def test_the_recording_of_a_team_can_be_replayed(teams, tmp_path):
    check_replay(teams['team_b'], tmp_path)
