"""Workarounds for rclpy 7.1 (Jazzy): entities of a node survive their peers.

Comments name the fix that makes each part obsolete.
"""

from collections.abc import Callable, Hashable
from functools import partial
from operator import methodcaller
from typing import Any, TypeVar

from rclpy.event_handler import EventHandler, PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from maasi_filter.ros.clocks import stamp_problem
from maasi_filter.ros.diagnostics import STEADY, ReportingNode

T = TypeVar('T')

# Exceptions of rclpy on bad requests, by package of the service type. Of the life cycle:
# https://github.com/ros2/rclpy/issues/1209. Of the parameters: until a request with a value of a
# wrong or unknown type, which raises in `Parameter.from_parameter_msg`, does not end the spin.
_ERRORS: dict[str, tuple[type[Exception], ...]] = {
    'rcl_interfaces': (TypeError, ValueError, AttributeError, KeyError, AssertionError),
    'lifecycle_msgs': (rclpy_implementation.RCLError,),
}


class SafeNode(ReportingNode):
    """A node whose entities may be destroyed while it spins, and that survives bad requests."""

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self._kept: list[Any] | None = None
        self._permanent: dict[Hashable, Any] = {}
        for service in self.services:
            errors = _ERRORS.get(service.srv_type.__module__.partition('.')[0])
            if errors is not None:
                answer = partial(self._answer, service.srv_name, errors, service.callback)
                service.callback = answer

    def _answer(self, name: str, errors: Any, callback: Any, request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except errors as error:
            self.drop('bad request', f'{name}: {type(error).__name__}: {error}')
            return type(response)()

    # ---- entities ----------------------------------------------------------------------------

    def permanent(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the entity of a key, made at the first call and kept as long as the node."""
        # Actions, and entities with event callbacks: destroyed with an event in the queue they
        # crash the events executor (https://github.com/ros2/rclpy/issues/1644).
        if key not in self._permanent:
            self._permanent[key] = make()
        made: T = self._permanent[key]
        return made

    def mark_entities(self) -> None:
        """Exempt the present entities from `clear_entities`."""
        self._kept = [item for item, _ in self._entities()]

    def clear_entities(self) -> None:
        """Destroy the entities created after `mark_entities`."""
        if self._kept is None:
            return
        kept = {id(item) for item in (*self._kept, *self._permanent.values())}
        self._kept = None
        for item, destroy in self._entities():
            if id(item) not in kept:
                destroy(item)

    def _entities(self) -> list[tuple[Any, Callable[[Any], object]]]:
        # Event handlers are destroyed by their owners.
        waitables = [item for item in self.waitables if not isinstance(item, EventHandler)]
        kinds: list[tuple[Any, Callable[[Any], object]]] = [
            (waitables, methodcaller('destroy')),
            (self.timers, self.destroy_timer),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.clients, self.destroy_client),
            (self.publishers, self.destroy_publisher),
        ]
        return [(item, destroy) for items, destroy in kinds for item in items]

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], None], *others: Any, **options: Any
    ) -> Any:
        """Return a timer that is never called after its destruction."""

        # Until the events executor discards the calls of destroyed timers that it has queued.
        def call() -> None:
            if any(item is made for item in self.timers):
                callback()

        made: Any = super().create_timer(timer_period_sec, call, *others, **options)
        return made

    def create_wall_timer(self, period: float, callback: Callable[[], None]) -> Any:
        """Return a timer on the steady clock; `period` in seconds."""
        return self.create_timer(period, callback, clock=STEADY)

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **options: Any) -> Any:
        """Return a publisher without event callbacks, which `check_peers` replaces."""
        # https://github.com/ros2/rclpy/issues/1644
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        return super().create_publisher(
            msg_type, topic, qos_profile, **{'event_callbacks': quiet, **options}
        )

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Subscription:
        """Return a subscription that drops invalid stamps and sizes, and messages after its end."""
        # https://github.com/ros2/rclpy/issues/1644
        quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
        receive = callback
        if not options.get('raw'):
            receive = partial(self.check_stamp, topic, callback)
            fields = msg_type.get_fields_and_field_types().values()
            if any(field.startswith('sequence<') and '/' in field for field in fields):
                # Reading 100,000 items of a list of messages alone takes a second
                # (https://github.com/ros2/rosidl_python/issues/192).
                receive = partial(self._check_size, topic, msg_type, receive)
                options['raw'] = True

        # Until the events executor discards the messages of destroyed subscriptions.
        def call(message: Any) -> None:
            if any(item is made for item in self.subscriptions):
                receive(message)

        made = super().create_subscription(
            msg_type, topic, call, qos_profile, **{'event_callbacks': quiet, **options}
        )
        return made

    # ---- messages ----------------------------------------------------------------------------

    def _check_size(
        self, topic: str, msg_type: Any, callback: Callable[[Any], None], data: bytes
    ) -> None:
        limit = self.settings.largest_message  # type: ignore[attr-defined]
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
