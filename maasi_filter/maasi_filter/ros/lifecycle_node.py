"""Base of all nodes: parameters and life cycle."""

import traceback
from collections.abc import Callable
from typing import Any, Generic

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from std_srvs.srv import Trigger

from maasi_filter.ros.clocks import ClockWatch
from maasi_filter.ros.node_parameters import NodeParameters, SettingsError, SettingsT
from maasi_filter.ros.readiness import ReadyNode


class LockstepLifecycleNode(ReadyNode, Generic[SettingsT]):
    """A lifecycle node of the suite.

    Publishes
    ---------
    `/diagnostics` (diagnostic_msgs/DiagnosticArray), each second;
    `lockstep/ready` (maasi_msgs/LockstepDone)

    Parameters
    ----------
    in_robot : bool
        Whether the node is in the namespace of a robot, one level below the team's.
    """

    settings: SettingsT  #: read in *configure*, and valid until the next one

    def __init__(
        self, name: str, settings: type[SettingsT], *, in_robot: bool = False, **options: Any
    ) -> None:
        super().__init__(name, allow_undeclared_parameters=True, **options)
        self._always_in_robot = self._in_robot = in_robot
        self._parameters_read = NodeParameters(self, settings)
        #: Why *configure* failed; empty if it succeeded.
        self.problem = ''
        self._prepared = False
        self.ending = False  #: whether a shutdown was requested
        self.step = -1
        self._clock_watch = ClockWatch(self, self.warn_throttled, self._on_restart)

    def destroy_node(self) -> None:
        """Destroy the entities of the node."""
        self._clock_watch.stop()
        self.clear_entities()
        super().destroy_node()

    def team_topic(self, name: str) -> str:
        """Return the full name of a topic of the team."""
        parts = [part for part in self.get_namespace().split('/') if part]
        if self._in_robot:
            parts = parts[:-1]
        return '/' + '/'.join([*parts, name])

    def offer_service(
        self, name: str, answer: Callable[[Any], tuple[bool, str]], kind: Any = Trigger
    ) -> None:
        """Offer a service that lives as long as the node; `answer` returns success and message."""

        def respond(request: Any, response: Any) -> Any:
            response.success, response.message = answer(request)
            return response

        service = self.permanent(
            self.resolve_service_name(name), lambda: self.create_service(kind, name, respond)
        )
        service.callback = respond

    # ---- hooks of nodes ------------------------------------------------------------------------

    def prepare(self) -> None:
        """Create the objects that the settings describe, in *configure* before `set_up`."""

    def set_up(self) -> None:
        """Create publishers and subscriptions, and compile, in *configure*."""

    def start(self) -> None:
        """Start operation, in *activate*."""

    def halt(self) -> None:
        """Stop all motion, in *deactivate* and at shutdown; may be called more than once."""

    def tear_down(self) -> None:
        """Undo `prepare` and `set_up`, in *cleanup* and after a failed *configure*."""

    def reset(self) -> None:
        """Discard state with times after a backward jump of the clock."""

    # ---- life cycle ----------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, compile, warm up and connect."""
        self.problem = ''
        self.mark_entities()
        try:
            self._configure()
        except SettingsError as error:
            self.problem = str(error)
        except Exception as error:
            self.problem = f'configure failed: {type(error).__name__}: {error}'
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
        self.offer_ready(self.team_topic('lockstep/ready'))

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start operation."""
        self.active = True
        self.start()
        self.await_peers()
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
        self.end_wait()

    def _disconnect(self) -> None:
        self.active = False
        if self._prepared:
            self._prepared = False
            try:
                self.tear_down()
            except Exception:
                self.get_logger().error(traceback.format_exc())  # continue with the rest
        self.configured = False
        self.forget_peers()
        self.clear_entities()
        self._parameters_read.release()

    def _on_restart(self, jump: float) -> None:
        text = f'the clock jumped back by {jump:.3f} s'
        if not self.active or self.settings.lockstep:
            # In lockstep the steps define the time.
            self.warn_throttled('clock', text)
            return
        self.get_logger().warning(f'{text}: the search starts again')
        self.reset()

    def check_peers(self) -> list[str]:
        """Also confirm jumps of the clock."""
        self._clock_watch.look()
        return super().check_peers()
