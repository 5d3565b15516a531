"""The recorder subscribes to all topics of a run, records them and takes part in lockstep."""

import contextlib
import math
import struct
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import cache
from operator import itemgetter
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from rcl_interfaces.msg import Log
from rclpy.client import Client
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from maasi_filter.ros.conversions import stamp_of_step, stamp_to_ros
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE, reader_of
from maasi_msgs.msg import LockstepDone, LockstepStep
from maasi_sim.run.bag import BagError, BagWriter, topic_qos
from maasi_sim.run.message_facts import is_read
from maasi_sim.run.mission import Observer
from maasi_sim.run.run_options import Options
from maasi_sim.run.topics import CLOCK, STEP, message_class, stamp_of, time_at, within

NAME = 'recorder'
READY, DONE = '/lockstep/ready', '/lockstep/done'
DIAGNOSTICS, ROSOUT = '/diagnostics', '/rosout'
_SHARED = (CLOCK, DIAGNOSTICS, ROSOUT)  # topics shared by all teams of a domain
_SKIPPED = ('/parameter_events', READY)  # not recorded: of no use to readers
_KEPT = '/found_targets/kept'  # copy of the found targets for a restarted filter
# Topics still recorded during the shutdown.
_MEASURED = '/detections'
_AT_THE_END = ('cmd_vel', 'rosout', 'diagnostics', 'transition_event')
# The clock may arrive later than messages of its time: by this long [s], in lockstep by this many
# steps. A larger lead belongs to another clock.
_LARGEST_LEAD, _MOST_STEPS = 1.0, 50
_ARMING_PERIOD = 2.0  # time between calls to take off [s]
_LAST_PATIENCE = 5.0  # longest wait for measurements that the last updates used [s]
_STOP_PATIENCE = 1.0  # longest wait for the acknowledgement of stop commands [s]
_ACKNOWLEDGED = Duration(seconds=0.1)  # wait before they are sent again


class Recorder:
    """Records serialised messages of all topics that it discovers.

    It has no executor: `drain` takes messages without callbacks, which costs a fifth. Without a
    bag it takes only what the observer needs. Topics of the observer are relative to the
    namespace `team`, which has no slashes at its ends.

    Subscribes
    ----------
    every topic with a publisher, with the quality of service of that publisher; where the team has
    a namespace, only those below it, `/clock`, and messages of its nodes on `/diagnostics` and
    `/rosout`;
    `lockstep/ready` (maasi_msgs/LockstepDone)

    Publishes
    ---------
    `lockstep/ready`, `lockstep/done` (maasi_msgs/LockstepDone);
    `<robot>/cmd_vel` (geometry_msgs/TwistStamped or Twist): zeros, when `stop_robots` is called

    Calls
    -----
    `<robot>/arm` (std_srvs/Trigger), when `arm` is called
    """

    def __init__(
        self,
        domain: int,
        observer: Observer,
        step_length: float,
        bag: BagWriter | None,
        options: Options | None = None,
    ) -> None:
        options = options or Options()
        team, lockstep = options.namespace, options.lockstep
        self.context = Context()
        rclpy.init(
            context=self.context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO
        )
        self.node = Node(
            NAME,
            namespace=f'/{team}',
            context=self.context,
            start_parameter_services=False,
            enable_rosout=False,
            use_global_arguments=False,
        )
        self.observer, self._step_length, self._lockstep = observer, step_length, lockstep
        self._lead = round(1e9 * max(_LARGEST_LEAD, _MOST_STEPS * step_length))
        self.bag, self._team = bag, team
        self.name = within(team, f'/{NAME}')
        self.time = 0
        # Of the first step [ns].
        self._begun: int | None = None
        self.step: int | None = None
        self.last_seen: dict[str, float] = {}
        #: Robots at the first step, and time of the first message of each recorded topic [ns].
        self.robots: list[str] = []
        self.first: dict[str, int] = {}
        self.explored = 0.0  #: explored share, published by planners each second
        self._faulty: set[str] = (
            set()
        )  # planners whose current error is already among the complaints
        #: Wall time of the last diagnostics of each node [s].
        self.heartbeats: dict[str, float] = {}
        self._arming: dict[str, Client] = {}
        self._armed_at = 0.0
        self._last_done: deque[bytes] = deque(maxlen=100)
        self.ready: set[str] = set()
        # Nodes that answered the newest reader of READY, and the number of others at that time.
        self._answered: set[str] = set()
        self._asked_with = 0
        self._finished = False
        self._last_step = -1
        # Time of the end of the search [ns].
        self._end: float = math.inf
        self._complaints: list[str] = []
        #: Called with topic, type and content of each message that a page shows.
        self.listener: Callable[[str, str, bytes], None] | None = None
        self._shown: dict[str, str] = {}
        self._wanted = {*observer.topics, CLOCK, DONE, DIAGNOSTICS}
        # Read separately, in this order.
        self._in_order = {*observer.update_topics, STEP, CLOCK}
        self._subscriptions: dict[str, Subscription] = {}
        self._refused: set[str] = set()
        self._ready_subscription = self._subscribe(READY, LockstepDone, LATCHED_ALL)
        self._ready_publisher = self.node.create_publisher(
            LockstepDone, within(team, READY), LATCHED
        )
        self._done_publisher = self.node.create_publisher(
            LockstepDone, within(team, DONE), RELIABLE
        )

    def _subscribe(self, topic: str, kind: type, qos: QoSProfile) -> Subscription:
        # Messages are received without callbacks.
        full = self._full(topic)
        return self.node.create_subscription(kind, full, lambda _: None, qos, raw=True)

    def _full(self, topic: str) -> str:
        return topic if topic in _SHARED else within(self._team, topic)

    def relative(self, topic: str) -> str | None:
        """Return the name of a topic or node within the team, or None outside of it."""
        if not self._team or topic in _SHARED:
            return topic
        inner = topic.removeprefix(f'/{self._team}')
        return None if inner == topic or inner[0] != '/' or inner in _SHARED else inner

    def discover(self) -> None:
        """Subscribe to the topics that have appeared since the last call."""
        for full, types in self.node.get_topic_names_and_types():
            topic = self.relative(full)
            if topic is None or topic in self._subscriptions or topic in self._refused:
                continue
            shown = self.listener is not None and is_read(topic, types[0])
            # An underscore in front hides a name: internal topics of actions.
            useless = topic in _SKIPPED or '/_' in topic or topic.endswith(_KEPT)
            wanted = not useless and (self.bag is not None or topic in self._wanted)
            if not (wanted or shown):
                continue
            infos = self.node.get_publishers_info_by_topic(full)
            if not infos:
                continue
            qos = reader_of([info.qos_profile for info in infos])
            try:
                kind = message_class(types[0])
                if self.bag is not None:
                    reliable = qos.reliability == ReliabilityPolicy.RELIABLE
                    latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
                    self.bag.add_topic(full, types[0], topic_qos(reliable, latched))
            except (ImportError, AttributeError, BagError) as error:
                self._refused.add(topic)
                self._complaints.append(f'topic {full} cannot be recorded: {error}')
                continue
            self._subscriptions[topic] = self._subscribe(topic, kind, qos)
            if shown:
                self._shown[topic] = types[0]

    def subscribed(self, topic: str) -> bool:
        """Return whether a topic has been discovered and is received."""
        return topic in self._subscriptions

    def unmatched(self) -> list[str]:
        """Return the topics with a publisher that is known but not connected yet."""
        return [
            full
            for topic, subscription in self._subscriptions.items()
            if subscription.handle.get_publisher_count()
            < self.node.count_publishers(full := self._full(topic))
        ]

    def receive_ready(self) -> set[str]:
        """Return the names of the nodes that have reported ready."""
        for data in _queued(self._ready_subscription):
            name = deserialize_message(data, LockstepDone).node
            self._answered.add(name)
            self.ready.add(name)
        return self.ready

    def unanswered(self, nodes: Collection[str]) -> list[str]:
        """Return the nodes that may not send to all subscriptions of the recorder yet.

        A connected publisher may not know the recorder yet and drop its messages. Nodes
        discover subscriptions in the order of their creation: a node that answers a new
        subscription with its latched ready report knows all earlier ones.
        """
        if self._asked_with != len(self._subscriptions):
            self._asked_with = len(self._subscriptions)
            self._answered = set()
            self.node.destroy_subscription(self._ready_subscription)
            self._ready_subscription = self._subscribe(READY, LockstepDone, LATCHED_ALL)
        self.receive_ready()
        return [name for name in nodes if name not in self._answered]

    def pop_heartbeats(self) -> dict[str, float]:
        """Return the wall times of diagnostics of nodes since the last call [s]."""
        beats, self.heartbeats = self.heartbeats, {}
        return beats

    def pop_complaints(self) -> list[str]:
        """Return problems of recording, messages and planners since the last call."""
        complaints = self._complaints + self.observer.complaints
        self._complaints, self.observer.complaints = [], []
        return complaints

    def publish_ready(self) -> None:
        """Report that the recorder is ready."""
        self._ready_publisher.publish(LockstepDone(node=self.name, step=0))

    def publish_done(self, step: int) -> None:
        """Report that the recorder has finished a step."""
        self._done_publisher.publish(LockstepDone(node=self.name, step=step))

    def drain(self, limit: int | None = None) -> None:
        """Pass all received messages to the observer and the recording.

        Messages later than `limit`, the simulated time after the first step [ns], are
        dropped, so that equal runs give equal recordings.
        """
        self.receive_ready()
        # In lockstep a message may arrive after others that were published later.
        before = 0 if self._lockstep else self.time
        # Updates come after the messages they refer to: receive updates first, add them last.
        updates = self._receive(self.observer.update_topics)
        steps = self._receive([STEP])
        for _, data in steps:
            self.step = struct.unpack_from('<Q', data, 4)[0]
            self.time = max(self.time, time_at(data, 12))
            if self._begun is None:
                self._begun = time_at(data, 12)
                self.robots = deserialize_message(data, LockstepStep).robots
        clocks = self._receive([CLOCK])
        for _, data in clocks:
            self.time = max(self.time, time_at(data, 4))
        topics = [topic for topic in self._subscriptions if topic not in self._in_order]
        # Detections refer to images of the same stamp.
        topics.sort(key=lambda topic: topic.endswith(_MEASURED))
        others = [item for item in self._receive(topics) if self._is_own(*item)]
        if limit is not None and self.step is not None and not self._finished:
            # Messages of the step at the limit may arrive before that step.
            end, length = limit + (self._begun or 0), self._step_length
            if stamp_of_step(self.step + 1, length) >= end:
                self._last_step = self.step
                while self._last_step and stamp_of_step(self._last_step, length) >= end:
                    self._last_step -= 1
                self._end = stamp_of_step(self._last_step + 1, length)
        # Several steps may arrive at once: sort by time.
        received = [
            (self._logged(before, topic, data), topic, data)
            for topic, data in clocks + others + updates + steps
            if topic.endswith(_MEASURED) or self._belongs(topic, data)
        ]
        received.sort(key=itemgetter(0))
        now = time.monotonic()
        for _, topic, data in received:
            self.last_seen[topic] = now
            if topic == DONE:
                self._last_done.append(data)
            elif topic == DIAGNOSTICS:
                for status in deserialize_message(data, DiagnosticArray).status:
                    self.heartbeats[status.name] = now
                    self._note_planner(status)
            # Also those of the last step that arrive after the end.
            self.observer.add(topic, data)
            # Only the observer needs measurements of later steps.
            later = topic.endswith(_MEASURED) and not self._belongs(topic, data)
            if self.listener is not None and topic in self._shown and not later:
                self.listener(topic, self._shown[topic], data)
        self.observer.settle()
        if self.observer.end_step is not None and not self._finished:
            self._last_step = self.observer.end_step
            self._end = stamp_of_step(self._last_step, self._step_length)
        if self._last_step >= 0:
            received = [item for item in received if self._belongs(*item[1:])]
        self._record(received)

    def _logged(self, before: int, topic: str, data: bytes) -> int:
        """Return a message's recorded time [ns]: now, if its stamp is implausible."""
        stamp = stamp_of(topic, self._subscriptions[topic].msg_type, data)
        known = 0 <= stamp <= self.time + self._lead
        return max(stamp, before) if known else self.time

    def _note_planner(self, status: DiagnosticStatus) -> None:
        if not status.name.endswith('/planner_node'):
            return
        if status.level != DiagnosticStatus.ERROR:
            self._faulty.discard(status.name)
        elif status.name not in self._faulty:
            self._faulty.add(status.name)
            self._complaints.append(f'{status.name}: {status.message}')
        for item in status.values:
            if item.key == 'explored':
                with contextlib.suppress(ValueError):
                    self.explored = max(self.explored, float(item.value))

    @property
    def elapsed(self) -> float:
        """Simulated time since the first step, up to the end of the search [s]."""
        return 0.0 if self._begun is None else (min(self.time, self._end) - self._begun) / 1e9

    def _is_own(self, topic: str, data: bytes) -> bool:
        if self._team and topic == DIAGNOSTICS:
            names = [item.name for item in deserialize_message(data, DiagnosticArray).status]
            return any(name.startswith(f'/{self._team}/') for name in names)
        if self._team and topic == ROSOUT:
            logger = f'{self._team.replace("/", ".")}.'
            return bool(deserialize_message(data, Log).name.startswith(logger))
        return True

    def _record(self, received: list[tuple[int, str, bytes]]) -> None:
        # A failed bag ends the run (`bag.failed`).
        if self.bag is None or self.bag.failed:
            return
        try:
            for logged, topic, data in received:
                self.bag.write(self._full(topic), logged, data)
                self.first.setdefault(topic, logged)
        except BagError:
            if not self.bag.failed:
                raise

    def gaps(self, joined: bool, patience: float) -> list[str]:
        """Return the topics of every step that are missing, or late by more than `patience` [s]."""
        topics = [STEP, *(f'/{name}/state' for name in self.robots)]
        times = [self.first.get(topic, self.time) for topic in topics]
        # Robots that another program moves may exist long before the first step.
        begin = times[0] if joined else 0
        gaps = []
        for topic, time_ in zip(topics, times):
            missed = (time_ - begin) * 1e-9
            # Without a step the robots and the begin are unknown.
            if topic not in self.first and (topic == STEP or missed > patience):
                gaps.append(f'the recording lacks {topic}')
            elif missed > patience:
                gaps.append(f'the recording lacks the first {missed:.1f} s of {topic}')
        lacking = self.observer.lacking(self._last_step)
        return gaps + [f'the recording lacks {what}, used by an update' for what in lacking]

    def finish(self) -> None:
        """Keep only messages of the steps so far, what updates used, and the shutdown.

        Waits for measurements that updates used but that have not arrived.
        """
        if self._last_step < 0 and self.step is not None:
            self._last_step = self.step
        deadline = time.monotonic() + _LAST_PATIENCE
        while self.observer.lacking(self._last_step) and time.monotonic() < deadline:
            time.sleep(0.01)
            self.drain()
        self._finished = True

    def _belongs(self, topic: str, data: bytes) -> bool:
        if self._last_step < 0:
            return True
        kind = self._subscriptions[topic].msg_type
        if self._finished and topic.rpartition('/')[2] in _AT_THE_END:
            return True
        # A robot may answer the last batch with an image of a later step.
        if self.observer.rests_on(topic, data, self._last_step):
            return True
        if stamp_of(topic, kind, data) > stamp_of_step(self._last_step, self._step_length):
            return False
        return not _has_step(kind) or deserialize_message(data, kind).step <= self._last_step

    def _receive(self, topics: Sequence[str]) -> list[tuple[str, bytes]]:
        return [
            (topic, data)
            for topic in topics
            if topic in self._subscriptions
            for data in _queued(self._subscriptions[topic])
        ]

    def done_steps(self) -> dict[str, int]:
        """Return the last step that each node has recently reported done."""
        steps: dict[str, int] = {}
        for data in self._last_done:
            message = deserialize_message(data, LockstepDone)
            steps[message.node] = max(message.step, steps.get(message.node, 0))
        return steps

    def arm(self, robots: Iterable[str]) -> None:
        """Repeatedly call the service `arm` of drivers that are not ready."""
        if time.monotonic() - self._armed_at < _ARMING_PERIOD:
            return
        self._armed_at = time.monotonic()
        for name in robots:
            if self._full(f'/{name}/driver') in self.ready:
                continue
            if name not in self._arming:
                service = self._full(f'/{name}/arm')
                self._arming[name] = self.node.create_client(Trigger, service)
            if self._arming[name].service_is_ready():
                self._arming[name].call_async(Trigger.Request())

    def stop_robots(self, names: Collection[str]) -> None:
        """Publish zero on `cmd_vel` of robots that subscribe to it; wait for acknowledgements."""
        types = dict(self.node.get_topic_names_and_types())
        publishers: list[Any] = []
        for topic in (self._full(f'/{name}/cmd_vel') for name in names):
            if self.node.count_subscribers(topic):
                plain = types[topic] == ['geometry_msgs/msg/Twist']
                chosen = Twist if plain else TwistStamped
                publishers.append(self.node.create_publisher(chosen, topic, RELIABLE))
        deadline = time.monotonic() + _STOP_PATIENCE
        while time.monotonic() < deadline and any(
            publisher.get_subscription_count() < self.node.count_subscribers(publisher.topic)
            for publisher in publishers
        ):
            time.sleep(0.005)
        messages = [(publisher, publisher.msg_type()) for publisher in publishers]
        for publisher, message in messages:
            if isinstance(message, TwistStamped):
                message.header.stamp = stamp_to_ros(self.time)
            publisher.publish(message)
        for publisher, message in messages:
            # A lost message is repeated only after seconds; a new one triggers the repetition.
            while not publisher.wait_for_all_acked(_ACKNOWLEDGED) and time.monotonic() < deadline:
                publisher.publish(message)
            self.node.destroy_publisher(publisher)

    def close(self) -> None:
        """Destroy the node."""
        if self.context.ok():
            self.node.destroy_node()
            rclpy.shutdown(context=self.context)


@cache
def _has_step(kind: Any) -> bool:
    # In other messages this field is different: the row length of an image.
    return kind.__module__.startswith('maasi_msgs.') and 'step' in kind.get_fields_and_field_types()


def _queued(subscription: Subscription) -> list[bytes]:
    received: list[bytes] = []
    handle = subscription.handle
    while True:
        item = handle.take_message(subscription.msg_type, True)
        if item is None:
            return received
        received.append(item[0])
