"""Base of all nodes of a search: parameters, life cycle, readiness, lockstep, diagnostics."""

import math
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection
from functools import partial
from typing import Any, Generic

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from maasi_filter.ros.clocks import ClockWatch, stamp_problem
from maasi_filter.ros.entities import Endpoints, NodeEntities, survive_bad_requests
from maasi_filter.ros.loopback import loopback_fault
from maasi_filter.ros.node_parameters import NodeParameters, SettingsError, SettingsT
from maasi_filter.ros.qos import LATCHED
from maasi_msgs.msg import LockstepDone

# Period of the check for peers [s].
_PEERS_PERIOD = 0.02
_DIAGNOSTICS_PERIOD = 1.0
_LOG_PERIOD = 2.0
_NOTICE_DELAY = 3.0  # from activation until a node says what it waits for [s]

_STEADY = Clock(clock_type=ClockType.STEADY_TIME)


class LockstepLifecycleNode(LifecycleNode, Generic[SettingsT]):
    """A lifecycle node of the suite.

    Publishes
    ---------
    `/diagnostics` (diagnostic_msgs/DiagnosticArray), each second;
    `lockstep/ready` (maasi_msgs/LockstepDone)

    Parameters
    ----------
    in_robot : bool
        Whether its namespace is that of a robot: topics of the team are one level up.
    """

    settings: SettingsT  #: read in *configure*, and valid until the next one

    def __init__(
        self, name: str, settings: type[SettingsT], *, in_robot: bool = False, **options: Any
    ) -> None:
        super().__init__(name, allow_undeclared_parameters=True, **options)
        self._always_in_robot = self._in_robot = in_robot
        self._parameters_read = NodeParameters(self, settings)
        self._entities_made = NodeEntities(self)
        self.permanent = self._entities_made.permanent
        #: Why *configure* failed; empty if it succeeded.
        self.problem = ''
        self.dropped: Counter[str] = Counter()
        self._prepared = False
        self.configured = False
        self.active = False
        self.ending = False  #: whether it is asked to end, as the others may be too
        self.step = -1
        self._logged: dict[str, float] = {}
        self._peers: list[Callable[[], bool]] = []
        self._peers_timer: Any = None
        # When to say what nobody publishes [s of wall time].
        self._notice_at = math.inf
        self._ready_publisher: Publisher | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._endpoints = Endpoints(self)
        self._clock_watch = ClockWatch(self, self.warn_throttled, self._on_restart)
        self.create_wall_timer(_DIAGNOSTICS_PERIOD, self._publish_diagnostics)
        survive_bad_requests(self, self.drop)

    def destroy_node(self) -> None:
        """Destroy the entities of the node."""
        self._clock_watch.stop()
        self._entities_made.clear()
        super().destroy_node()

    def team_topic(self, name: str) -> str:
        """Return the full name of a topic of the team."""
        parts = [part for part in self.get_namespace().split('/') if part]
        if self._in_robot:
            parts = parts[:-1]
        return '/' + '/'.join([*parts, name])

    def prepare(self) -> None:
        """Create the objects that the settings describe, before `set_up`. In *configure*."""

    def set_up(self) -> None:
        """Create publishers and subscriptions, compile and warm up. In *configure*."""

    def start(self) -> None:
        """Start operation, in *activate*."""

    def halt(self) -> None:
        """Stop all motion, in *deactivate* and at shutdown. May be called more than once."""

    def tear_down(self) -> None:
        """Undo `prepare` and `set_up`, in *cleanup* and after a failed *configure*."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, compile, warm up and connect."""
        self.problem = ''
        self._entities_made.mark()
        try:
            self._configure()
        except SettingsError as error:
            self.problem = str(error)
        except Exception as error:
            self.problem = f'configure failed: {error!r}'
            self.get_logger().error(traceback.format_exc())
        if self.problem:
            self.get_logger().error(f'not configured: {self.problem}')
            self._disconnect()
            return TransitionCallbackReturn.FAILURE
        self.configured = True
        return TransitionCallbackReturn.SUCCESS

    def _configure(self) -> None:
        self.settings = self._parameters_read.read()
        robots = getattr(self.settings, 'robots', None)
        # A node of a single robot, in the namespace of that robot, belongs to it.
        alone = robots is not None and list(robots) == [self.get_namespace().rpartition('/')[2]]
        self._in_robot = self._always_in_robot or alone
        self.step = -1
        self._prepared = True
        self.prepare()
        self.set_up()
        # Last: publishers are discovered in this order, so who hears it knows all others.
        self._ready_publisher = self.create_publisher(
            LockstepDone, self.team_topic('lockstep/ready'), LATCHED
        )

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start operation."""
        self.active = True
        self.start()
        self._peers_timer = self.create_wall_timer(_PEERS_PERIOD, self._look_for_peers)
        self._notice_at = time.monotonic() + _NOTICE_DELAY
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop all motion."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo *configure*."""
        self._disconnect()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop all motion before shutdown."""
        self._stop()
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop all motion after an error in a transition, and undo *configure*."""
        self.get_logger().error('a transition failed: the node stops')
        try:
            self._stop()
        finally:
            self._disconnect()
        return TransitionCallbackReturn.SUCCESS

    def _stop(self) -> None:
        if self.configured:
            self.halt()
        self.active = False
        self._notice_at = math.inf
        self._end_peers_timer()

    def _end_peers_timer(self) -> None:
        if self._peers_timer is not None:
            self._peers_timer.cancel()
            self.destroy_timer(self._peers_timer)
            self._peers_timer = None

    def _disconnect(self) -> None:
        self.active = False
        if self._prepared:
            self._prepared = False
            try:
                self.tear_down()
            except Exception:
                self.get_logger().error(traceback.format_exc())  # continue with the rest
        self.configured = False
        self._peers.clear()
        self._entities_made.clear()
        self._ready_publisher = None
        self._peers_timer = None
        self._parameters_read.release()

    def offer_service(
        self, name: str, answer: Callable[[Trigger.Request, Trigger.Response], Trigger.Response]
    ) -> None:
        """Offer a service (std_srvs/Trigger) that lives as long as the node."""
        service = self.permanent(
            self.resolve_service_name(name), lambda: self.create_service(Trigger, name, answer)
        )
        service.callback = answer

    def expect(self, condition: Callable[[], bool]) -> None:
        """Add a condition for being ready."""
        self._peers.append(condition)

    def expect_subscribers(
        self,
        publisher: Callable[[], Publisher | None] | Publisher,
        number: int = 1,
        names: Collection[str] = (),
    ) -> None:
        """Be ready only when a message would reach all expected subscribers.

        `publisher` may be a function that returns the present one; `number` does not count mere
        observers; nodes of these `names`, without namespace, have to be among the subscribers.
        """

        def reached() -> bool:
            present = publisher() if callable(publisher) else publisher
            return present is not None and self._endpoints.reach(present, number, names)

        self.expect(reached)

    def expect_publisher(self, topic: str) -> None:
        """Be ready only with a publisher of a topic."""
        self.expect(lambda: self.count_publishers(topic) > 0)

    def _look_for_peers(self) -> None:
        if not self.active or not all(condition() for condition in self._peers):
            return
        self._end_peers_timer()
        if self._ready_publisher is not None:
            self._ready_publisher.publish(LockstepDone(node=self.get_fully_qualified_name()))

    def _say_what_is_missing(self) -> None:
        """Name, once after activation, the topics that nobody publishes."""
        if time.monotonic() < self._notice_at:
            return
        self._notice_at = math.inf
        missing = self._endpoints.unpublished()
        text = f'active, waiting for publishers of {", ".join(missing)}'
        if '/clock' in missing:
            self.get_logger().warning(f'{text}; use_sim_time is true')
        elif missing:
            self.get_logger().info(text)
        if missing and (fault := loopback_fault()):
            self.get_logger().warning(fault)

    def reset(self) -> None:
        """Discard state with times after a backward jump of the clock."""

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], None], *others: Any, **options: Any
    ) -> Any:
        """Return a timer that is never called after its destruction, as a queued call would be."""

        def call() -> None:
            if any(item is made for item in self.timers):
                callback()

        made: Any = super().create_timer(timer_period_sec, call, *others, **options)
        return made

    def create_wall_timer(self, period: float, callback: Callable[[], None]) -> Any:
        """Return a timer on the steady clock; `period` in seconds."""
        return self.create_timer(period, callback, clock=_STEADY)

    def _on_restart(self, jump: float) -> None:
        text = f'the clock jumped back by {jump:.3f} s'
        if not self.active or self.settings.lockstep:
            # In lockstep the steps define the time.
            self.warn_throttled('clock', text)
            return
        self.get_logger().warning(f'{text}: the search starts again')
        self.reset()

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **options: Any) -> Any:
        """Return a publisher without the event callbacks of rclpy; see `Endpoints`."""
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        return super().create_publisher(
            msg_type, topic, qos_profile, **{'event_callbacks': quiet, **options}
        )

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Subscription:
        """Return a subscription that drops invalid stamps and sizes; silent once destroyed."""
        options.setdefault(
            'event_callbacks', SubscriptionEventCallbacks(use_default_callbacks=False)
        )
        take = callback
        if not options.get('raw'):
            take = partial(self.check_stamp, topic, callback)
            fields = msg_type.get_fields_and_field_types().values()
            if any(field.startswith('sequence<') and '/' in field for field in fields):
                # Reading 100,000 items of a list of messages alone takes a second.
                take, options['raw'] = partial(self._check_size, topic, msg_type, take), True

        def call(message: Any) -> None:
            if any(item is made for item in self.subscriptions):
                take(message)

        made = super().create_subscription(msg_type, topic, call, qos_profile, **options)
        return made

    def _check_size(
        self, topic: str, msg_type: Any, callback: Callable[[Any], None], data: bytes
    ) -> None:
        limit = self.settings.largest_message
        if len(data) <= limit:
            callback(deserialize_message(data, msg_type))
        else:
            self.drop(
                'too large message',
                f'{topic}: read {len(data)} bytes, allowed are {limit} (parameter largest_message)',
            )

    def check_stamp(self, topic: str, callback: Callable[[Any], None], message: Any) -> None:
        """Call back unless the stamp of a message is invalid."""
        problem = stamp_problem(message)
        if problem is None:
            callback(message)
        else:
            self.drop('bad stamp', f'{topic}.{problem}')

    def drop(self, reason: str, text: str, number: int = 1) -> None:
        """Count discarded data by a reason, and warn, throttled: what was read, what is allowed."""
        self.dropped[reason] += number
        self.warn_throttled(reason, f'dropped: {text}')

    def warn_throttled(self, key: str, text: str) -> None:
        """Warn at most every two seconds under one key."""
        if self._is_due(key):
            self.get_logger().warning(text)

    def tell_throttled(self, key: str, text: str) -> None:
        """Log information at most every two seconds under one key."""
        if self._is_due(key):
            self.get_logger().info(text)

    def _is_due(self, key: str) -> bool:
        now = time.monotonic()
        due = now - self._logged.get(key, -1e9) >= _LOG_PERIOD
        if due:
            self._logged[key] = now
        return due

    def status(self) -> dict[str, Any]:
        """Return further values for the diagnostics."""
        return {}

    def fault(self) -> str:
        """Return the present error for the diagnostics; empty if there is none."""
        return ''

    def warnings(self) -> list[str]:
        """Return the present warnings for the diagnostics."""
        return []

    def _publish_diagnostics(self) -> None:
        self._clock_watch.look()
        self._say_what_is_missing()
        fault = self.fault() if self.active else ''
        warnings = [*(self.warnings() if self.active else []), *self._endpoints.look()]
        if sum(self.dropped.values()):
            counts = (f'{reason} {number}' for reason, number in sorted(self.dropped.items()))
            warnings = [*warnings, f'dropped: {", ".join(counts)}']
        level = DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK
        level = DiagnosticStatus.ERROR if fault else level
        values = dict(self.status()) if self.configured else {}
        values |= {f'dropped: {name}': number for name, number in sorted(self.dropped.items())}
        status = DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name(),
            message='; '.join([fault or ('active' if self.active else 'not active'), *warnings]),
            hardware_id='',
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.stamp_of_diagnostics()
        self._diagnostics.publish(message)

    def stamp_of_diagnostics(self) -> Time:
        """Return the present time of the run."""
        return self.get_clock().now().to_msg()
