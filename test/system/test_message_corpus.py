"""Hundreds of bad messages to every topic, service and action of every node, over DDS."""

import os
import signal
import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.srv import ChangeState, GetState
from message_corpus import Corpus, kind_of
from nav_msgs.msg import Odometry
from node_kinds import KINDS
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger
from waiting import PATIENCE, wait_until

from maasi_filter.ros.clocks import stamp_problem
from maasi_filter.ros.conversions import stamp_to_ros
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
from maasi_sim.run.processes import NodeProcess, find_executable, stop

ROUNDS = 24
DRIVERS = ('turtlebot', 'mambo', 'ranging', 'mavlink')
NODES = ('filter', 'planner', 'cuboid_planner', 'guard', 'sim', 'cuboid_sim', *DRIVERS)
# Nobody plays their sensors at the end.
CHANGES = {kind: {'sensor_timeout': 0.0, 'odometry_timeout': 0.5} for kind in DRIVERS} | {
    'turtlebot': {'scan': {'timeout': 1e9}, 'sensor_timeout': 0.0, 'odometry_timeout': 0.5},
    'filter': {'batch_timeout': 0.2},
}
SECOND = 10**9


def frame_of(topic):
    return 'odom' if topic.endswith('/odom') else 'map'


def stamped(message, nanoseconds, frame='map'):
    message.header.frame_id, message.header.stamp = frame, stamp_to_ros(nanoseconds)
    return message


class World:
    """All nodes, each in a namespace and process of its own, and who sends them messages."""

    def __init__(self, context, folder):
        self.node = Node('corpus', context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.names, self.status, self.heard = {}, {}, {}
        self.publishers, self.clients, self.processes = {}, {}, {}
        for kind in NODES:
            made = KINDS[kind]
            namespace = f'/{kind}{made.namespace}'
            self.names[kind] = f'{namespace}/{made.name}'
            file = folder / f'{kind}.yaml'
            made.write(file, **CHANGES.get(kind, {}))
            package, executable = made.made.__module__.partition('.')[0], made.executable
            words = ['--ros-args', '--remap', f'__ns:={namespace}', '--params-file', str(file)]
            command = [str(find_executable(package, executable)), *words]
            process = NodeProcess(kind, command, folder / f'{kind}.log', package)
            process.start()
            self.processes[kind] = process
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self.on_status, 50)

    def on_status(self, message):
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            self.status[status.name] = (status.message, values)

    def until(self, condition, what):
        wait_until(condition, self.turn, what)

    def turn(self):
        for kind, process in self.processes.items():
            if not process.running:
                pytest.fail(f'{kind} {process.how_it_ended()}:\n{process.last_words(40)}')
        self.executor.spin_once(timeout_sec=0.05)

    def play(self, act, condition, what, period=0.05):
        """Act once in a period until a condition is true."""
        last = [0.0]

        def turn():
            if time.monotonic() - last[0] >= period:
                last[0] = time.monotonic()
                act()
            return condition()

        self.until(turn, what)

    def space(self, kind):
        return self.names[kind].rpartition('/')[0]

    def topics(self, kind):
        """Return the topics that a node subscribes to, with their types."""
        name = self.names[kind].rpartition('/')[2]
        found = self.node.get_subscriber_names_and_types_by_node(name, self.space(kind))
        return {topic: kinds[0] for topic, kinds in sorted(found) if topic.startswith(f'/{kind}/')}

    def services(self, kind):
        name = self.names[kind].rpartition('/')[2]
        found = self.node.get_service_names_and_types_by_node(name, self.space(kind))
        return {service: kinds[0] for service, kinds in sorted(found)}

    def publisher(self, topic, kind):
        """Return a publisher that fits who listens."""
        if topic not in self.publishers:
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
            self.publishers[topic] = made
            self.until(lambda: made.get_subscription_count() > 0, f'nobody listens on {topic}')
        return self.publishers[topic]

    def listen(self, kind, topic, quality=RELIABLE):
        messages = self.heard.setdefault(topic, [])
        self.node.create_subscription(kind, topic, messages.append, quality)
        return messages

    def call(self, requests):
        """Send requests, service to type and request, and wait for all answers."""
        waiting = {}
        for service, (kind, request) in requests.items():
            if service not in self.clients:
                self.clients[service] = self.node.create_client(kind, service)
            client = self.clients[service]
            self.until(client.service_is_ready, f'no {service}')
            waiting[service] = client.call_async(request)
        self.until(
            lambda: all(item.done() for item in waiting.values()),
            lambda: f'no answer of {[name for name, item in waiting.items() if not item.done()]}',
        )
        return {service: item.result() for service, item in waiting.items()}

    def settle(self):
        """Wait until each node has worked off what came before: it answers twice."""
        ask = (GetState, GetState.Request())
        for _ in range(2):
            self.call({f'{name}/get_state': ask for name in self.names.values()})

    def dropped(self, kind):
        values = self.status[self.names[kind]][1]
        return {k: int(v) for k, v in values.items() if k.startswith('dropped: ')}

    def bad_stamps(self, kind):
        return self.dropped(kind).get('dropped: bad stamp', 0)


@pytest.fixture
def world(context, tmp_path):
    made = World(context, tmp_path)
    yield made
    stop(list(made.processes.values()), [(signal.SIGKILL, PATIENCE)])
    made.executor.shutdown()
    made.node.destroy_node()


def send_corpus(world, corpus):
    """Send messages to every topic, requests to every service and action."""
    for round_ in range(ROUNDS):
        stamp = (100, 50_000_000 * round_)
        for kind in NODES:
            for topic, type_name in world.topics(kind).items():
                message = corpus.message(kind_of(type_name), frame_of(topic), stamp)
                world.publisher(topic, kind_of(type_name)).publish(message)
        if round_ % 4 == 3:
            world.call(
                {
                    service: item
                    for kind in NODES
                    for service, type_name in world.services(kind).items()
                    if (item := bad_request(corpus, service, type_name, stamp)) is not None
                }
            )
            world.settle()


def bad_request(corpus, service, type_name, stamp):
    """Return type and request for a service; None where a request has nothing to spoil."""
    kind = kind_of(type_name)
    if kind is None or type_name == 'action_msgs/srv/CancelGoal':
        return None
    fields = kind.Request.get_fields_and_field_types()
    if not set(fields) - {'structure_needs_at_least_one_member'}:
        return None
    # Answered when the goal ends; of an unknown one at once.
    unknown = service.endswith('_action/get_result')
    request = kind.Request() if unknown else corpus.message(kind.Request, 'map', stamp)
    if 'SendGoal' in type_name:
        request.goal = corpus.message(type(request.goal), 'map', stamp)
        request.goal_id.uuid = list(os.urandom(16))
    if kind is ChangeState:
        request.transition.id = 200
    return kind, request


# ---- what the nodes are for ----------------------------------------------------------------


def use_driver(world, kind):
    """Odometry comes: the state is published, a goal is taken and the robot moves towards it."""
    space = world.space(kind)
    odometry = world.publisher(f'{space}/odom', Odometry)
    states, commands = world.heard[f'{space}/state'], world.heard[f'{space}/cmd_vel']
    client = ActionClient(world.node, GoToWaypoint, f'{space}/go_to')
    world.until(client.server_is_ready, 'no go_to')
    message = Odometry()
    message.pose.pose.orientation.w = 1.0
    count = [0]

    def move():
        count[0] += 1
        message.pose.pose.position.x = 1e-6 * count[0]
        odometry.publish(stamped(message, 1000 * SECOND + count[0] * SECOND // 20, 'odom'))

    world.play(move, lambda: states and states[-1].header.stamp.sec >= 1000, f'{kind}: no state')
    # A goal under way from the corpus is replaced.
    goal = GoToWaypoint.Goal(goal_id=5)
    goal.waypoint.header.frame_id = 'map'
    position = goal.waypoint.pose.position
    if kind in ('ranging', 'mavlink'):
        position.x = position.y = position.z = 9.0
    else:
        position.x, position.y, position.z = 1.5, 1.5, states[-1].pose.pose.position.z
    answer = client.send_goal_async(goal)
    world.play(move, answer.done, f'{kind}: no answer to a goal')
    assert answer.result().accepted, f'{kind}: {states[-1].reason}'
    twists = [item.twist for item in commands]
    commands.clear()
    world.play(
        move,
        lambda: any(
            abs(t.linear.x) + abs(t.linear.y) + abs(t.angular.z) > 0
            for t in (item.twist for item in commands)
        ),
        lambda: f'{kind}: it does not move: {twists[-1:]}',
    )


def use_filter(world):
    updates = world.heard['/filter/filter_update']
    number = max((item.batch_id for item in updates), default=0) + 1
    batch = MeasurementBatch(id=number, step=7, members=[BatchMember(robot='rover')])
    batch.stamp.sec = 2000
    world.publisher('/filter/measurement_batch', MeasurementBatch).publish(batch)
    answer = stamped(DetectionArray(batch_id=number, robot='rover'), 2000 * SECOND)
    answer.pose.pose.orientation.w = 1.0
    world.publisher('/filter/rover/detections', DetectionArray).publish(answer)
    world.until(lambda: any(u.batch_id == number and u.members for u in updates), 'no update')


def use_planner(world):
    """The robot says where it is: it is sent somewhere, or has to measure."""
    batches = world.heard['/planner/measurement_batch']
    states = world.publisher('/planner/rover/state', AgentState)
    client = ActionClient(world.node, SearchTargets, '/planner/search')
    world.until(client.server_is_ready, 'no search')
    name, before = world.names['planner'], len(batches)
    state = stamped(AgentState(robot='rover', step=10_000), 500 * SECOND)
    state.pose.pose.position.x = state.pose.pose.position.y = 0.5
    state.pose.pose.orientation.w = 1.0

    def tell():
        state.step += 1
        states.publish(state)

    # A search with no robot ends at once.
    world.play(
        tell, lambda: world.status[name][1]['robots'] == 'rover', 'the rover does not take part'
    )
    client.send_goal_async(SearchTargets.Goal())
    world.play(
        tell,
        lambda: len(batches) > before,
        lambda: f'the planner asks for nothing: {world.status[name]}',
    )


def use_cuboid_planner(world):
    decisions = world.heard['/cuboid_planner/rover/decision']
    service = '/cuboid_planner/rover/search/start'
    answer = world.call({service: (Trigger, Trigger.Request())})[service]
    assert answer.success, answer.message
    odometry = world.publisher('/cuboid_planner/rover/odom', Odometry)
    length = round(KINDS['cuboid_planner'].settings.step * 1e9)
    message, step = Odometry(), [3000]
    message.pose.pose.orientation.w = 1.0

    def move():
        step[0] += 1
        odometry.publish(stamped(message, step[0] * length, ''))

    world.play(
        move, lambda: any(item.step >= 3000 for item in decisions), 'no decision', period=0.5
    )


def use_sim(world, kind):
    """All say that they are ready: time starts, and odometry comes."""
    ready = world.publisher(f'/{kind}/lockstep/ready', LockstepDone)
    # Those it waits for are in its diagnostics.
    for name in filter(None, world.status[world.names[kind]][1]['waits for'].split(', ')):
        ready.publish(LockstepDone(node=name))
    odometry = world.heard[f'/{kind}/odom']
    world.until(lambda: len(odometry) > 3, f'{kind}: no odometry')


def use_guard(world):
    """The guard has heard a driver, which is gone now."""
    zeros = world.heard['/guard/rover/cmd_vel']
    known = len(zeros)
    world.node.destroy_publisher(world.publishers.pop('/guard/rover/state'))
    world.until(lambda: len(zeros) > known, 'the guard does not stop the robot')


def test_no_message_ends_or_silences_a_node(world):
    world.until(
        lambda: all(
            world.status.get(name, ('',))[0].startswith('active') for name in world.names.values()
        ),
        lambda: f'not all are active: {sorted(world.status)}',
    )
    for kind in DRIVERS:
        world.listen(AgentState, f'{world.space(kind)}/state')
        world.listen(TwistStamped, f'{world.space(kind)}/cmd_vel', 50)
    world.listen(FilterUpdate, '/filter/filter_update', UPDATES)
    world.listen(MeasurementBatch, '/planner/measurement_batch')
    world.listen(CuboidDecision, '/cuboid_planner/rover/decision')
    world.listen(TwistStamped, '/guard/rover/cmd_vel', 50)
    for kind, robot in (('sim', 'mambo'), ('cuboid_sim', 'red')):
        world.heard[f'/{kind}/odom'] = world.listen(
            Odometry, f'/{kind}/{robot}/odom', SENSOR_READER
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
    use_guard(world)

    # Each counts what it drops: messages with a stamp before zero, of which some may be lost.
    kinds = [kind for kind in NODES if kind not in ('sim', 'cuboid_sim', 'guard')]
    for kind in kinds:
        assert world.dropped(kind), f'{kind} has counted nothing'
    bad = {
        kind: [
            (topic, message)
            for topic, type_name in topics[kind].items()
            if stamp_problem(message := corpus.good(kind_of(type_name)(), frame_of(topic), (-5, 0)))
            is not None
        ]
        for kind in kinds
    }
    world.settle()
    before = {kind: world.bad_stamps(kind) for kind in kinds}

    def send():
        for topic, message in (item for items in bad.values() for item in items):
            world.publisher(topic, type(message)).publish(message)

    def counted():
        return all(world.bad_stamps(kind) > before[kind] for kind in kinds)

    world.play(send, counted, lambda: f'not counted: {before}', period=1.0)
