"""What all nodes of a search share: parameters, life cycle, readiness, lockstep, diagnostics."""

from __future__ import annotations

import gc
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection
from functools import partial
from typing import Any, Generic

import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.utilities import get_default_context

from maasi_filter.ros.bad_requests import survive_bad_requests
from maasi_filter.ros.clock_watch import ClockWatch
from maasi_filter.ros.executor import executor_of
from maasi_filter.ros.node_entities import NodeEntities
from maasi_filter.ros.node_parameters import NodeParameters, SettingsError, SettingsT
from maasi_filter.ros.qos import LATCHED, RELIABLE
from maasi_filter.ros.stamps import stamp_problem
from maasi_msgs.msg import LockstepDone, LockstepStep

__all__ = ['LockstepLifecycleNode', 'SettingsError', 'run']

# Between two looks at whether the peers are there [s].
_PEERS_PERIOD = 0.02
_DIAGNOSTICS_PERIOD = 1.0
_WARNING_PERIOD = 2.0
# Longest time until a signal is noticed [s].
_SIGNAL_PERIOD = 0.1


_STEADY = Clock(clock_type=ClockType.STEADY_TIME)

# Between the discovery of a subscription and its connection [s].
_CONNECTION_PATIENCE = 5.0


class LockstepLifecycleNode(LifecycleNode, Generic[SettingsT]):
    """A lifecycle node of the suite.

    Publishes
    ---------
    `/diagnostics` (diagnostic_msgs/DiagnosticArray), each second;
    `lockstep/ready`, `lockstep/done` (maasi_msgs/LockstepDone)

    Subscribes
    ----------
    `lockstep/step` (maasi_msgs/LockstepStep), in lockstep

    Parameters
    ----------
    name : str
        Of the node.
    settings : type
        Its settings; each becomes a parameter.
    in_robot : bool
        Whether its namespace is that of a robot: what concerns the team is one level up.
    lockstep_member : bool
        Whether it takes part in lockstep.
    """

    #: Read in *configure*, and kept until the next one.
    settings: SettingsT

    def __init__(
        self,
        name: str,
        settings: type[SettingsT],
        *,
        in_robot: bool = False,
        lockstep_member: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(name, allow_undeclared_parameters=True, **options)
        self._always_in_robot = self._in_robot = in_robot
        self._lockstep_member = lockstep_member
        self._parameters_read = NodeParameters(self, settings)
        self._entities_made = NodeEntities(self)
        #: Why it could not be configured; empty where it could.
        self.problem = ''
        self.dropped: Counter[str] = Counter()
        self._prepared = False
        self.configured = False
        self.active = False
        self.step = -1
        self._warned: dict[str, float] = {}
        self._peers: list[Callable[[], bool]] = []
        self._peer_timer: Any = None
        self.step_subscription: Subscription | None = None
        self._ready_publisher: Publisher | None = None
        self._done_publisher: Publisher | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._clock_watch = ClockWatch(self, self.warn_throttled, self._on_restart)
        self.create_wall_timer(_DIAGNOSTICS_PERIOD, self._publish_diagnostics)
        survive_bad_requests(self, self.drop)

    def destroy_node(self) -> None:
        """Leave the graph."""
        self._clock_watch.stop()
        self._entities_made.clear()
        super().destroy_node()

    # ---- names -------------------------------------------------------------------------------

    def team_topic(self, name: str) -> str:
        """Return the full name of a topic of the team."""
        parts = [part for part in self.get_namespace().split('/') if part]
        if self._in_robot:
            parts = parts[:-1]
        return '/' + '/'.join([*parts, name])

    # ---- life cycle --------------------------------------------------------------------------

    def prepare(self) -> None:
        """Make what the settings describe, before `set_up`. In *configure*.

        Raises
        ------
        SettingsError
            If a setting is not allowed after all.
        """

    def set_up(self) -> None:
        """Create publishers and subscriptions, compile and warm up. In *configure*."""

    def start(self) -> None:
        """Begin to work, in *activate*."""

    def halt(self) -> None:
        """Stop what moves, in *deactivate* and at the end. May be called more than once."""

    def tear_down(self) -> None:
        """Undo `prepare` and `set_up`, in *cleanup*: all but ROS entities, which go by themselves.

        After a *configure* that failed it is called as well.
        """

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
        # One that works for a single robot, in its namespace, belongs to that robot.
        alone = robots is not None and list(robots) == [self.get_namespace().rpartition('/')[2]]
        self._in_robot = self._always_in_robot or alone
        self.step = -1
        self._prepared = True
        self.prepare()
        self._ready_publisher = self.create_publisher(
            LockstepDone, self.team_topic('lockstep/ready'), LATCHED
        )
        if self.settings.lockstep and self._lockstep_member:
            self._done_publisher = self.create_publisher(
                LockstepDone, self.team_topic('lockstep/done'), RELIABLE
            )
            self.expect_subscribers(self._done_publisher)
            self.step_subscription = self.create_subscription(
                LockstepStep, self.team_topic('lockstep/step'), self._hear_step, RELIABLE
            )
        self.set_up()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""
        self.active = True
        self.start()
        self._peer_timer = self.create_wall_timer(_PEERS_PERIOD, self._look_for_peers)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop what moves."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo *configure*."""
        self._disconnect()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop what moves, for good."""
        self._stop()
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop what moves after an error in a transition, and undo *configure*."""
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
        self._end_peer_timer()

    def _end_peer_timer(self) -> None:
        if self._peer_timer is not None:
            self._peer_timer.cancel()
            self.destroy_timer(self._peer_timer)
            self._peer_timer = None

    def _disconnect(self) -> None:
        self.active = False
        if self._prepared:
            self._prepared = False
            try:
                self.tear_down()
            except Exception:
                # The rest is undone all the same.
                self.get_logger().error(traceback.format_exc())
        self.configured = False
        self._peers.clear()
        self._entities_made.clear()
        self._peer_timer = self._ready_publisher = self._done_publisher = None
        self.step_subscription = None
        self._parameters_read.release()

    # ---- readiness and lockstep --------------------------------------------------------------

    def expect(self, condition: Callable[[], bool]) -> None:
        """Count as ready only where this holds."""
        self._peers.append(condition)

    def expect_subscribers(
        self,
        publisher: Callable[[], Publisher | None] | Publisher,
        number: int = 1,
        names: Collection[str] = (),
    ) -> None:
        """Count as ready only when a message would reach all who are known to listen.

        Parameters
        ----------
        publisher : Publisher, or a function that returns the present one
            Of the message.
        number : int
            How many have to listen; those who only look on do not count.
        names : collection of str
            Nodes that have to be among them, without namespace.
        """
        get = publisher if callable(publisher) else lambda: publisher
        known_since: list[float] = []

        def heard() -> bool:
            present = get()
            if present is None:
                return False
            kind: Any = present.msg_type
            known = [
                info.node_name
                for info in self.get_subscriptions_info_by_topic(present.topic_name)
                if info.topic_type == f'{kind.__module__.split(".")[0]}/msg/{kind.__name__}'
            ]
            if not set(names) <= set(known) or sum(map(_takes_part, known)) < number:
                return False
            known_since.append(time.monotonic())
            # Somebody who looks on with another quality of service is never connected.
            late = known_since[-1] - known_since[0] > _CONNECTION_PATIENCE
            del known_since[1:]
            return late or present.get_subscription_count() >= len(known)

        self.expect(heard)

    def expect_publisher(self, topic: str) -> None:
        """Count as ready only with a publisher of a topic."""
        self.expect(lambda: self.count_publishers(topic) > 0)

    def _look_for_peers(self) -> None:
        if not self.active or not all(condition() for condition in self._peers):
            return
        self._end_peer_timer()
        self.on_ready()
        if self._ready_publisher is not None:
            self._ready_publisher.publish(LockstepDone(node=self.get_fully_qualified_name()))

    def on_ready(self) -> None:
        """Note that all peers are there."""

    def _hear_step(self, message: LockstepStep) -> None:
        if not self.active:
            return
        if message.step < self.step:
            self.warn_throttled(
                'step back', f'step {message.step} came after {self.step}: starting anew'
            )
            self.reset()
        self.step = message.step
        self.on_step(message)

    def on_step(self, message: LockstepStep) -> None:
        """Do what this node does at a step in lockstep, and say `done` when it is."""
        self.done(message.step)

    def done(self, step: int) -> None:
        """Say that the node has done what it does at a step."""
        if self._done_publisher is not None:
            self._done_publisher.publish(
                LockstepDone(node=self.get_fully_qualified_name(), step=step)
            )

    # ---- time --------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget what belongs to a time that will not come again: the clock jumped back."""

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], None], *others: Any, **options: Any
    ) -> Any:
        """Return a timer that is not called any more once it was destroyed.

        The executor may have found it due before.
        """

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
            # In lockstep the steps are the time.
            self.warn_throttled('clock', text)
            return
        self.get_logger().warning(f'{text}: the search starts again')
        self.reset()

    # ---- messages ----------------------------------------------------------------------------

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Subscription:
        """Return a subscription that drops messages whose stamp is no time."""
        if not options.get('raw'):
            callback = partial(self.check_stamp, topic, callback)
        return super().create_subscription(msg_type, topic, callback, qos_profile, **options)

    def check_stamp(self, topic: str, callback: Callable[[Any], None], message: Any) -> None:
        """Call back unless the stamp of a message is no time."""
        problem = stamp_problem(message)
        if problem is None:
            callback(message)
        else:
            self.drop('bad stamp', f'{topic}.{problem}')

    # ---- diagnostics -------------------------------------------------------------------------

    def drop(self, reason: str, text: str, number: int = 1) -> None:
        """Count something that is not used, and say so, throttled.

        Parameters
        ----------
        reason : str
            Short; what is counted in the diagnostics.
        text : str
            Topic and field, what was read, what is allowed.
        number : int
            How many.
        """
        self.dropped[reason] += number
        self.warn_throttled(reason, f'dropped: {text}')

    def warn_throttled(self, key: str, text: str) -> None:
        """Warn at most every two seconds under one key."""
        now = time.monotonic()
        if now - self._warned.get(key, -1e9) >= _WARNING_PERIOD:
            self._warned[key] = now
            self.get_logger().warning(text)

    def status(self) -> dict[str, Any]:
        """Return what the diagnostics show beside the counts."""
        return {}

    def fault(self) -> str:
        """Return what keeps the node from its work, for the diagnostics; empty where it works."""
        return ''

    def warnings(self) -> list[str]:
        """Return what is wrong now, for the diagnostics."""
        return []

    def _publish_diagnostics(self) -> None:
        self._clock_watch.look()
        dropped = sum(self.dropped.values())
        shown = self.status() if self.configured else {}
        fault = self.fault() if self.active else ''
        warnings = self.warnings() if self.active else []
        level = DiagnosticStatus.WARN if dropped or warnings else DiagnosticStatus.OK
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if fault else level,
            name=self.get_fully_qualified_name(),
            message='; '.join([fault or ('active' if self.active else 'not active'), *warnings]),
            hardware_id='',
            values=[
                *(KeyValue(key=key, value=str(value)) for key, value in shown.items()),
                *(
                    KeyValue(key=f'dropped: {reason}', value=str(number))
                    for reason, number in sorted(self.dropped.items())
                ),
            ],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.stamp_of_diagnostics()
        self._diagnostics.publish(message)

    def stamp_of_diagnostics(self) -> Time:
        """Return the present time of the run."""
        return self.get_clock().now().to_msg()


def _takes_part(name: str) -> bool:
    """Return whether a node that listens is one that something depends on."""
    return name not in ('recorder', 'guard', 'rosbag2_recorder') and not name.startswith('_')


def _configure(node: LockstepLifecycleNode[Any]) -> bool:
    """Configure a node; return whether it is configured."""
    done = node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    if not done:
        print(f'error: {node.problem}', file=sys.stderr)
    return done


def _activate(node: LockstepLifecycleNode[Any]) -> bool:
    return node.trigger_activate() == TransitionCallbackReturn.SUCCESS


def run(
    make_node: Callable[[], LockstepLifecycleNode[Any]], arguments: list[str] | None = None
) -> int:
    """Run a node until it is told to end; return the exit code.

    SIGINT and SIGTERM stop what moves before the node leaves the graph.
    """
    # A signal is only noted: an exception in the middle of a call into rclpy's C++ comes out as
    # another one. A second signal does not wait.
    asked = False

    def interrupt(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    node: LockstepLifecycleNode[Any] | None = None
    try:
        signal.signal(signal.SIGINT, interrupt)
        signal.signal(signal.SIGTERM, interrupt)
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = make_node()
        executor = executor_of(node)
        if node.get_parameter('autostart').value and not asked:
            if not _configure(node):
                return 2 if node.problem else 1
            if not asked and not _activate(node):
                return 1
        # What was made so far stays: the collector need not look at it in every round.
        gc.collect()
        gc.freeze()
        while rclpy.ok() and not asked:
            executor.spin_once(_SIGNAL_PERIOD)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if node is not None:
            if rclpy.ok() and node.configured:
                node.halt()
            node.destroy_node()
        rclpy.try_shutdown()
        # Not left to the end of the process, which may be a copy of another one.
        get_default_context(shutting_down=True).destroy()
    return 0
