"""The planner node over real topics: decisions, faults, and what it says of it."""

import math
from contextlib import contextmanager
from functools import partial

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from driven_team import ROBOTS, SETTINGS, START
from geometry_msgs.msg import PointStamped
from own_context import own_context
from player import Player
from rcl_interfaces.msg import Log
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from visualization_msgs.msg import MarkerArray

from maasi_filter import colours
from maasi_filter.ros.conversions import colour_of
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE, UPDATES
from maasi_msgs.action import GoToWaypoint, SearchTargets
from maasi_msgs.msg import (
    AgentState,
    BatchMember,
    Cluster,
    FilterUpdate,
    FoundTarget,
    FoundTargetArray,
    KeepOuts,
    LockstepDone,
    LockstepStep,
    MeasurementBatch,
    PlanDecision,
)
from maasi_msgs.srv import SetKeepOuts
from maasi_planner.conversions import checked_state, checked_update
from maasi_planner.node.filter_guard import FilterWatch
from maasi_planner.node_settings import OtherRobotSettings
from maasi_planner.planner_node import PlannerNode
from maasi_planner.settings import planner_settings


def changed(message, changes):
    """Return a message with some fields, named with '__' between the levels, replaced."""
    for path, value in changes.items():
        target = message
        *parts, last = path.split('__')
        for part in parts:
            target = getattr(target, part)
        setattr(target, last, value)
    return message


def state_of(name, step=0, **changes):
    message = AgentState(robot=name, step=step)
    message.header.frame_id = 'map'
    message.pose.pose.position.x, message.pose.pose.position.y = START[name]
    message.pose.pose.orientation.w = 1.0
    return changed(message, changes)


def member_of(name, measurement=0, **changes):
    """Return a member of an update that measured at its start."""
    member = BatchMember(robot=name, measurement=measurement)
    member.pose.position.x, member.pose.position.y = START[name]
    return changed(member, changes)


def update_of(batch, measured, **changes):
    """Return an update of measurements at the starts: members of a batch."""
    members = [member_of(item.robot, item.measurement) for item in measured]
    message = FilterUpdate(batch_id=batch, members=members)
    message.header.frame_id = 'map'
    return changed(message, changes)


def cluster_of(mass, x=1.0):
    cluster = Cluster(mass=mass)
    cluster.position.x = cluster.position.y = x
    return cluster


class Team(Player):
    """The rest of the team: drivers, filter and users."""

    def __init__(self, context, settings):
        super().__init__(context, 'team')
        self.start(PlannerNode, settings)
        node = self.node
        self.states = {
            name: node.create_publisher(AgentState, f'{name}/state', RELIABLE) for name in ROBOTS
        }
        self.updates = node.create_publisher(FilterUpdate, 'filter_update', UPDATES)
        self.steps = node.create_publisher(LockstepStep, 'lockstep/step', RELIABLE)
        self.goals = {name: [] for name in ROBOTS}
        self.cancelled = []
        self.servers = [
            ActionServer(
                node,
                GoToWaypoint,
                f'{name}/go_to',
                execute_callback=lambda handle: GoToWaypoint.Result(),
                goal_callback=partial(self._take_goal, name),
                handle_accepted_callback=lambda handle: None,
                cancel_callback=self._cancel,
            )
            for name in ROBOTS
        ]
        self.decisions = self.collect(PlanDecision, 'decisions')
        self.batches = self.collect(MeasurementBatch, 'measurement_batch')
        self.done = self.collect(LockstepDone, 'lockstep/done')
        self.logs = self.collect(Log, '/rosout', LATCHED_ALL)
        self.diagnostics = self.collect(DiagnosticArray, '/diagnostics')
        publishers = [*self.states.values(), self.updates]
        self.until(
            lambda: (
                all(item.get_subscription_count() == 1 for item in publishers)
                and node.count_publishers('/decisions') == 1
                and node.count_publishers('/measurement_batch') == 1
                and all(item.server_is_ready() for item in self.tested.goals.clients.values())
            )
        )

    def _take_goal(self, name, goal):
        self.goals[name].append(goal)
        return GoalResponse.ACCEPT

    def _cancel(self, handle):
        self.cancelled.append(handle)
        return CancelResponse.ACCEPT

    def tell(self, step):
        for name in ROBOTS:
            self.states[name].publish(state_of(name, step))
        self.until(lambda: [item.step for item in self.tested.states.values()] == [step, step])

    def begin(self):
        """Return once both robots are sent on their way."""
        # The robot that is received first plans alone; the other one at the next step.
        self.tell(0)
        self.tell(10)
        self.until(lambda: all(self.goals.values()))
        self.until(lambda: self.batches)

    def answer(self):
        self.updates.publish(update_of(self.batches[-1].id, self.batches[-1].members))

    def status(self):
        statuses = [item for array in self.diagnostics for item in array.status]
        return next((item for item in statuses[::-1] if 'planner_node' in item.name), None)


@contextmanager
def running(**changes):
    with own_context() as context:
        team = Team(context, SETTINGS.model_copy(update=changes))
        try:
            yield team
        finally:
            team.close()


@pytest.fixture
def team():
    with running() as made:
        yield made


def check_state(**changes):
    checked_state('a', state_of('a', **changes), SETTINGS)


def check_update(**changes):
    checked_update(update_of(1, [member_of('a')], **changes), ROBOTS, SETTINGS, 1)


@pytest.mark.parametrize(
    ('check', 'changes', 'words'),
    [
        (check_state, {'pose__pose__position__x': math.nan}, 'position'),
        (check_state, {'pose__pose__position__y': math.inf}, 'position'),
        (check_state, {'pose__pose__orientation__w': 0.0}, 'orientation'),
        (check_state, {'twist__linear__x': math.nan}, r'twist\.linear'),
        (check_state, {'twist__angular__z': math.inf}, r'twist\.angular'),
        (check_state, {'header__frame_id': 'odom'}, r"frame_id: read 'odom', allowed is 'map'"),
        (check_state, {'robot': 'nobody'}, "robot: read 'nobody', allowed is 'a'"),
        (check_state, {'step': 2**64 - 1}, 'step: read'),
        (check_update, {'clusters': [cluster_of(0.5, math.nan)]}, 'position'),
        (check_update, {'clusters': [cluster_of(math.inf)]}, 'mass'),
        (check_update, {'clusters': [cluster_of(1e308)]}, 'mass'),
        (check_update, {'clusters': [Cluster(covariance=[math.nan] * 9)]}, 'covariance'),
        (check_update, {'header__frame_id': 'odom'}, r'header\.frame_id'),
        (check_update, {'members': [BatchMember(robot='nobody')]}, "members: read .'nobody'"),
        (check_update, {'members': [member_of('a', pose__position__x=math.nan)]}, 'a: pose.pos'),
        (check_update, {'members': [member_of('a', pose__orientation__w=0.0)]}, 'a: pose.orien'),
        (check_update, {'members': [member_of('a', 2**64 - 1)]}, 'members: a: measurement: read'),
        (check_update, {'batch_id': 2**64 - 1}, 'batch_id: read'),
    ],
)
def test_wrong_states_and_updates_are_refused_by_their_field(check, changes, words):
    with pytest.raises(ValueError, match=words):
        check(**changes)


def test_wrong_states_and_updates_are_dropped_counted_and_told_and_change_nothing(team):
    for number in (1, 2, 3):
        team.states['a'].publish(state_of('a', header__frame_id='odom'))
        team.until(lambda number=number: team.tested.dropped['bad state'] == number)
    assert team.decisions == []
    # The first one is told, the others only counted.
    team.until(lambda: any('dropped' in item.msg for item in team.logs))
    (warning,) = [item.msg for item in team.logs if 'dropped' in item.msg]
    assert 'a/state' in warning
    team.begin()
    team.tell(15)
    team.states['a'].publish(state_of('a', 12))
    team.until(lambda: team.tested.dropped['old state'] == 1)
    # A step that is far away is taken if the next one follows it.
    team.states['a'].publish(state_of('a', 10**9))
    team.until(lambda: team.tested.dropped['bad state'] == 4)
    team.tell(16)
    team.until(lambda: team.tested.planned_step == 16)

    def values():
        return {item.key: item.value for item in team.status().values}

    team.until(lambda: team.status() and values().get('dropped: bad state') == '4')
    assert team.status().level == DiagnosticStatus.WARN
    # Updates count once, and wrong ones not.
    coordinator, dropped = team.tested.coordinator, team.tested.dropped
    batch, members = team.batches[0].id, team.batches[0].members
    before = coordinator.exploration.explored_fraction()
    team.updates.publish(update_of(batch, members, header__frame_id='odom'))
    team.until(lambda: dropped['bad update'] == 1)
    team.updates.publish(update_of(batch, members, clusters=[cluster_of(0.5)] * 2000))
    team.until(lambda: dropped['too large message'] == 1)
    assert coordinator.exploration.explored_fraction() == before
    team.updates.publish(update_of(batch, members, clusters=[cluster_of(0.5)]))
    team.until(lambda: coordinator.clusters)
    explored = coordinator.exploration.explored_fraction()
    assert explored > before
    # A restarted filter publishes its last update again.
    team.updates.publish(update_of(batch, members, clusters=[cluster_of(0.7)]))
    team.updates.publish(update_of(batch, [], clusters=[cluster_of(0.6)]))
    team.until(lambda: coordinator.clusters[0].mass == 0.6)
    assert coordinator.exploration.explored_fraction() == explored


def test_a_step_that_comes_again_brings_the_batch_again_and_no_other():
    """The filter that was to answer it may be gone, and another one in its place."""
    with running(lockstep=True) as team:
        team.until(lambda: team.steps.get_subscription_count() == 1)
        team.until(lambda: team.node.count_publishers('/lockstep/done') == 1)
        step = LockstepStep(step=0, robots=list(ROBOTS), imaging=list(ROBOTS))
        for name in ROBOTS:
            team.states[name].publish(state_of(name, goal_id=1))
        team.steps.publish(step)
        goals = team.tested.goals
        team.until(lambda: team.batches and all(team.goals.values()) and not goals.waiting)
        step.imaging = []
        team.steps.publish(step)
        team.until(lambda: len(team.batches) == 2)
        assert team.batches[0] == team.batches[1]
        assert len(team.decisions) == 1 and team.done == []
        team.answer()
        team.until(lambda: team.done)
        assert [(item.node, item.step) for item in team.done] == [('/planner_node', 0)]
        # A driver that does not know its goal, as after a restart, receives it again.
        moving = state_of('a', 20, goal_id=1, goal_status=AgentState.MOVING)
        team.states['a'].publish(moving)
        team.states['b'].publish(state_of('b', 20, goal_id=0))
        step.step = 20
        team.steps.publish(step)
        team.until(lambda: len(team.goals['b']) == 2)
        assert len(team.goals['a']) == 1


def test_other_robots_have_colours_of_the_team_and_wrong_destinations_are_dropped():
    with running(others={'aa': OtherRobotSettings(start=[0.2, 1.8, 0.0])}) as team:
        publisher = team.node.create_publisher(PointStamped, 'aa/destination', RELIABLE)
        team.until(lambda: publisher.get_subscription_count() == 1)
        cases = ({'point__x': math.nan}, {'header__frame_id': 'odom'})
        for number, changes in enumerate(cases, start=1):
            message = PointStamped()
            message.header.frame_id = 'map'
            publisher.publish(changed(message, changes))
            team.until(lambda number=number: team.tested.dropped['bad destination'] == number)
        assert team.tested.others.taken(0, None)[0][0].tolist() == [0.2, 1.8, 0.0]
        search = ActionClient(team.node, SearchTargets, 'search')
        team.until(search.server_is_ready)
        for limit in (math.nan, -1.0):
            answer = search.send_goal_async(SearchTargets.Goal(time_limit=limit))
            team.until(answer.done)
            assert not answer.result().accepted
        assert team.tested.dropped['bad goal'] == 2
        arrays = team.collect(MarkerArray, 'markers')
        team.begin()
        for step in (20, 40):
            team.tell(step)
        team.until(lambda: any(len(of_robots(array)) == len(ROBOTS) for array in arrays))
        for marker, index in zip(of_robots(arrays[-1]), (0, 2)):
            wanted, tint = colour_of(colours.ROBOTS[index]), marker.color
            assert (tint.r, tint.g, tint.b) == pytest.approx((wanted.r, wanted.g, wanted.b))


def of_robots(array):
    return [marker for marker in array.markers if marker.ns == 'robots']


# ---- the filter --------------------------------------------------------------------------------


def test_silence_is_that_of_heartbeats_and_of_the_oldest_open_batch():
    watch = FilterWatch(4.0)
    assert not watch.problem(1000.0)
    watch.beat = 10.0
    assert not watch.problem(13.9)
    assert watch.problem(14.1).endswith('4.1 s')
    # A planner that stood still itself blames nobody.
    watch.stalled(30.0)
    assert not watch.problem(43.9)
    watch = FilterWatch(4.0)
    watch.asked(1, 10.0)
    watch.asked(2, 13.0)
    assert 'batch 1' in watch.problem(14.1)
    watch.answered(1)
    assert not watch.problem(14.1)
    watch.asked(3, 14.0)
    watch.stalled(30.0)
    assert not watch.problem(46.9) and watch.problem(47.1)
    # Updates come in the order of batches: those before will not come any more.
    watch.answered(3)
    assert not watch.problem(100.0)
    never = FilterWatch(0.0)
    never.asked(1, 0.0)
    assert not never.problem(1e6)


@pytest.mark.parametrize(
    ('silent', 'planner'), [('updates', 'maasi'), ('heartbeat', 'mutual_information')]
)
def test_robots_are_held_until_the_filter_answers_again(silent, planner):
    # Long enough for a heartbeat of each second on a busy machine.
    with running(filter_timeout=4.0, planner=planner_settings(name=planner)) as team:
        beats = team.node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        beat = DiagnosticArray(status=[DiagnosticStatus(name='/team')])
        guard = team.tested.guard
        team.until(lambda: '/team' in guard.names and beats.get_subscription_count())
        team.begin()
        if silent == 'heartbeat':
            beats.publish(beat)
            team.answer()
        team.until(lambda: team.status() and team.status().level == DiagnosticStatus.ERROR)
        assert 'robots are held: no ' in team.status().message
        team.until(lambda: len(team.cancelled) == len(ROBOTS))
        decisions, batches = len(team.decisions), len(team.batches)
        for step in (40, 60):
            team.tell(step)
            team.until(lambda step=step: team.tested.planned_step == step)
        assert len(team.decisions) == decisions
        if silent == 'updates':
            # It is asked for again, so that a restarted filter can answer.
            team.until(lambda: len(team.batches) > batches)
            assert team.batches[-1] == team.batches[batches - 1]
        else:
            beats.publish(beat)
        team.answer()
        team.until(lambda: not team.tested.held)
        team.tell(80)
        team.until(lambda: len(team.decisions) > decisions)


def test_keep_outs_are_taken_by_service_published_and_checked(team):
    received = team.collect(KeepOuts, 'keep_outs', LATCHED)
    client = team.node.create_client(SetKeepOuts, 'search/keep_outs')
    team.until(client.service_is_ready)

    def ask(*zones):
        answer = client.call_async(SetKeepOuts.Request(zones=zones))
        team.until(answer.done)
        return answer.result()

    before = len(team.tested.coordinator.robots['a'].candidates.at([0.0, 0.0, 0.0]))
    wrong = ask('0.5 0.5')
    assert not wrong.success and "got '0.5 0.5', allowed are x y radius" in wrong.message
    assert not received
    assert ask('POLYGON ((0 0, 1 0, 1 1, 0 1, 0 0))', '0.2 0.2 0.1').success
    team.until(lambda: received)
    assert received[-1].version == 1 and len(received[-1].zones) == 2
    coordinator = team.tested.coordinator
    assert len(coordinator.robots['a'].candidates.at([0.0, 0.0, 0.0])) < before
    assert not coordinator.robots['a'].facts.motion.keep_out.is_free([0.5, 0.5, 0.0])
    assert ask().success
    team.until(lambda: received[-1].version == 2)
    assert not received[-1].zones and coordinator.area.region is None


def zones_of(team):
    return [str(zone) for zone in team.tested.coordinator.area.settings.keep_outs]


@pytest.mark.parametrize('version', [1, 5])
def test_keep_outs_of_before_a_restart_do_not_win_over_newer_ones(team, version):
    """Of a planner that started again the versions begin again; the filter has the old ones."""
    received = team.collect(KeepOuts, 'keep_outs', LATCHED_ALL)
    client = team.node.create_client(SetKeepOuts, 'search/keep_outs')
    team.until(client.service_is_ready)
    answer = client.call_async(SetKeepOuts.Request(zones=['0.2 0.2 0.1']))
    team.until(answer.done)
    filter_ = team.node.create_publisher(KeepOuts, 'keep_outs', LATCHED)
    team.until(lambda: filter_.get_subscription_count() == 2 and received)
    old = KeepOuts(version=version, zones=['0.9 0.9 0.1'])
    filter_.publish(old)
    team.until(lambda: received[-1].version == version + 1)
    assert list(received[-1].zones) == ['0.2 0.2 0.1'] == zones_of(team)
    # Another planner changes them later.
    new = KeepOuts(version=version + 2, zones=['0.8 0.8 0.1'])
    new.header.stamp = received[-1].header.stamp
    new.header.stamp.sec += 1
    filter_.publish(new)
    team.until(lambda: zones_of(team) == ['0.8 0.8 0.1'])
    team.until(lambda: received[-1].version == version + 2)


def test_found_targets_are_kept_for_a_filter_that_starts_again(team):
    kept = team.collect(FoundTargetArray, 'found_targets/kept', LATCHED)
    team.until(lambda: kept)
    assert kept[0].targets == []
    publisher = team.node.create_publisher(FoundTargetArray, 'found_targets', LATCHED)
    team.until(lambda: publisher.get_subscription_count())
    both = [FoundTarget(id=1), FoundTarget(id=2)]
    publisher.publish(FoundTargetArray(batch_id=7, targets=both))
    team.until(lambda: len(kept[-1].targets) == 2)
    refined = FoundTarget(id=2, measurement=5)
    publisher.publish(FoundTargetArray(batch_id=8, targets=[refined]))
    team.until(lambda: kept[-1].batch_id == 8)
    # The filter has withdrawn the other one.
    assert kept[-1].targets == [refined]
    # A filter that starts again without its state has withdrawn nothing.
    team.node.destroy_publisher(publisher)
    team.until(lambda: not team.tested.count_publishers('/found_targets'))
    publisher = team.node.create_publisher(FoundTargetArray, 'found_targets', LATCHED)
    team.until(lambda: publisher.get_subscription_count())
    for batch, targets, expected in (
        (9, [], [refined]),
        (10, [FoundTarget(id=3)], [refined, FoundTarget(id=3)]),
        (11, [refined], [refined]),
        (12, [], []),
    ):
        publisher.publish(FoundTargetArray(batch_id=batch, targets=targets))
        team.until(lambda batch=batch: kept[-1].batch_id == batch)
        assert kept[-1].targets == expected
