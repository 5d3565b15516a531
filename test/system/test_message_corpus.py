"""Hundreds of bad messages to every topic, service and action of every node, over DDS."""

import array
import importlib
import math
import os
import time
from functools import partial

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from node_kinds import KINDS
from rclpy.action import ActionClient
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from scenario_runs import Operator, alongside
from sensor_msgs.msg import BatteryState, CameraInfo
from std_srvs.srv import Trigger
from waiting import wait_until

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
from maasi_sim.run.processes import NodeProcess

ROUNDS = 12
DRIVERS = ('turtlebot', 'mambo', 'camera', 'ranging', 'mavlink')
NODES = ('filter', 'planner', 'cuboid_planner', 'guard', 'sim', 'cuboid_sim', *DRIVERS)
# Nobody plays their sensors at the end.
CHANGES = {kind: {'sensor_timeout': 0.0, 'odometry_timeout': 0.5} for kind in DRIVERS} | {
    'turtlebot': {'scan': {'timeout': 1e9}, 'sensor_timeout': 0.0, 'odometry_timeout': 0.5},
    'mambo': {
        'camera': {'focal_length': [120.0, 120.0], 'detections': {}},
        'sensor_timeout': 0.0,
        'odometry_timeout': 0.5,
    },
    'filter': {'batch_timeout': 0.2},
}
# Values of fields by type, lengths of arrays, and stamps.
FLOATS = (math.nan, math.inf, -math.inf, 1e30, 5e-324, -0.0, -1.0, 0.5, 2.0, 361.0)
VALUES = {
    'float': FLOATS,
    'double': (*FLOATS, 1e308, -1e308),
    'boolean': (False, True),
    'octet': (b'\x00', b'\x01', b'\xff'),
    'string': ('', 'map', 'nobody', '/', 'rover', 'a' * 5000, '\u2603\n\x01', '../..', '{}'),
}
LENGTHS, BYTES = (0, 1, 2, 5, 7, 300), (0, 1, 1000, 100_000)
TIMES = ((-1, 0), (-(2**31), 0), (2**31 - 1, 999_999_999), (0, 2**32 - 1), (10**6, 5), (0, 0))
TIME = 'builtin_interfaces/Time'


def kind_of(name):
    """Return the class of a type such as `std_msgs/msg/Header`, or None."""
    package, space, short = name.split('/')
    module = importlib.import_module(f'{package}.{space}')
    if space != 'action':
        return getattr(module, short)
    action, _, service = short.rpartition('_')
    impl = getattr(module, action).Impl
    return {
        'SendGoal': impl.SendGoalService,
        'GetResult': impl.GetResultService,
        'FeedbackMessage': impl.FeedbackMessage,
    }.get(service)


def is_message(kind):
    """Return whether a field of this type is one message."""
    return '/' in kind and '[' not in kind and not kind.startswith('sequence')


class Corpus:
    """A seeded source of messages, made from their definitions."""

    def __init__(self, seed):
        self.random = np.random.default_rng(seed)

    def message(self, message, frame, stamp):
        """Return a message with one to three fields gone wrong."""
        self.good(message, frame, stamp)
        for _ in range(int(self.random.integers(1, 4))):
            self.spoil(message)
        return message

    def good(self, message, frame, stamp):
        """Fill in what makes a message acceptable."""
        for name, kind in message.get_fields_and_field_types().items():
            if name == 'header':
                message.header.frame_id = frame
                message.header.stamp.sec, message.header.stamp.nanosec = stamp
            elif kind == TIME and name == 'stamp':
                message.stamp.sec, message.stamp.nanosec = stamp
            elif name == 'robot' and kind.startswith('string'):
                message.robot = 'rover'
            elif kind == 'geometry_msgs/Quaternion':
                getattr(message, name).w = 1.0
            elif is_message(kind):
                self.good(getattr(message, name), frame, stamp)

    def spoil(self, message):
        """Put a wrong value into a field, or into one of a message in it."""
        fields = list(message.get_fields_and_field_types().items())
        if not fields:
            return
        name, kind = self.pick(fields)
        value = getattr(message, name)
        if kind == TIME:
            value.sec, value.nanosec = self.pick(TIMES)
        elif is_message(kind):
            self.spoil(value)
        elif kind.startswith('sequence<'):
            kind = kind.removeprefix('sequence<').rstrip('>').partition(',')[0]
            length = self.pick(BYTES if kind == 'uint8' else LENGTHS)
            setattr(message, name, self.values(kind, length))
        elif '[' in kind:
            kind, _, length = kind.rstrip(']').partition('[')
            setattr(message, name, self.values(kind, int(length)))
        else:
            setattr(message, name, self.value(kind))

    def values(self, kind, length):
        if kind == 'uint8':
            return array.array('B', self.random.bytes(length))
        return [self.value(kind) for _ in range(length)]

    def value(self, kind):
        if '/' in kind:
            made = kind_of(kind.replace('/', '/msg/'))()
            for _ in range(3):
                self.spoil(made)
            return made
        if 'int' in kind:
            bits = int(kind.lstrip('uint'))
            if kind.startswith('u'):
                return self.pick((0, 1, 2, 2**bits - 1, 2 ** (bits - 1), 2 ** (bits - 2)))
            return self.pick((0, 1, -1, 2 ** (bits - 1) - 1, -(2 ** (bits - 1))))
        return self.pick(VALUES[kind.partition('<')[0]])

    def pick(self, choices):
        return choices[int(self.random.integers(len(choices)))]


def stamped(message, seconds, frame='map'):
    message.header.frame_id, message.header.stamp = frame, stamp_to_ros(round(seconds * 1e9))
    return message


class World(Operator):
    """All nodes, each in its own namespace and process, and who sends them messages."""

    def __init__(self, folder, domain):
        super().__init__(domain)
        self.names, self.status, self.heard = {}, {}, {}
        self.publishers, self.clients, self.processes = {}, {}, {}
        for kind in NODES:
            made = KINDS[kind]
            namespace = f'/{kind}{made.namespace}'
            self.names[kind] = f'{namespace}/{made.name}'
            command = made.command(folder / f'{kind}.yaml', namespace, **CHANGES.get(kind, {}))
            process = NodeProcess(kind, command, folder / f'{kind}.log')
            process.start()
            self.processes[kind] = process
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self.on_status, 50)

    def on_status(self, message):
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            self.status[status.name] = (status.message, values)

    def until(self, condition, what):
        wait_until(condition, self.turn, what)

    def close(self):
        for process in self.processes.values():
            process.kill()
            process.join()
        super().close()

    def turn(self):
        for kind, process in self.processes.items():
            if not process.is_alive():
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

    def known(self, kind, what):
        look = getattr(self.node, f'get_{what}_names_and_types_by_node')
        found = look(self.names[kind].rpartition('/')[2], self.space(kind))
        return {name: kinds[0] for name, kinds in sorted(found) if name.startswith(f'/{kind}/')}

    def publish(self, topic, message):
        """Publish a message, in a way that fits who listens."""
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
            made = self.node.create_publisher(type(message), topic, quality)
            self.publishers[topic] = made
            self.until(lambda: made.get_subscription_count() > 0, f'nobody listens on {topic}')
        self.publishers[topic].publish(message)

    def listen(self, kind, topic, quality=RELIABLE):
        self.heard[topic] = []
        self.node.create_subscription(kind, topic, self.heard[topic].append, quality)

    def call(self, requests):
        """Ask until each has answered: an answer is lost to a client that is not discovered yet."""
        asked = {service: [] for service in requests}
        for service, (kind, _) in requests.items():
            if service not in self.clients:
                self.clients[service] = self.node.create_client(kind, service)
            self.until(self.clients[service].service_is_ready, f'no {service}')

        def silent():
            return [name for name, items in asked.items() if not any(i.done() for i in items)]

        def ask():
            for service in silent():
                asked[service].append(self.clients[service].call_async(requests[service][1]))

        self.play(ask, lambda: not silent(), lambda: f'no answer of {silent()}', period=5.0)
        return {name: next(i for i in items if i.done()).result() for name, items in asked.items()}

    def settle(self):
        """Wait until each node has worked off what came before: it answers twice."""
        ask = (GetState, GetState.Request())
        for _ in range(2):
            self.call({f'{name}/get_state': ask for name in self.names.values()})


@pytest.fixture
def world(tmp_path):
    with alongside(partial(World, tmp_path)) as made:
        yield made


def send_corpus(world, topics):
    corpus = Corpus(12)
    for round_ in range(ROUNDS):
        # Now and then all stamps are before zero.
        stamp = (100, 50_000_000 * round_) if round_ % 4 else (-5, 0)
        for topic, type_name in topics.items():
            frame = 'odom' if topic.endswith('/odom') else 'map'
            world.publish(topic, corpus.message(kind_of(type_name)(), frame, stamp))
        if round_ % 4 == 3:
            world.call(
                {
                    service: item
                    for kind in NODES
                    for service, type_name in world.known(kind, 'service').items()
                    if (item := bad_request(corpus, service, type_name, stamp)) is not None
                }
            )
            world.settle()


def bad_request(corpus, service, type_name, stamp):
    """Return type and request for a service; None where a request has nothing to spoil."""
    kind = kind_of(type_name)
    if kind is None or type_name == 'action_msgs/srv/CancelGoal':
        return None
    request = kind.Request()
    if not set(request.get_fields_and_field_types()) - {'structure_needs_at_least_one_member'}:
        return None
    # Answered when the goal ends; of an unknown one at once.
    if not service.endswith('_action/get_result'):
        corpus.message(request, 'map', stamp)
    if 'SendGoal' in type_name:
        corpus.message(request.goal, 'map', stamp)
        request.goal_id.uuid = list(os.urandom(16))
    if kind is ChangeState:
        request.transition.id = 200
    return kind, request


# ---- what the nodes are for ----------------------------------------------------------------


CAMERA = CameraInfo(
    width=320,
    height=240,
    distortion_model='plumb_bob',
    d=[0.0] * 5,
    k=[120.0, 0.0, 159.5, 0.0, 120.0, 119.5, 0.0, 0.0, 1.0],
)


def use_driver(world, kind):
    """Odometry comes: the state is published, a goal is taken and the robot moves towards it."""
    space = world.space(kind)
    states, commands = world.heard[f'{space}/state'], world.heard[f'{space}/cmd_vel']
    client = ActionClient(world.node, GoToWaypoint, f'{space}/go_to')
    message, count, answers = Odometry(), [0], []
    message.pose.pose.orientation.w = 1.0
    # A goal under way from the corpus is replaced.
    goal = GoToWaypoint.Goal(goal_id=5)
    goal.waypoint.header.frame_id = 'map'
    place = goal.waypoint.pose.position
    place.x = place.y = place.z = 9.0 if kind in ('ranging', 'mavlink') else 1.5

    def move():
        count[0] += 1
        # One of the corpus may be empty, which is a fault, as is a camera that is none.
        world.publish(f'{space}/battery_state', BatteryState(percentage=0.9))
        if world.node.count_subscribers(f'{space}/camera/camera_info'):
            world.publish(f'{space}/camera/camera_info', CAMERA)
        message.pose.pose.position.x = 1e-6 * count[0]
        world.publish(f'{space}/odom', stamped(message, 1000.0 + count[0] / 20.0, 'odom'))
        if not answers and states and states[-1].header.stamp.sec >= 1000:
            if kind not in ('ranging', 'mavlink'):
                place.z = states[-1].pose.pose.position.z
            commands.clear()
            answers.append(client.send_goal_async(goal))

    def moves():
        twists = [item.twist for item in commands]
        speeds = [abs(t.linear.x) + abs(t.linear.y) + abs(t.angular.z) for t in twists]
        return answers and answers[0].done() and answers[0].result().accepted and any(speeds)

    world.until(client.server_is_ready, 'no go_to')
    world.play(move, moves, lambda: f'{kind}: it does not move: {states[-1:]}, {commands[-1:]}')


def use_filter(world):
    updates = world.heard['/filter/filter_update']
    number = max((item.batch_id for item in updates), default=0) + 1
    batch = MeasurementBatch(id=number, step=7, members=[BatchMember(robot='rover')])
    batch.stamp.sec = 2000
    world.publish('/filter/measurement_batch', batch)
    answer = stamped(DetectionArray(batch_id=number, robot='rover'), 2000.0)
    answer.pose.pose.orientation.w = 1.0
    world.publish('/filter/rover/detections', answer)
    world.until(lambda: any(u.batch_id == number and u.members for u in updates), 'no update')


def use_planner(world):
    """The robot says where it is: it is sent somewhere, or has to measure."""
    name, batches = world.names['planner'], world.heard['/planner/measurement_batch']
    client = ActionClient(world.node, SearchTargets, '/planner/search')
    world.until(client.server_is_ready, 'no search')
    state = stamped(AgentState(robot='rover', step=10_000), 500.0)
    state.pose.pose.position.x = state.pose.pose.position.y = 0.5
    state.pose.pose.orientation.w = 1.0

    def tell():
        state.step += 1
        world.publish('/planner/rover/state', state)

    # A search with no robot ends at once.
    world.play(tell, lambda: world.status[name][1]['robots'] == 'rover', 'no rover takes part')
    batches.clear()
    client.send_goal_async(SearchTargets.Goal())
    world.play(tell, lambda: batches, lambda: f'it asks for nothing: {world.status[name]}')


def use_cuboid_planner(world):
    decisions = world.heard['/cuboid_planner/rover/decision']
    service = '/cuboid_planner/rover/search/start'
    answer = world.call({service: (Trigger, Trigger.Request())})[service]
    assert answer.success, answer.message
    message, step = Odometry(), [3000]
    message.pose.pose.orientation.w = 1.0

    def move():
        step[0] += 1
        seconds = step[0] * KINDS['cuboid_planner'].settings.step
        world.publish('/cuboid_planner/rover/odom', stamped(message, seconds, ''))

    world.play(
        move, lambda: any(item.step >= 3000 for item in decisions), 'no decision', period=0.5
    )


def use_sim(world, kind):
    """All that it waits for, as its diagnostics say, are ready: time starts, and odometry comes."""
    for name in filter(None, world.status[world.names[kind]][1]['waits for'].split(', ')):
        world.publish(f'/{kind}/lockstep/ready', LockstepDone(node=name))
    world.until(lambda: len(world.heard[f'/{kind}/odom']) > 3, f'{kind}: no odometry')


def use_guard(world):
    """The guard has heard a driver, which is gone now."""
    zeros = world.heard['/guard/rover/cmd_vel']
    zeros.clear()
    world.node.destroy_publisher(world.publishers.pop('/guard/rover/state'))
    world.until(lambda: zeros, 'the guard does not stop the robot')


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
        world.listen(Odometry, f'/{kind}/{robot}/odom', SENSOR_READER)
        world.heard[f'/{kind}/odom'] = world.heard[f'/{kind}/{robot}/odom']
    known = {}

    def discovered():
        known.update({kind: world.known(kind, 'subscriber') for kind in NODES})
        return all(known.values())

    world.until(discovered, lambda: f'subscriptions: {known}')
    topics = {name: kind for inner in known.values() for name, kind in inner.items()}
    assert ROUNDS * len(topics) >= 500
    send_corpus(world, topics)

    # Each is alive (`until` looks), does its job, and has counted what it dropped.
    world.settle()
    for kind in DRIVERS:
        use_driver(world, kind)
    use_filter(world)
    use_planner(world)
    use_cuboid_planner(world)
    use_sim(world, 'sim')
    use_sim(world, 'cuboid_sim')
    use_guard(world)
    for kind in NODES:
        if kind not in ('sim', 'cuboid_sim', 'guard'):
            counts = world.status[world.names[kind]][1]
            assert int(counts.get('dropped: bad stamp', 0)) > 0, (kind, counts)
