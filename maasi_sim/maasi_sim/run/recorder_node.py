"""The recorder: subscribes to all topics of a run, records them, and takes part in lockstep."""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Sequence
from functools import cache
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from rcl_interfaces.msg import Log
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

from maasi_filter.ros.conversions import stamp_of_step
from maasi_filter.ros.qos import LATCHED, LATCHED_ALL, RELIABLE, reader_of
from maasi_msgs.msg import LockstepDone, LockstepStep
from maasi_sim.run.bag import BagError, BagWriter, topic_qos
from maasi_sim.run.mission import Observer
from maasi_sim.run.topics import CLOCK, STEP, message_class, stamp_of, time_at, within
from maasi_sim.view.messages import is_shown

NAME = 'recorder'
READY, DONE = '/lockstep/ready', '/lockstep/done'
DIAGNOSTICS, ROSOUT = '/diagnostics', '/rosout'
# Topics shared by all teams of a domain.
_SHARED = (CLOCK, DIAGNOSTICS, ROSOUT)
# Not recorded: of no use to readers of the recording.
_SKIPPED = ('/parameter_events', READY)
# A copy of the found targets for a restarted filter.
_KEPT = '/found_targets/kept'
# Topics still recorded during shutdown.
_AT_THE_END = ('cmd_vel', 'rosout', 'diagnostics', 'transition_event')
# A message with a stamp in the future is held until that time, so that no stamp is later than its
# log time. Longest hold [s of wall time], and the lead above which a stamp is assumed to come from
# another clock [ns].
_LONGEST_HOLD, _LARGEST_LEAD = 1.0, 60 * 10**9
# Longest wait for the acknowledgement of stop commands [s].
_STOP_PATIENCE = 1.0


class Recorder:
    """
    A node that takes serialised messages from all topics that it discovers.

    It has no executor: `wait` and `drain` take messages without callbacks, at a fifth of the cost.

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

    Parameters
    ----------
    domain : int
        ROS domain.
    observer : Observer
        Gets the messages that the report needs.
    step_length : float
        Duration of a step [s].
    bag : BagWriter, optional
        Recording; None: no recording, and only messages that the observer needs are taken.
    team : str
        Namespace of the team, without slashes at its ends. Topics of the observer are relative to
        it.
    """

    def __init__(
        self,
        domain: int,
        observer: Observer[Any],
        step_length: float,
        bag: BagWriter | None,
        team: str = '',
    ) -> None:
        self.context = Context()
        rclpy.init(
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = Node(
            NAME,
            namespace=f'/{team}',
            context=self.context,
            start_parameter_services=False,
            enable_rosout=False,
            use_global_arguments=False,
        )
        self.observer = observer
        self._step_length = step_length
        self.bag = bag
        self._team = team
        self.name = within(team, f'/{NAME}')
        self.time = 0
        # Of the first step [ns].
        self._begun: int | None = None
        self.step: int | None = None
        self.last_seen: dict[str, float] = {}
        #: Robots at the first step, and time of the first message of each recorded topic [ns].
        self.robots: list[str] = []
        self.first: dict[str, int] = {}
        #: Share of the environment explored, published by planners each second.
        self.explored = 0.0
        #: Present errors of planners, by the name of the node.
        self.faults: dict[str, str] = {}
        #: Time of the last diagnostics of each node [s of wall time].
        self.heartbeats: dict[str, float] = {}
        self._held: list[tuple[str, bytes]] = []
        self._hold_began = 0.0
        self._last_done: deque[bytes] = deque(maxlen=100)
        self.ready: set[str] = set()
        # Nodes that answered the newest reader of READY, and the number of others at that time.
        self._answered: set[str] = set()
        self._asked_with = 0
        self._finished = False
        self._last_step = -1
        self.complaints: list[str] = []
        #: Called with topic, type and content of each message that a page shows.
        self.listener: Callable[[str, str, bytes], None] | None = None
        self._shown: dict[str, str] = {}
        self._wanted = {*observer.topics, CLOCK, DONE, DIAGNOSTICS}
        self._subscriptions: dict[str, Subscription] = {}
        self._refused: set[str] = set()
        self._ready_subscription = self._subscribe(READY, LockstepDone, LATCHED_ALL)
        self._ready_publisher = self.node.create_publisher(
            LockstepDone, within(team, READY), LATCHED
        )
        self._done_publisher = self.node.create_publisher(
            LockstepDone, within(team, DONE), RELIABLE
        )
        self._wait_set = rclpy_implementation.WaitSet(2, 0, 0, 0, 0, 0, self.context.handle)

    def _subscribe(self, topic: str, kind: type, qos: QoSProfile) -> Subscription:
        return self.node.create_subscription(kind, self._full(topic), _never, qos, raw=True)

    def _full(self, topic: str) -> str:
        """Return the full name of a topic of the team."""
        return topic if topic in _SHARED else within(self._team, topic)

    def _relative(self, topic: str) -> str | None:
        """Return the name of a topic within the team; None for a topic of others."""
        if not self._team or topic in _SHARED:
            return topic
        inner = topic.removeprefix(f'/{self._team}')
        return None if inner == topic or inner[0] != '/' or inner in _SHARED else inner

    def discover(self) -> None:
        """Subscribe to the topics that have appeared since the last call."""
        for full, types in self.node.get_topic_names_and_types():
            topic = self._relative(full)
            if topic is None or topic in self._subscriptions or topic in self._refused:
                continue
            shown = self.listener is not None and is_shown(topic, types[0])
            if not (self._wants(topic) or shown):
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
                self.complaints.append(f'topic {full} is not recorded: {error}')
                continue
            self._subscriptions[topic] = self._subscribe(topic, kind, qos)
            if shown:
                self._shown[topic] = types[0]

    def missing(self, topics: Sequence[str]) -> list[str]:
        """Return the topics, among those recorded, with a publisher that is not connected yet.

        `topics` has each topic once for each of its publishers.
        """
        publishers = Counter(topics)
        return [
            full
            for full, number in publishers.items()
            if self._connected(self._relative(full)) < number
        ]

    def unmatched(self) -> list[str]:
        """Return the topics with a publisher that is known, but not connected yet."""
        return [
            full
            for topic, subscription in self._subscriptions.items()
            if subscription.handle.get_publisher_count()
            < self.node.count_publishers(full := self._full(topic))
        ]

    def _connected(self, topic: str | None) -> float:
        """Return the number of connected publishers; infinite if the topic is not recorded."""
        if topic is None or not self._wants(topic):
            return math.inf
        subscription = self._subscriptions.get(topic)
        return 0 if subscription is None else subscription.handle.get_publisher_count()

    def _wants(self, topic: str) -> bool:
        # A name with an underscore in front is hidden: the inner topics of actions.
        if topic in _SKIPPED or '/_' in topic or topic.endswith(_KEPT):
            return False
        return self.bag is not None or topic in self._wanted

    def take_ready(self) -> set[str]:
        """Return the names of the nodes that have reported ready."""
        for data in _take(self._ready_subscription):
            self._answered.add(deserialize_message(data, LockstepDone).node)
        self.ready |= self._answered
        return self.ready

    def unanswered(self, nodes: Collection[str]) -> list[str]:
        """Return the nodes that may not send to all subscriptions of the recorder yet.

        A publisher that the recorder is connected to may not know the recorder, and drops what it
        publishes. Nodes learn of subscriptions in the order in which these were made: one that
        answers a new subscription, with its latched report of being ready, knows all before it.
        """
        if self._asked_with != len(self._subscriptions):
            self._asked_with = len(self._subscriptions)
            self._answered = set()
            self.node.destroy_subscription(self._ready_subscription)
            self._ready_subscription = self._subscribe(READY, LockstepDone, LATCHED_ALL)
        self.take_ready()
        return [name for name in nodes if name not in self._answered]

    def publish_ready(self) -> None:
        """Report that the recorder is ready."""
        self._ready_publisher.publish(LockstepDone(node=self.name, step=0))

    def publish_done(self, step: int) -> None:
        """Report that the recorder is done with a step."""
        self._done_publisher.publish(LockstepDone(node=self.name, step=step))

    def wait(self, timeout: float) -> None:
        """Return when there is a new step (free running: after the time) [s]."""
        waiting = [self._ready_subscription]
        if STEP in self._subscriptions:
            waiting.append(self._subscriptions[STEP])
        self._wait_set.clear_entities()
        for subscription in waiting:
            self._wait_set.add_subscription(subscription.handle)
        self._wait_set.wait(round(timeout * 1e9))

    def drain(self, limit: int | None = None) -> None:
        """
        Pass all received messages to the observer and the recording.

        A run ends at a step: later messages are dropped, so that equal runs give equal recordings.

        Parameters
        ----------
        limit : int, optional
            Simulated time after its start at which the run ends [ns].
        """
        # Messages left in the queue would end each wait at once.
        self.take_ready()
        # Messages that an update refers to precede it: take updates first, add them last.
        updates = [
            (topic, data)
            for topic in self.observer.update_topics
            for data in self._take_from(topic)
        ]
        steps = self._take_from(STEP)
        for data in steps:
            self.step = struct.unpack_from('<Q', data, 4)[0]
            self._set_time(data, 12)
            if self._begun is None:
                self._begun = time_at(data, 12)
                self.robots = deserialize_message(data, LockstepStep).robots
        taken = [(CLOCK, data) for data in self._take_from(CLOCK)]
        for _, data in taken:
            self._set_time(data, 4)
        for topic, subscription in self._subscriptions.items():
            if topic not in (*self.observer.update_topics, STEP, CLOCK):
                taken += [
                    (topic, data) for data in _take(subscription) if self._is_own(topic, data)
                ]
        taken += updates
        taken += [(STEP, data) for data in steps]
        if self._finished:
            taken = self._until(taken, self._last_step)
        elif limit is not None and self.step is not None and self._elapsed >= limit:
            self._last_step = self.step - 1
            taken = self._until(taken, self._last_step)
        now = time.monotonic()
        for topic, data in taken:
            self.last_seen[topic] = now
            if topic == DONE:
                self._last_done.append(data)
            elif topic == DIAGNOSTICS:
                for status in deserialize_message(data, DiagnosticArray).status:
                    self.heartbeats[status.name] = now
                    self._note_planner(status)
            # Also those of the last step that arrive after the end.
            self.observer.add(topic, data)
            if self.listener is not None and topic in self._shown:
                self.listener(topic, self._shown[topic], data)
        self.observer.settle()
        if self.observer.end_step is not None and not self._finished:
            self._last_step = self.observer.end_step
            taken = self._until(taken, self._last_step)
        self._record(taken)

    def _note_planner(self, status: DiagnosticStatus) -> None:
        """Note what a planner says between its decisions: its error, and the exploration."""
        if not status.name.endswith('/planner_node'):
            return
        self.faults.pop(status.name, None)
        if status.level == DiagnosticStatus.ERROR:
            self.faults[status.name] = status.message
        for item in status.values:
            if item.key == 'explored':
                with contextlib.suppress(ValueError):
                    self.explored = max(self.explored, float(item.value))

    @property
    def elapsed(self) -> float:
        """Simulated time since the first step [s]."""
        return self._elapsed / 1e9

    @property
    def _elapsed(self) -> int:
        return 0 if self._begun is None else self.time - self._begun

    def _is_own(self, topic: str, data: bytes) -> bool:
        """Return whether a message on a topic shared by all teams is the team's own."""
        if not self._team:
            return True
        if topic == DIAGNOSTICS:
            names = [item.name for item in deserialize_message(data, DiagnosticArray).status]
            return any(name.startswith(f'/{self._team}/') for name in names)
        if topic == ROSOUT:
            logger = f'{self._team.replace("/", ".")}.'
            return bool(deserialize_message(data, Log).name.startswith(logger))
        return True

    def _record(self, taken: list[tuple[str, bytes]]) -> None:
        # A failed bag ends the run: see `bag.failed`.
        if self.bag is None or self.bag.failed:
            return
        try:
            for topic, data in self._due(taken):
                self.bag.write(self._full(topic), self.time, data)
                self.first.setdefault(topic, self.time)
        except BagError:
            if not self.bag.failed:
                raise

    def _due(self, taken: list[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
        """Return what to record now; hold messages with a stamp in the future."""
        now = time.monotonic()
        items = self._held + taken
        if not self._held:
            self._hold_began = now
        if self._last_step >= 0:
            items = self._until(items, self._last_step)
        self._held = []
        if self._finished or now - self._hold_began > _LONGEST_HOLD:
            return items
        due = []
        early: set[str] = set()
        for topic, data in items:
            lead = stamp_of(topic, self._subscriptions[topic].msg_type, data) - self.time
            # Keep the order within a topic.
            if topic in early or 0 < lead <= _LARGEST_LEAD:
                early.add(topic)
                self._held.append((topic, data))
            else:
                due.append((topic, data))
        return due

    def finish(self) -> None:
        """Keep only messages of the steps so far and of the shutdown from now on."""
        self._finished = True
        if self._last_step < 0 and self.step is not None:
            self._last_step = self.step

    def _until(self, taken: list[tuple[str, bytes]], step: int) -> list[tuple[str, bytes]]:
        """Return the messages up to a step; those without step or stamp are kept."""
        end = stamp_of_step(step, self._step_length)
        kept = []
        for topic, data in taken:
            kind = self._subscriptions[topic].msg_type
            if self._finished and topic.rpartition('/')[2] in _AT_THE_END:
                kept.append((topic, data))
                continue
            if stamp_of(topic, kind, data) > end:
                continue
            if _has_step(kind) and deserialize_message(data, kind).step > step:
                continue
            kept.append((topic, data))
        return kept

    def _take_from(self, topic: str) -> list[bytes]:
        subscription = self._subscriptions.get(topic)
        return [] if subscription is None else _take(subscription)

    def _set_time(self, data: bytes, offset: int) -> None:
        self.time = max(self.time, time_at(data, offset))

    def done_steps(self) -> dict[str, int]:
        """Return the last step that each node recently reported done."""
        steps: dict[str, int] = {}
        for data in self._last_done:
            message = deserialize_message(data, LockstepDone)
            steps[message.node] = max(message.step, steps.get(message.node, 0))
        return steps

    def stop_robots(self, names: Collection[str]) -> None:
        """Publish zeros on `cmd_vel` of robots that subscribe to it, and wait until they arrive."""
        types = dict(self.node.get_topic_names_and_types())
        publishers = []
        for name in names:
            topic = self._full(f'/{name}/cmd_vel')
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
        for publisher in publishers:
            kind: Any = publisher.msg_type
            message = kind()
            if isinstance(message, TwistStamped):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.time, 10**9)
            publisher.publish(message)
        for publisher in publishers:
            left = max(deadline - time.monotonic(), 0.0)
            publisher.wait_for_all_acked(Duration(nanoseconds=round(left * 1e9)))
            self.node.destroy_publisher(publisher)

    def followers(self) -> list[str]:
        """Return the namespaces of the runs that follow the clock of this one."""
        return sorted(
            info.node_namespace
            for info in self.node.get_subscriptions_info_by_topic(CLOCK)
            if info.node_name == 'sim_node' and info.node_namespace.strip('/') != self._team
        )

    def close(self) -> None:
        """Leave the graph."""
        if self.context.ok():
            self.node.destroy_node()
            rclpy.shutdown(context=self.context)


@cache
def _has_step(kind: Any) -> bool:
    """Return whether messages of a type name the step that they belong to."""
    # In other packages it is something else: the length of an image's row.
    return kind.__module__.startswith('maasi_msgs.') and 'step' in kind.get_fields_and_field_types()


def _take(subscription: Subscription) -> list[bytes]:
    """Return all serialised messages queued in a subscription."""
    taken: list[bytes] = []
    handle = subscription.handle
    while True:
        item = handle.take_message(subscription.msg_type, True)
        if item is None:
            return taken
        taken.append(item[0])


def _never(_: bytes) -> None:
    """Do nothing: messages are taken without callbacks."""
