"""Hundreds of bad messages to every topic, service and action of every node, over DDS."""

import os
import signal
import time
from contextlib import contextmanager

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.srv import ChangeState, GetState
from message_corpus import Corpus, kind_of
from nav_msgs.msg import Odometry
from node_kinds import KINDS
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger
from waiting import PATIENCE, wait_until

from maasi_filter.ros.clocks import stamp_problem
from maasi_filter.ros.qos import RELIABLE, SENSOR_READER, UPDATES
from maasi_msgs.action import GoToWaypoint, SearchTargets
from maasi_msgs.msg import (
    AgentState,
    BatchMember,
    CuboidDecision,
    DetectionArray,
    FilterUpdate,
    LockstepDone,
    MeasurementBatch,
)
from maasi_sim.run.domain import Domain
from maasi_sim.run.processes import NodeProcess, find_executable, stop

ROUNDS = 24
# Of bad stamps per topic, at the end: the counters have to be exact.
BAD_STAMPS = 3
DRIVERS = ('turtlebot', 'mambo', 'ranging', 'mavlink')
NODES = ('filter', 'planner', 'cuboid_planner', 'guard', 'sim', 'cuboid_sim', *DRIVERS)
# Nobody plays their sensors at the end.
CHANGES = {kind: {'sensor_timeout': 0.0, 'odometry_timeout': 0.5} for kind in DRIVERS} | {
    'turtlebot': {'scan': {'timeout': 1e9}, 'sensor_timeout': 0.0, 'odometry_timeout': 0.5},
    'filter': {'batch_timeout': 0.2},
}


class World:
    """All nodes, each in a namespace and process of its own, and who sends them messages."""

    def __init__(self, context, folder):
        self.node = Node('corpus', context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.names, self.status, self.heard, self._publishers = {}, {}, {}, {}
        self.processes = {}
        for kind in NODES:
            made = KINDS[kind]
            namespace = f'/{kind}{made.namespace}'
            self.names[kind] = f'{namespace}/{made.name}'
            file = folder / f'{kind}.yaml'
            made.write(file, **CHANGES.get(kind, {}))
            package, executable = made.made.__module__.partition('.')[0], made.executable
            words = ['--ros-args', '--remap', f'__ns:={namespace}']
            self.processes[kind] = NodeProcess(
                kind,
                [str(find_executable(package, executable)), *words, '--params-file', str(file)],
                folder / f'{kind}.log',
                package,
            )
            self.processes[kind].start()
        self.folder = folder
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_status, 50)

    def _on_status(self, message):
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            self.status[status.name] = (status.message, values)

    def log(self, kind):
        return (self.folder / f'{kind}.log').read_text()[-4000:]

    def until(self, condition, what):
        wait_until(condition, self.turn, what)

    def turn(self):
        for kind, process in self.processes.items():
            if not process.running:
                pytest.fail(f'{kind} {process.how_it_ended()}:\n{self.log(kind)}')
        self.executor.spin_once(timeout_sec=0.05)

    def namespace(self, kind):
        return self.names[kind].rpartition('/')[0]

    def topics(self, kind):
        """Return the topics that a node subscribes to, with their types."""
        name = self.names[kind].rpartition('/')[2]
        found = self.node.get_subscriber_names_and_types_by_node(name, self.namespace(kind))
        return {topic: kinds[0] for topic, kinds in found if topic.startswith(f'/{kind}/')}

    def services(self, kind):
        name = self.names[kind].rpartition('/')[2]
        found = self.node.get_service_names_and_types_by_node(name, self.namespace(kind))
        return {service: kinds[0] for service, kinds in found}

    def publisher(self, topic, kind):
        """Return a publisher that fits who listens."""
        if topic not in self._publishers:
            wanted = self.node.get_subscriptions_info_by_topic(topic)[0].qos_profile
            quality = QoSProfile(
                history=HistoryPolicy.KEEP_ALL,
                depth=1,
                reliability=ReliabilityPolicy.RELIABLE,
                durability=wanted.durability,
                liveliness=wanted.liveliness,
                liveliness_lease_duration=wanted.liveliness_lease_duration,
            )
            made = self.node.create_publisher(kind, topic, quality)
            self._publishers[topic] = made
            self.until(lambda: made.get_subscription_count() > 0, f'nobody listens on {topic}')
        return self._publishers[topic]

    def listen(self, kind, topic, quality=RELIABLE):
        messages = self.heard.setdefault(topic, [])
        self.node.create_subscription(kind, topic, messages.append, quality)
        return messages

    def settle(self):
        """Wait until each node has worked off what came before: it answers twice."""
        clients = getattr(self, '_clients', None)
        if clients is None:
            clients = self._clients = {
                name: self.node.create_client(GetState, f'{name}/get_state')
                for name in self.names.values()
            }
        for _ in range(2):
            answers = {
                name: client.call_async(GetState.Request()) for name, client in clients.items()
            }
            self.until(
                lambda answers=answers: all(item.done() for item in answers.values()),
                f'no answer of {[n for n, item in answers.items() if not item.done()]}',
            )

    def hear_status(self):
        """Wait until each node has published its diagnostics twice, the second time from now on."""
        for _ in range(2):
            self.status.clear()
            self.until(
                lambda: self.status.keys() >= set(self.names.values()),
                lambda: f'no diagnostics of {set(self.names.values()) - self.status.keys()}',
            )

    def is_reliable(self, topic):
        """Return whether each message arrives; a topic that has one subscription."""
        (info,) = self.node.get_subscriptions_info_by_topic(topic)
        return info.qos_profile.reliability == ReliabilityPolicy.RELIABLE

    def bad_stamps(self, kind):
        return self.dropped(kind).get('dropped: bad stamp', 0)

    def dropped(self, kind):
        values = self.status[self.names[kind]][1]
        return {k: int(v) for k, v in values.items() if k.startswith('dropped: ')}


@contextmanager
def running(folder):
    with Domain() as domain:
        os.environ.update(domain.environment())
        context = Context()
        rclpy.init(
            context=context,
            domain_id=domain.number,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        world = World(context, folder)
        try:
            yield world
        finally:
            stop(list(world.processes.values()), [(signal.SIGKILL, PATIENCE)])
            world.executor.shutdown()
            world.node.destroy_node()
            rclpy.shutdown(context=context)


@pytest.fixture
def world(tmp_path, monkeypatch):
    for name in ('ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE'):
        monkeypatch.setenv(name, os.environ.get(name, ''))
    with running(tmp_path) as made:
        yield made


def frame_of(topic):
    return 'odom' if topic.endswith('/odom') else 'map'


def send_corpus(world, corpus):
    """Send messages to every topic, requests to every service; return how many."""
    for round_ in range(ROUNDS):
        stamp = (100, 50_000_000 * round_)
        for kind in NODES:
            for topic, type_name in sorted(world.topics(kind).items()):
                message = corpus.message(kind_of(type_name), frame_of(topic), stamp)
                world.publisher(topic, kind_of(type_name)).publish(message)
        if round_ % 4 == 3:
            send_requests(world, corpus, stamp)
            world.settle()


def send_requests(world, corpus, stamp):
    """Send a request to every service and action of every node, and wait for the answers."""
    waiting = {}
    for kind in NODES:
        for service, type_name in sorted(world.services(kind).items()):
            service_type = kind_of(type_name)
            if service_type is None or type_name == 'action_msgs/srv/CancelGoal':
                continue
            if not any(
                name != 'structure_needs_at_least_one_member'
                for name in service_type.Request.get_fields_and_field_types()
            ):
                continue
            if service.endswith('_action/get_result'):
                # Answered when the goal ends; of an unknown one at once.
                request = service_type.Request()
            else:
                request = corpus.message(service_type.Request, 'map', stamp)
            if 'SendGoal' in type_name:
                goal = type(request.goal)
                request.goal = corpus.message(goal, 'map', stamp)
                request.goal_id.uuid = list(os.urandom(16))
            if service_type is ChangeState:
                request.transition.id = 200
            key = f'client {service}'
            client = world.heard.get(key)
            if client is None:
                client = world.heard[key] = world.node.create_client(service_type, service)
            world.until(client.service_is_ready, f'no {service}')
            waiting[service] = client.call_async(request)
    world.until(
        lambda: all(item.done() for item in waiting.values()),
        f'no answer of {[name for name, item in waiting.items() if not item.done()]}',
    )


# ---- what the nodes are for ----------------------------------------------------------------


def use_driver(world, kind):
    """Odometry comes: the state is published, a goal is taken and the robot moves towards it."""
    space = world.namespace(kind)
    odometry = world.publisher(f'{space}/odom', Odometry)
    states = world.heard[f'{space}/state']
    commands = world.heard[f'{space}/cmd_vel']
    client = ActionClient(world.node, GoToWaypoint, f'{space}/go_to')
    world.until(client.server_is_ready, 'no go_to')
    clock = [time.monotonic()]
    count = [0]

    def move():
        if time.monotonic() - clock[0] < 0.05:
            return
        clock[0] = time.monotonic()
        count[0] += 1
        message = Odometry()
        message.header.frame_id = 'odom'
        stamp = 1000 * 10**9 + 50_000_000 * count[0]
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        message.pose.pose.orientation.w = 1.0
        message.pose.pose.position.x = 1e-6 * count[0]
        odometry.publish(message)

    world.until(
        lambda: move() or (states and states[-1].header.stamp.sec >= 1000), f'{kind}: no state'
    )
    # A goal under way from the corpus is replaced.
    goal = GoToWaypoint.Goal(goal_id=5)
    goal.waypoint.header.frame_id = 'map'
    position = goal.waypoint.pose.position
    if kind in ('ranging', 'mavlink'):
        position.x = position.y = position.z = 9.0
    else:
        position.x, position.y, position.z = 1.5, 1.5, states[-1].pose.pose.position.z
    answer = client.send_goal_async(goal)
    world.until(lambda: move() or answer.done(), f'{kind}: no answer to a goal')
    assert answer.result().accepted, f'{kind}: {states[-1].reason}'
    before = len(commands)

    def moves():
        move()
        return any(
            abs(c.twist.linear.x) + abs(c.twist.linear.y) + abs(c.twist.angular.z) > 0
            for c in commands[before:]
        )

    world.until(moves, f'{kind}: it does not move')


def use_filter(world):
    updates = world.heard['/filter/filter_update']
    batches = world.publisher('/filter/measurement_batch', MeasurementBatch)
    detections = world.publisher('/filter/rover/detections', DetectionArray)
    number = max((item.batch_id for item in updates), default=0) + 1
    batch = MeasurementBatch(id=number, step=7, members=[BatchMember(robot='rover')])
    batch.stamp.sec = 2000
    batches.publish(batch)
    answer = DetectionArray(batch_id=number, robot='rover')
    answer.header.frame_id = 'map'
    answer.header.stamp.sec = 2000
    answer.pose.pose.orientation.w = 1.0
    detections.publish(answer)
    world.until(lambda: any(u.batch_id == number and u.members for u in updates), 'no update')


def use_planner(world):
    """The robot says where it is: it is sent somewhere, or has to measure."""
    batches = world.heard['/planner/measurement_batch']
    states = world.publisher('/planner/rover/state', AgentState)
    client = ActionClient(world.node, SearchTargets, '/planner/search')
    world.until(client.server_is_ready, 'no search')
    name = world.names['planner']
    before = len(batches)
    step = [10_000]
    clock = [0.0]

    def tell():
        if time.monotonic() - clock[0] < 0.05:
            return
        clock[0] = time.monotonic()
        step[0] += 1
        state = AgentState(robot='rover', step=step[0])
        state.header.frame_id = 'map'
        state.header.stamp.sec = 500
        state.pose.pose.position.x = state.pose.pose.position.y = 0.5
        state.pose.pose.orientation.w = 1.0
        states.publish(state)

    def takes_part():
        return world.status[name][1]['robots'] == 'rover'

    # A search with no robot ends at once.
    world.until(lambda: tell() or takes_part(), 'the rover does not take part')
    client.send_goal_async(SearchTargets.Goal())
    world.until(
        lambda: tell() or len(batches) > before,
        lambda: f'the planner asks for nothing: {world.status[name]}\n{world.log("planner")}',
    )


def use_cuboid_planner(world):
    decisions = world.heard['/cuboid_planner/rover/decision']
    start = world.node.create_client(Trigger, '/cuboid_planner/rover/search/start')
    world.until(start.service_is_ready, 'no start')
    answer = start.call_async(Trigger.Request())
    world.until(answer.done, 'no answer to start')
    assert answer.result().success, answer.result().message
    odometry = world.publisher('/cuboid_planner/rover/odom', Odometry)
    step = [3000]
    clock = [0.0]

    def move():
        if time.monotonic() - clock[0] < 0.5:
            return
        clock[0] = time.monotonic()
        step[0] += 1
        seconds = step[0] * KINDS['cuboid_planner'].settings.step
        message = Odometry()
        nanoseconds = round(seconds * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        message.pose.pose.orientation.w = 1.0
        odometry.publish(message)

    world.until(lambda: move() or any(item.step >= 3000 for item in decisions), 'no decision')


def use_sim(world, kind):
    """All say that they are ready: time starts, and odometry comes."""
    ready = world.publisher(f'/{kind}/lockstep/ready', LockstepDone)
    # Those it waits for are in its diagnostics.
    waits = world.status[world.names[kind]][1]['waits for']
    odometry = world.heard[f'/{kind}/odom']
    for name in filter(None, waits.split(', ')):
        ready.publish(LockstepDone(node=name))
    world.until(lambda: len(odometry) > 3, f'{kind}: no odometry')


def test_no_message_ends_or_silences_a_node(world):
    world.until(
        lambda: all(
            world.status.get(name, ('',))[0].startswith('active') for name in world.names.values()
        ),
        f'not all are active: {sorted(world.status)}',
    )
    for kind in DRIVERS:
        world.listen(AgentState, f'{world.namespace(kind)}/state')
        world.listen(TwistStamped, f'{world.namespace(kind)}/cmd_vel', 50)
    world.listen(FilterUpdate, '/filter/filter_update', UPDATES)
    world.listen(MeasurementBatch, '/planner/measurement_batch')
    world.listen(CuboidDecision, '/cuboid_planner/rover/decision')
    zeros = world.listen(TwistStamped, '/guard/rover/cmd_vel', 50)
    for kind, robot in (('sim', 'mambo'), ('cuboid_sim', 'red')):
        messages = world.heard[f'/{kind}/odom'] = []
        world.node.create_subscription(
            Odometry, f'/{kind}/{robot}/odom', messages.append, SENSOR_READER
        )
    topics = {kind: world.topics(kind) for kind in NODES}
    assert all(topics.values()), topics

    corpus = Corpus(12)
    send_corpus(world, corpus)
    assert corpus.made >= 500

    # Each is alive (`until` looks), does its job, and has counted.
    world.settle()
    for kind in DRIVERS:
        use_driver(world, kind)
    use_filter(world)
    use_planner(world)
    use_cuboid_planner(world)
    use_sim(world, 'sim')
    use_sim(world, 'cuboid_sim')
    # The guard has heard a driver, which is gone now.
    known = len(zeros)
    topic = '/guard/rover/state'
    world.node.destroy_publisher(world._publishers.pop(topic))
    world.until(lambda: len(zeros) > known, 'the guard does not stop the robot')

    # Counters: as many as were sent; where messages may be lost, at most that.
    kinds = [kind for kind in NODES if kind not in ('sim', 'cuboid_sim', 'guard')]
    for kind in kinds:
        assert world.dropped(kind), f'{kind} has counted nothing'
    world.hear_status()
    before = {kind: world.bad_stamps(kind) for kind in kinds}
    reliable, best_effort = dict.fromkeys(kinds, 0), dict.fromkeys(kinds, 0)
    for _ in range(BAD_STAMPS):
        for kind in kinds:
            for topic, type_name in topics[kind].items():
                message = corpus.good(kind_of(type_name)(), frame_of(topic), (-5, 0))
                if stamp_problem(message) is not None:
                    world.publisher(topic, kind_of(type_name)).publish(message)
                    sent = reliable if world.is_reliable(topic) else best_effort
                    sent[kind] += 1
        # A queue may hold a single message.
        world.settle()
    counted = dict.fromkeys(kinds, 0)

    def all_counted():
        counted.update({kind: world.bad_stamps(kind) - before[kind] for kind in kinds})
        return all(counted[kind] >= max(reliable[kind], 1) for kind in kinds)

    world.until(all_counted, lambda: f'counted {counted}, sent {reliable} and {best_effort}')
    world.hear_status()
    all_counted()
    for kind in kinds:
        assert reliable[kind] <= counted[kind] <= reliable[kind] + best_effort[kind], kind
