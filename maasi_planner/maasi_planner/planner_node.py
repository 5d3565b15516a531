"""The planner node: waypoints and measurements of each robot."""

import time
from functools import partial
from typing import Any

from nav_msgs.msg import Path
from rclpy.publisher import Publisher
from std_msgs.msg import Header

from maasi_filter.arrays import FloatArray
from maasi_filter.ros.clocks import Silence, StampGate
from maasi_filter.ros.conversions import stamp_from_ros, stamp_of_step, stamp_to_ros
from maasi_filter.ros.keep_outs import KeepOutTopic
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode
from maasi_filter.ros.qos import RELIABLE
from maasi_msgs.action import SearchTargets
from maasi_msgs.msg import AgentState, LockstepDone, LockstepStep, PlanDecision
from maasi_planner import warm_up
from maasi_planner.conversions import checked_state, decision_to_ros, path_to_ros
from maasi_planner.coordinator import Coordinator
from maasi_planner.homing import CUT_OFF
from maasi_planner.node.batches import Batches
from maasi_planner.node.battery_log import BatteryLog
from maasi_planner.node.filter_guard import FilterGuard, FoundKeeper
from maasi_planner.node.orders import Orders
from maasi_planner.node.other_planners import OtherPlanners
from maasi_planner.node.reports import Reports
from maasi_planner.node.search_action import SearchAction, offer_services
from maasi_planner.node.search_modes import Mode, SearchModes
from maasi_planner.node.team_goals import ReceivedState
from maasi_planner.node.views import PlannerViews
from maasi_planner.node_settings import PlannerNodeSettings
from maasi_planner.robot_plan import PresentRobot
from maasi_planner.terrain_frame import above_ground, decision_on_map

_CHECK_PERIOD = 0.1
# At shutdown: longest wait for answers to goals, which are then cancelled [s], and executor rounds
# for sending results.
_ANSWERS, _LAST_TASKS = 0.5, 5
_ANSWER_PATIENCE = 1.0  # period of republishing a batch without an update [s]
_REFUSAL_PATIENCE = 10.0  # simulated time in which every goal is refused, until it is an error [s]


class PlannerNode(LockstepLifecycleNode[PlannerNodeSettings]):
    """Plan for the whole team, or independently for one robot.

    In the namespace of its only robot, the node plans for that robot alone and exchanges
    destinations with the planners of the other robots. At each step they plan in the order of
    names, each with the destinations of the earlier ones.

    Subscribes
    ----------
    `<robot>/state` (maasi_msgs/AgentState), `filter_update` (maasi_msgs/FilterUpdate);
    `<robot>/destination` (geometry_msgs/PointStamped) of robots with their own planners;
    `found_targets` (maasi_msgs/FoundTargetArray, latched); `reports` (maasi_msgs/Report, latched):
    statements of persons that the filter has used; running freely, `/diagnostics`
    (diagnostic_msgs/DiagnosticArray): heartbeats of the publishers of `filter_update`; in lockstep
    `lockstep/step` (maasi_msgs/LockstepStep)

    Publishes
    ---------
    `measurement_batch` (maasi_msgs/MeasurementBatch): M_k;
    `found_targets/kept` (maasi_msgs/FoundTargetArray, latched): from the start, empty at first;
    `decisions` (maasi_msgs/PlanDecision): every candidate with its terms;
    `<robot>/plan` (nav_msgs/Path); `exploration` (latched; 2D: nav_msgs/OccupancyGrid, 3D:
    sensor_msgs/PointCloud2); `markers` (visualization_msgs/MarkerArray);
    `lockstep/done` (maasi_msgs/LockstepDone), in lockstep, once all batches have their updates;
    `<robot>/destination` (geometry_msgs/PointStamped), each step, if other planners exist

    Actions
    -------
    `<robot>/go_to` (maasi_msgs/GoToWaypoint), client; `search` (maasi_msgs/SearchTargets), server

    Services
    --------
    `search/start`, `pause`, `resume`, `home`, `stop` (std_srvs/Trigger) for the team, and
    `<robot>/search/...` for one robot; `search/keep_outs` (maasi_msgs/SetKeepOuts): changes the
    keep-outs, which the node publishes on `keep_outs` (maasi_msgs/KeepOuts, latched)
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('planner_node', PlannerNodeSettings, **options)

    def prepare(self) -> None:
        """Create the planner."""
        self._dimension = self.settings.environment.dimension
        self.modes = SearchModes(self.settings.robots)
        # Smallest jump of steps between states of a robot.
        longest = max(1.0, 2.0 * self.settings.state_timeout)
        self._jump = round(longest / self.settings.step)
        self.coordinator = Coordinator(self.settings)
        self.orders = Orders(self, self.coordinator, self.modes)
        self.others = OtherPlanners(self, self.coordinator.names, self._try_step)
        self.guard = FilterGuard(self)
        self.reports = Reports(self, lambda report: self.coordinator.use(report))
        self.batches = Batches(self, self.guard, self.reports, self._try_done)
        self._views = PlannerViews(self)
        self._reset_state()

    def _reset_state(self) -> None:
        self.states: dict[str, ReceivedState] = {}
        self._gates: dict[str, StampGate] = {}
        self._away: set[str] = set(self.coordinator.names)
        self.planned_step = -1
        self._expected: LockstepStep | None = None
        self.batches.reset(self.coordinator)
        self._decisions = 0
        # Running freely: why the robots are held, or empty.
        self.held = ''
        self._planning_time = 0.0
        self._batteries = BatteryLog(self)

    # ---- life cycle --------------------------------------------------------------------------

    def set_up(self) -> None:
        """Compile the kernels, create publishers, subscriptions and services."""
        warm_up()
        names = self.coordinator.names
        self._done_publisher: Publisher | None = None
        if self.settings.lockstep:
            self._done_publisher = self.create_publisher(
                LockstepDone, self.team_topic('lockstep/done'), RELIABLE
            )
            self.expect_subscribers(self._done_publisher)
            self.create_subscription(
                LockstepStep, self.team_topic('lockstep/step'), self._on_step, RELIABLE
            )
        # Before the publisher of batches: a filter must discover the retained targets first.
        self._keeper = FoundKeeper(self)
        self.reports.set_up()
        self.batches.set_up()
        self._decision_publisher = self.create_publisher(PlanDecision, 'decisions', RELIABLE)
        self._views.set_up()
        self._path_publishers = {}
        for name in names:
            self._path_publishers[name] = self.create_publisher(
                Path, self.team_topic(f'{name}/plan'), 10
            )
            self.create_subscription(
                AgentState,
                self.team_topic(f'{name}/state'),
                partial(self._on_state, name),
                RELIABLE,
            )
        self.others.set_up()
        self.guard.set_up()
        self.goals = self.orders.set_up(names, self._try_done)
        self._action = SearchAction(self, lambda: self._command('start', None), self._stand)
        offer_services(self, names, self._command)
        KeepOutTopic(self, lambda area: self.coordinator.adopt_area(area), True, 'search/keep_outs')
        self.create_wall_timer(_CHECK_PERIOD, self._check_team)

    def start(self) -> None:
        """Start the search if `search_on_start`."""
        if self.settings.search_on_start:
            self.modes.command('start')

    def halt(self) -> None:
        """End the search: the robots stop."""
        self._action.stop('the planner stops')
        self._stand()

    def _stand(self) -> None:
        self.modes.command('stop')
        self.orders.set_homing(self.coordinator.names, False)
        self.orders.stop(self.coordinator.names)

    def destroy_node(self) -> None:
        """Send the result of the search to its client, and shut down."""
        self.active = False
        if self.configured and self.executor is not None:
            deadline = time.monotonic() + _ANSWERS
            while self.goals.waiting and time.monotonic() < deadline:
                self.executor.spin_once(0.01)
            for _ in range(_LAST_TASKS):
                self.executor.spin_once(timeout_sec=0.0)
        super().destroy_node()

    def _restart(self, reason: str) -> None:
        self.get_logger().warning(f'{reason}: the search starts again')
        self.reset()
        self.step = -1

    def reset(self) -> None:
        """Begin a new search."""
        for name in self.coordinator.names:
            self.goals.cancel(name)
        self.goals.waiting.clear()
        self.coordinator = Coordinator(self.settings, self.coordinator.area.with_sightings(()))
        self.orders.reset(self.coordinator)
        for part in (self.others, self.guard, self._views, self.reports):
            part.reset()
        self._reset_state()
        self._keeper.forget()

    def fault(self) -> str:
        """Return why the robots are held, or that they accept no goals."""
        if self.held:
            return f'robots are held: {self.held}'
        if alarms := self._batteries.alarms:
            return '; '.join(f'{name}: {text}' for name, text in sorted(alarms.items()))
        refused = self.orders.refused_for
        return f'no goal accepted for {refused:.0f} s' if refused >= _REFUSAL_PATIENCE else ''

    def _command(self, word: str, names: list[str] | None) -> tuple[bool, str]:
        """Execute a command for robots (None: all); return whether it was accepted, and a text."""
        if not self.active:
            return False, 'the planner is not active'
        asked = self.coordinator.names if names is None else names
        follow = self.modes.command(word, names)
        if not follow:
            modes = self.modes.describe(asked)
            return False, f'{", ".join(asked)}: {modes}; {word} changes nothing'
        if word == 'start' and self.coordinator.finished is not None:
            self.coordinator.begin_again()
        if word in ('pause', 'stop', 'home'):
            self.orders.stop(follow)
        self.orders.set_homing(follow, word == 'home')
        if not self.modes.under_way:
            self._action.stop('stopped by search/stop')
        answer = f'{word}: {", ".join(follow)}'
        for name in follow:
            if name in self._away:
                received = self.states.get(name)
                why = received.reason if received is not None else f'no {name}/state yet'
                answer += f'; {name} is unavailable: {why or "no state received"}'
        for text in self.orders.warnings(follow):
            answer += f'; {text}, which continues'
        self.get_logger().info(answer)
        return True, answer

    def status(self) -> dict[str, Any]:
        """Return the state of the search."""
        return {
            'search': self.modes.describe(),
            'finished': self.coordinator.finished or '',
            'goals of other clients': self.orders.describe_external(),
            'robots': ', '.join(name for name in self.coordinator.names if name not in self._away),
            'decisions': self._decisions,
            'batches': self.batches.last,
            'explored': f'{self.coordinator.exploration.explored_fraction():.3f}',
            'last planning [ms]': f'{1e3 * self._planning_time:.2f}',
        }

    def warnings(self) -> list[str]:
        """Return warnings about goals of other clients and estimated charges."""
        return self.orders.warnings() + self.coordinator.homing.estimates()

    # ---- input -------------------------------------------------------------------------------

    def _on_step(self, message: LockstepStep) -> None:
        """Plan once all states of a step are there; a repeated step serves a restarted node."""
        if not self.active:
            return
        if message.step < self.step:
            self._restart(f'step {message.step} arrived after {self.step}')
        self.step = message.step
        before = self._expected
        if before is None and message.step == self.planned_step:
            self.batches.publish_again()
            # A robot that answers later receives a new goal.
            for name, _ in sorted(self.goals.waiting):
                self.orders.refuse(name)
            self.goals.waiting.clear()
            self._try_done()
            return
        if before is not None and message.step == before.step:
            message.imaging = sorted({*before.imaging, *message.imaging})
        self._expected = message
        self._try_step()

    def _on_state(self, name: str, message: AgentState) -> None:
        if not self.active:
            return
        try:
            state = checked_state(name, message, self.settings)
        except ValueError as error:
            self.drop('bad state', f'{name}/state.{error}')
            return
        gate = self._gates.setdefault(name, StampGate(self._jump))
        if not (self.settings.lockstep or gate.accepts(int(message.step))):
            self.drop(
                'bad state',
                f'{name}/state.step: read {message.step}, far from the previous one; allowed once '
                'the next state follows it',
            )
            return
        before = self.states.get(name)
        if before is not None and message.step < before.step:
            back = before.step - message.step
            if not self.settings.lockstep and back <= 1.0 / self.settings.step:
                self.drop(
                    'old state',
                    f'{name}/state.step: read {message.step}, allowed is from {before.step}',
                )
                return
            self._restart(f'{name}/state.step went back from {before.step} to {message.step}')
        goal = message.goal_id, message.goal_status, message.reason
        self.states[name] = ReceivedState(
            message.step, state, *goal, Silence(self), float(message.battery)
        )
        if self.settings.lockstep:
            self._try_step()
        else:
            self._update_availability(name, message.goal_status, message.reason)
            self._try_free_step()

    # ---- availability of robots and filter ---------------------------------------------------

    def _update_availability(self, name: str, status: int, reason: str) -> None:
        if status == AgentState.UNAVAILABLE:
            self._drop_robot(name, reason)
        elif name in self._away:
            self._away.discard(name)
            self.get_logger().info(f'{name} is available')

    def _drop_robot(self, name: str, reason: str) -> None:
        if name in self._away or self.ending:
            return
        self._away.add(name)
        self.orders.drop_robot(name)
        self.get_logger().warning(f'{name} is unavailable: {reason}')

    def _check_team(self) -> None:
        if not self.active or self.ending:
            return
        now = time.monotonic()
        if not self.settings.lockstep:
            for name in sorted(self.states):
                silent = self.states[name].silence.length
                if silent > self.settings.state_timeout:
                    self._drop_robot(name, f'no {name}/state for {silent:.1f} s')
            problem = self.guard.problem(now)
            if problem and not self.held:
                self.get_logger().error(f'{problem}: all robots are held')
                self.orders.hold(self.coordinator.names)
            elif self.held and not problem:
                self.get_logger().warning('the filter responds again: the search continues')
            self.held = problem
        waits = self.settings.lockstep or bool(self.held)
        if waits and now - self.batches.published_at > _ANSWER_PATIENCE:
            self.batches.publish_again()
        if not self.settings.lockstep:
            self._try_free_step()
        update = self.batches.update
        self._action.update(
            max(self.planned_step, 0) * self.settings.step,
            SearchTargets.Feedback(
                found=update.found,
                measurements=self.batches.measurements,
                decisions=self._decisions,
                expected_number=update.expected_number,
                explored=self.coordinator.exploration.explored_fraction(),
            ),
            self.coordinator.ended or '',
            not self.states or len(self._away) < len(self.coordinator.names),
        )

    # ---- a step ------------------------------------------------------------------------------

    def _try_step(self) -> None:
        expected = self._expected
        if expected is None:
            return
        step = int(expected.step)
        names = [name for name in expected.robots if name in self.coordinator.names]
        if any(name not in self.states or self.states[name].step != step for name in names):
            return
        if names and self.others.missing(step, expected.robots):
            return
        self._expected = None
        for name in self.coordinator.names:
            if name not in names:
                self._drop_robot(name, 'not in this step')
        for name in names:
            self._update_availability(name, self.states[name].status, self.states[name].reason)
        self._plan_step(
            step,
            stamp_from_ros(expected.stamp),
            set(expected.imaging),
            self.others.taken(step, expected.robots),
        )
        self.others.before = set(expected.robots)
        self._try_done()

    def _try_free_step(self) -> None:
        present = [name for name in self.coordinator.names if name not in self._away]
        if not present:
            return
        step = min(self.states[name].step for name in present)
        if step > self.planned_step:
            self._plan_step(
                step, stamp_of_step(step, self.settings.step), None, self.others.taken(step, None)
            )

    def _plan_step(
        self, step: int, stamp: int, imaging: set[str] | None, taken: list[tuple[FloatArray, float]]
    ) -> None:
        self.planned_step = step
        self.step = step
        header = Header(stamp=stamp_to_ros(stamp), frame_id=self.settings.frame)
        robots = {}
        for name in self.coordinator.names:
            if name in self._away:
                continue
            received = self.states[name]
            free = self.orders.is_free(name, received, step)
            state = above_ground(received.state, self.coordinator.area.terrain)
            if free and self.orders.send_home(name, state, header):
                free = False
            mode = self.modes.of[name]
            robots[name] = PresentRobot(
                state,
                free,
                received.charge,
                searches=mode is Mode.SEARCHING and not self.held,
                returns=mode not in (Mode.WAITING, Mode.STOPPED),
            )
        commanded = any(robot.returns for robot in robots.values())
        begin = time.perf_counter()
        decision = self.coordinator.plan(step, robots, taken) if commanded else None
        if decision is not None:
            self._planning_time = time.perf_counter() - begin
        self._batteries.report(self.coordinator.homing)
        known = self.coordinator.robots
        self.others.publish(
            header,
            {name: known[name].plan.destination(robot.state) for name, robot in robots.items()},
        )
        if not commanded:
            return
        if decision is not None:
            self._announce(decision, header)
        members = self.coordinator.measure(step, robots, imaging)
        if members:
            self.batches.publish(step, members, header)
        self._views.publish(self.coordinator, robots, header, stamp * 1e-9)

    def _announce(self, decision: Any, header: Header) -> None:
        self._decisions += 1
        indices = {name: self.coordinator.robots[name].plan.decision for name in decision.robots}
        shown = decision_on_map(decision, self.coordinator.area.terrain)
        self._decision_publisher.publish(
            decision_to_ros(
                shown,
                indices,
                self.settings.planner.name,
                self.batches.used,
                self.coordinator.exploration.explored_fraction(),
                header,
            )
        )
        if not decision.robots:
            found = self.batches.update.found
            self.get_logger().info(
                f'finished: the planner expects no further finds ({found} found): {decision.reason}'
            )
        for name in sorted(decision.robots):
            robot, plan = decision.robots[name], self.coordinator.robots[name].plan
            if robot.stays:
                # A robot that cannot come home needs attention.
                log = self.warn_throttled if CUT_OFF in robot.reason else self.tell_throttled
                log(f'{name} stays', f'{name} {robot.reason}')
                continue
            if plan.errand is not None:
                self.get_logger().info(f'{name} {robot.reason}')
                self.orders.interrupt_homing(name)
            self.orders.send(name, plan.goal_id, robot.waypoint, header)
            path = path_to_ros(shown.robots[name].positions, header)
            self._path_publishers[name].publish(path)

    def _try_done(self) -> None:
        if (
            self._done_publisher is not None
            and self._expected is None
            and self.planned_step >= 0
            and not self.goals.waiting
            and not self.batches.waiting
        ):
            self._done_publisher.publish(
                LockstepDone(node=self.get_fully_qualified_name(), step=self.planned_step)
            )
