"""What all nodes of a search share: parameters, life cycle, readiness, lockstep, diagnostics."""

from __future__ import annotations

import gc
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection
from typing import Any, Generic, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from pydantic import ValidationError
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.utilities import get_default_context

from maasi_filter.executor import LeanExecutor
from maasi_filter.node_settings import NodeSettings
from maasi_filter.parameters import parameter_fields, unflatten
from maasi_filter.qos import LATCHED, RELIABLE
from maasi_msgs.msg import LockstepDone, LockstepStep

SettingsT = TypeVar('SettingsT', bound=NodeSettings)

# Between two looks at whether the peers are there [s].
_PEERS_PERIOD = 0.02
_DIAGNOSTICS_PERIOD = 1.0
# Without /clock for so long the node says that it waits [s].
_CLOCK_PATIENCE = 3.0
_WARNING_PERIOD = 2.0
# Longest time until a signal is noticed [s].
_SIGNAL_PERIOD = 0.1


_STEADY = Clock(clock_type=ClockType.STEADY_TIME)


# Between the discovery of a subscription and its connection [s].
_CONNECTION_PATIENCE = 5.0


class SettingsError(Exception):
    """Parameters that are not allowed; the text says which and why."""


class SearchNode(LifecycleNode, Generic[SettingsT]):
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

    def __init__(
        self,
        name: str,
        settings: type[SettingsT],
        *,
        in_robot: bool = False,
        lockstep_member: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(name, **options)
        self._in_robot = in_robot
        self._lockstep_member = lockstep_member
        self.settings: SettingsT = self._read_settings(settings)
        robots = getattr(self.settings, 'robots', None)
        if robots is not None:
            # One that works for a single robot, in its namespace, belongs to that robot.
            self._in_robot = list(robots) == [self.get_namespace().rpartition('/')[2]]
        self.dropped: Counter[str] = Counter()
        self.active = False
        self.step = -1
        self._warned: dict[str, float] = {}
        self._peers: list[Callable[[], bool]] = []
        self._urgent_topics: set[str] = set()
        self.step_subscription: Subscription | None = None
        self._ready_publisher: Publisher | None = None
        self._done_publisher: Publisher | None = None
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_wall_timer(_DIAGNOSTICS_PERIOD, self._publish_diagnostics)
        self._started = time.monotonic()
        self._clock_patience = _CLOCK_PATIENCE
        if self.get_parameter('use_sim_time').value:
            self.create_wall_timer(_CLOCK_PATIENCE, self._look_for_clock)
        self.get_clock().create_jump_callback(_backward_threshold(), post_callback=self._on_jump)

    # ---- names, parameters -------------------------------------------------------------------

    def team_topic(self, name: str) -> str:
        """Return the full name of a topic of the team."""
        parts = [part for part in self.get_namespace().split('/') if part]
        if self._in_robot:
            parts = parts[:-1]
        return '/' + '/'.join([*parts, name])

    def _read_settings(self, model: type[SettingsT]) -> SettingsT:
        given = {name: parameter.value for name, parameter in self._parameter_overrides.items()}
        values: dict[str, Any] = {}
        for item in parameter_fields(model, given):
            descriptor = ParameterDescriptor(
                description=item.description,
                additional_constraints=item.constraints,
                read_only=True,
                dynamic_typing=True,
            )
            values[item.name] = self.declare_parameter(item.name, item.default, descriptor).value
        known = {*values, 'use_sim_time'}
        unknown = sorted(
            name for name in given if name not in known and not name.startswith('qos_overrides.')
        )
        if unknown:
            raise SettingsError(f'parameter {unknown[0]}: is not known')
        try:
            return model.model_validate(unflatten(model, values))
        except ValidationError as error:
            lines = [
                f'parameter {".".join(str(part) for part in item["loc"])}: {item["msg"]}, '
                f'read {item["input"]!r}'
                for item in error.errors()
            ]
            raise SettingsError('\n'.join(lines)) from error
        except ValueError as error:
            raise SettingsError(f'parameter {error}') from error

    # ---- life cycle --------------------------------------------------------------------------

    def set_up(self) -> None:
        """Create publishers and subscriptions, compile and warm up. Once, in *configure*."""

    def start(self) -> None:
        """Begin to work, in *activate*."""

    def halt(self) -> None:
        """Stop what moves, in *deactivate* and at the end. May be called more than once."""

    def tear_down(self) -> None:
        """Undo `set_up`, in *cleanup*."""

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Compile, warm up and connect."""
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
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to work."""
        self.active = True
        self.start()
        self._peer_timer = self.create_wall_timer(_PEERS_PERIOD, self._look_for_peers)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop what moves."""
        self.halt()
        self.active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Undo *configure*."""
        self._disconnect()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop what moves, for good."""
        self.halt()
        self.active = False
        return TransitionCallbackReturn.SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop what moves after an error in a transition."""
        self.halt()
        return TransitionCallbackReturn.FAILURE

    def _disconnect(self) -> None:
        self.tear_down()
        self._peers.clear()
        if self._ready_publisher is not None:
            self.destroy_publisher(self._ready_publisher)
            self._ready_publisher = None
        if self._done_publisher is not None:
            self.destroy_publisher(self._done_publisher)
            self._done_publisher = None
        if self.step_subscription is not None:
            self.destroy_subscription(self.step_subscription)
            self.step_subscription = None

    # ---- readiness and lockstep --------------------------------------------------------------

    def hurry(self, *subscriptions: Subscription | None) -> None:
        """In lockstep: be woken by these; what comes otherwise is taken along."""
        if self.settings.lockstep:
            self._urgent_topics |= {item.topic for item in subscriptions if item is not None}

    @property
    def urgent(self) -> Collection[str]:
        """Topics to whose messages the node has to answer at once."""
        return self._urgent_topics

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
        self._peer_timer.cancel()
        self.destroy_timer(self._peer_timer)
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

    def create_wall_timer(self, period: float, callback: Callable[[], None]) -> Any:
        """Return a timer on the steady clock; `period` in seconds."""
        return self.create_timer(period, callback, clock=_STEADY)

    def _on_jump(self, jump: Any) -> None:
        if jump.delta.nanoseconds < 0 and self.active:
            self.get_logger().warning(
                f'the clock jumped back by {-jump.delta.nanoseconds * 1e-9:.3f} s: starting anew'
            )
            self.reset()

    def _look_for_clock(self) -> None:
        waited = time.monotonic() - self._started
        if (
            self.active
            and waited >= self._clock_patience
            and not self.get_clock().now().nanoseconds
        ):
            # Said less and less often.
            self._clock_patience = 2.0 * waited
            self.get_logger().warning(
                f'no /clock for {waited:.0f} s: waiting for it (use_sim_time is true)'
            )

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

    def _publish_diagnostics(self) -> None:
        dropped = sum(self.dropped.values())
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if dropped else DiagnosticStatus.OK,
            name=self.get_fully_qualified_name(),
            message='active' if self.active else 'not active',
            hardware_id='',
            values=[
                *(KeyValue(key=key, value=str(value)) for key, value in self.status().items()),
                *(
                    KeyValue(key=f'dropped: {reason}', value=str(number))
                    for reason, number in sorted(self.dropped.items())
                ),
            ],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def _takes_part(name: str) -> bool:
    """Return whether a node that listens is one that something depends on."""
    return name not in ('recorder', 'guard', 'rosbag2_recorder') and not name.startswith('_')


def _backward_threshold() -> Any:
    from rclpy.clock import JumpThreshold
    from rclpy.duration import Duration

    return JumpThreshold(
        min_forward=None, min_backward=Duration(nanoseconds=-1_000_000), on_clock_change=False
    )


def run(make_node: Callable[[], SearchNode[Any]], arguments: list[str] | None = None) -> int:
    """Run a node until it is told to end; return the exit code.

    SIGINT and SIGTERM stop what moves before the node leaves the graph.
    """
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)

    # While messages are taken a signal is only noted: an exception in the middle of a call into
    # rclpy's C++ comes out as another one. A second signal does not wait.
    spinning, asked = False, False

    def interrupt(number: int, frame: Any) -> None:
        nonlocal asked
        if not spinning or asked:
            raise KeyboardInterrupt
        asked = True

    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, interrupt)
    node: SearchNode[Any] | None = None
    try:
        node = make_node()
        executor = LeanExecutor(node, node.urgent)
        if node.settings.autostart:
            node.trigger_configure()
            node.trigger_activate()
        # What was made so far stays: the collector need not look at it in every round.
        gc.collect()
        gc.freeze()
        spinning = True
        while rclpy.ok() and not asked:
            executor.spin_for(_SIGNAL_PERIOD)
    except SettingsError as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if node is not None:
            if rclpy.ok():
                node.halt()
            node.destroy_node()
        rclpy.try_shutdown()
        # Not left to the end of the process, which may be a copy of another one.
        get_default_context(shutting_down=True).destroy()
    return 0
