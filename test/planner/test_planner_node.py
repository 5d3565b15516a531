"""The planner node over real topics: decisions, faults, and what it says of it."""

import math
from contextlib import contextmanager
from functools import partial

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PointStamped
from own_context import own_context
from rcl_interfaces.msg import Log
from rclpy.action import ActionClient, ActionServer, GoalResponse
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from waiting import wait_until

from maasi_filter.ros.parameters import flatten
from maasi_filter.ros.qos import LATCHED_ALL, RELIABLE, UPDATES
from maasi_filter.ros.run_node import executor_of
from maasi_msgs.action import GoToWaypoint, SearchTargets
from maasi_msgs.msg import (
    AgentState,
    BatchMember,
    Cluster,
    FilterUpdate,
    LockstepDone,
    LockstepStep,
    MeasurementBatch,
    PlanDecision,
)
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.planner_node import PlannerNode

ROBOTS = ('a', 'b')
START = {'a': (0.5, 0.5), 'b': (1.5, 1.5)}
BOX = {'kind': 'box', 'probability': 0.98, 'lower': [-0.5, -0.5], 'upper': [0.5, 0.5]}
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
                    'detection': BOX,
                    'noise': {'range': 0.01, 'bearing': 0.03},
                    'period': 0.5,
                },
                'start': [*START[name], 0.0],
            }
            for name in ROBOTS
        },
        'others': {'c': {'start': [0.2, 1.8, 0.0]}},
    }
)


def changed(message, changes):
    """Return a message with some fields, named with '__' between the levels, replaced."""
    for path, value in changes.items():
        target = message
        *parts, last = path.split('__')
        for part in parts:
            target = getattr(target, part)
        setattr(target, last, value)
    return message


class Team:
    """The rest of the team: drivers, filter and users."""

    def __init__(self, context, others):
        self.node = Node('team', context=context)
        self.others = others
        self.decisions, self.batches, self.warnings, self.diagnostics = [], [], [], []
        self.goals = {name: [] for name in ROBOTS}
        node = self.node
        self.states = {
            name: node.create_publisher(AgentState, f'{name}/state', RELIABLE) for name in ROBOTS
        }
        self.updates = node.create_publisher(FilterUpdate, 'filter_update', UPDATES)
        self.destination = node.create_publisher(PointStamped, 'c/destination', RELIABLE)
        self.search = ActionClient(node, SearchTargets, 'search')
        self.servers = [
            ActionServer(
                node,
                GoToWaypoint,
                f'{name}/go_to',
                execute_callback=lambda handle: GoToWaypoint.Result(),
                goal_callback=lambda goal, name=name: self._take_goal(name, goal),
                handle_accepted_callback=lambda handle: None,
            )
            for name in ROBOTS
        ]
        node.create_subscription(PlanDecision, 'decisions', self.decisions.append, RELIABLE)
        node.create_subscription(
            MeasurementBatch, 'measurement_batch', self.batches.append, RELIABLE
        )
        self.steps = node.create_publisher(LockstepStep, 'lockstep/step', RELIABLE)
        self.done = []
        node.create_subscription(LockstepDone, 'lockstep/done', self.done.append, RELIABLE)
        node.create_subscription(Log, '/rosout', self._take_log, LATCHED_ALL)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._take_diagnostics, 10)

    def _take_goal(self, name, goal):
        self.goals[name].append(goal)
        return GoalResponse.ACCEPT

    def _take_log(self, message):
        if 'dropped' in message.msg:
            self.warnings.append(message.msg)

    def _take_diagnostics(self, message):
        self.diagnostics.extend(message.status)

    def state(self, name, step, **changes):
        message = AgentState(robot=name, step=step)
        message.header.frame_id = 'map'
        message.pose.pose.position.x, message.pose.pose.position.y = START[name]
        message.pose.pose.orientation.w = 1.0
        self.states[name].publish(changed(message, changes))

    @staticmethod
    def member(name, measurement=0, **changes):
        """Return a member of an update that measured at its start."""
        member = BatchMember(robot=name, measurement=measurement)
        member.pose.position.x, member.pose.position.y = START[name]
        return changed(member, changes)

    def update(self, batch, measured, **changes):
        """Publish an update of measurements at the starts: members of a batch, or names."""
        members = [
            self.member(*((item, 0) if isinstance(item, str) else (item.robot, item.measurement)))
            for item in measured
        ]
        message = FilterUpdate(batch_id=batch, members=members)
        message.header.frame_id = 'map'
        self.updates.publish(changed(message, changes))

    @property
    def connected(self):
        publishers = [*self.states.values(), self.updates]
        return (
            all(item.get_subscription_count() == 1 for item in publishers)
            and self.destination.get_subscription_count() == self.others
            and self.node.count_publishers('/decisions') == 1
            and self.node.count_publishers('/measurement_batch') == 1
            and self.search.server_is_ready()
        )


@contextmanager
def running(**changes):
    """Run a node with the team around it; yield both, and how to wait for something."""
    with own_context() as context:
        settings = SETTINGS.model_copy(update=changes)
        parameters = [Parameter(name, value=value) for name, value in flatten(settings).items()]
        node = PlannerNode(context=context, parameter_overrides=parameters)
        node.trigger_configure()
        node.trigger_activate()
        team = Team(context, len(settings.others))
        own = executor_of(node, context)
        other = SingleThreadedExecutor(context=context)
        other.add_node(team.node)

        def turn():
            own.spin_once(0.01)
            other.spin_once(timeout_sec=0.01)

        until = partial(wait_until, turn=turn)

        try:
            until(lambda: team.connected)
            until(lambda: all(item.server_is_ready() for item in node._goals.clients.values()))
            yield node, team, until
        finally:
            node.destroy_node()
            own.shutdown()
            other.shutdown()
            team.node.destroy_node()


@pytest.fixture
def world():
    with running() as everything:
        yield everything


def begin(node, team, until):
    """Let both robots say where they are; return once they are sent on their way."""
    # Who is heard first plans alone; the other one at the next step.
    for step in (0, 10):
        for name in ROBOTS:
            team.state(name, step)
        until(lambda step=step: [item.step for item in node._heard.values()] == [step, step])
    until(lambda: {item.robot for d in team.decisions for item in d.robots} == set(ROBOTS))
    until(lambda: all(team.goals[name] for name in ROBOTS))


BAD_STATES = [
    {'pose__pose__position__x': math.nan},
    {'pose__pose__position__y': math.inf},
    {'pose__pose__orientation__w': 0.0},
    {'twist__linear__x': math.nan},
    {'twist__angular__z': math.inf},
    {'header__frame_id': 'odom'},
    {'robot': 'nobody'},
]


def test_wrong_states_are_dropped_counted_and_told_and_nobody_is_sent_anywhere(world):
    node, team, until = world
    for number, changes in enumerate(BAD_STATES, start=1):
        team.state('a', 0, **changes)
        until(lambda number=number: node.dropped['bad state'] == number)
    assert team.decisions == []
    until(lambda: team.warnings)
    # The first one is told, the others only counted.
    assert 'a/state' in team.warnings[0]
    assert len(team.warnings) < len(BAD_STATES)
    begin(node, team, until)
    team.state('a', 15)
    until(lambda: node._heard['a'].step == 15)
    team.state('a', 12)
    until(lambda: node.dropped['old state'] == 1)
    until(lambda: any('dropped: old state' in _values(item) for item in team.diagnostics))
    last = next(item for item in team.diagnostics[::-1] if 'planner_node' in item.name)
    assert last.level == DiagnosticStatus.WARN
    assert _values(last)['dropped: bad state'] == str(len(BAD_STATES))


def _values(status):
    return {item.key: item.value for item in status.values}


def test_wrong_updates_change_nothing(world):
    node, team, until = world
    begin(node, team, until)
    until(lambda: team.batches)
    batch = team.batches[0].id
    members = [item.robot for item in team.batches[0].members]
    before = node.coordinator.exploration.explored_fraction()
    wrong = Cluster(mass=0.5)
    wrong.position.x = math.nan
    for number, changes in enumerate(
        (
            {'clusters': [wrong]},
            {'clusters': [Cluster(mass=math.inf)]},
            {'clusters': [Cluster(covariance=[math.nan] * 9)]},
            {'header__frame_id': 'odom'},
            {'members': [BatchMember(robot='nobody')]},
            {'members': [team.member('a', pose__position__x=math.nan)]},
            {'members': [team.member('a', pose__orientation__w=0.0)]},
            {'batch_id': 2**64 - 1},
            {'members': [BatchMember(robot='a', measurement=2**64 - 1)]},
            {'clusters': [Cluster(mass=1e308)]},
        ),
        start=1,
    ):
        team.update(batch, members, **changes)
        until(lambda number=number: node.dropped['bad update'] == number)
    team.update(batch, members, clusters=[Cluster(mass=0.5)] * 2000)
    until(lambda: node.dropped['too large message'] == 1)
    assert node.coordinator.exploration.explored_fraction() == before
    right = Cluster(mass=0.5)
    right.position.x = right.position.y = 1.0
    team.update(batch, members, clusters=[right])
    until(lambda: node.coordinator.clusters)
    explored = node.coordinator.exploration.explored_fraction()
    assert explored > before
    # A restarted filter publishes its last update again.
    right.mass = 0.7
    team.update(batch, members, clusters=[right])
    right.mass = 0.6
    team.update(batch, [], clusters=[right])
    until(lambda: node.coordinator.clusters[0].mass == 0.6)
    assert node.coordinator.exploration.explored_fraction() == explored


@pytest.mark.parametrize('step', [2**64 - 1, 10**9])
def test_a_state_of_an_absurd_step_changes_nothing(world, step):
    node, team, until = world
    begin(node, team, until)
    decisions = len(team.decisions)
    team.state('a', step)
    until(lambda: node.dropped['bad state'] == 1)
    for name in ROBOTS:
        team.state(name, 12)
    until(lambda: [item.step for item in node._heard.values()] == [12, 12])
    assert len(team.decisions) == decisions


def test_a_step_that_comes_again_brings_the_batch_again_and_no_other():
    """The filter that was to answer it may be gone, and another one in its place."""
    with running(lockstep=True, others={}) as (node, team, until):
        until(lambda: team.steps.get_subscription_count() == 1)
        until(lambda: team.node.count_publishers('/lockstep/done') == 1)
        step = LockstepStep(step=0, robots=list(ROBOTS), imaging=list(ROBOTS))
        for name in ROBOTS:
            team.state(name, 0, goal_id=1)
        team.steps.publish(step)
        until(lambda: team.batches and all(team.goals.values()) and not node._goals.waiting)
        step.imaging = []
        team.steps.publish(step)
        until(lambda: len(team.batches) == 2)
        assert team.batches[0] == team.batches[1]
        assert len(team.decisions) == 1 and team.done == []
        team.update(team.batches[0].id, ROBOTS)
        until(lambda: team.done)
        assert [(item.node, item.step) for item in team.done] == [('/planner_node', 0)]
        # Who knows nothing of its goal, as a driver that was started again, is sent anew.
        team.state('a', 20, goal_id=1, goal_status=AgentState.MOVING)
        team.state('b', 20, goal_id=0)
        step.step = 20
        team.steps.publish(step)
        until(lambda: len(team.goals['b']) == 2)
        assert len(team.goals['a']) == 1


def test_destinations_that_are_wrong_are_dropped(world):
    node, team, until = world
    for number, changes in enumerate(
        ({'point__x': math.nan}, {'header__frame_id': 'odom'}), start=1
    ):
        message = PointStamped()
        message.header.frame_id = 'map'
        team.destination.publish(changed(message, changes))
        until(lambda number=number: node.dropped['bad destination'] == number)
    assert node._others.taken(0, None)[0][0].tolist() == [0.2, 1.8, 0.0]


def test_a_search_of_no_finite_time_is_refused(world):
    node, team, until = world
    for limit in (math.nan, -1.0):
        answer = team.search.send_goal_async(SearchTargets.Goal(time_limit=limit))
        until(answer.done)
        assert not answer.result().accepted
    assert node.dropped['bad goal'] == 2


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('planner.alpha', -1.0),
        ('planner.beta', math.nan),
        ('environment.bounds', [0.0, 2.0, 0.0, math.inf]),
    ],
)
def test_wrong_parameters_are_refused_by_name(name, value):
    flat = {**flatten(SETTINGS), name: value}
    with own_context() as context:
        node = PlannerNode(
            context=context,
            parameter_overrides=[Parameter(key, value=item) for key, item in flat.items()],
        )
        assert node.trigger_configure().name == 'FAILURE'
        assert f'parameter {name}' in node.problem
        node.destroy_node()
