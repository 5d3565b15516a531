"""The node of a robot, as seen by its link, sensor and the parts of its driver."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.impl.rcutils_logger import RcutilsLogger
from std_srvs.srv import Trigger

from maasi_drivers.agent.odometry import MapOdometry, PoseHistory, StampedPose
from maasi_drivers.agent.robot_frames import RobotFrames
from maasi_drivers.agent.waypoint_follower import GoalStatus, WaypointFollower
from maasi_drivers.settings.driver import DriverSettings
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.operating_volume import OperatingVolume
from maasi_filter.models.pose import Pose
from maasi_filter.ros.clocks import JUMP, ArrivalClock, Silence, StampGate
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode

# Kinds of faults of all robots.
ODOMETRY, FROZEN_POSE, SENSOR = 'odometry', 'frozen pose', 'sensor'
AREA, BATTERY, STOP = 'area', 'battery', 'stop'


class Health:
    """The current faults of a robot; without any it can follow goals."""

    def __init__(self, logger: RcutilsLogger, on_fault: Callable[[str], None]) -> None:
        self._logger, self._on_fault = logger, on_fault
        self._faults: dict[str, str] = {}

    def __contains__(self, kind: str) -> bool:
        return kind in self._faults

    @property
    def text(self) -> str:
        """All faults; empty without any."""
        return '; '.join(self._faults.values())

    def get(self, kind: str) -> str:
        """Return the text of a fault, or an empty text."""
        return self._faults.get(kind, '')

    def begin(self, kind: str, text: str) -> bool:
        """Set a fault or its text; return whether it is new, and log it then."""
        new = kind not in self._faults
        self._faults[kind] = text
        if new:
            self._logger.warning(f'{text}: refusing goals')
            self._on_fault(text)
        return new

    def end(self, kind: str, recovered: str = '') -> bool:
        """Clear a fault; return whether it was set, and log the recovery then."""
        was = self._faults.pop(kind, None) is not None
        if was and recovered:
            self._logger.info(recovered)
        return was


@dataclass(frozen=True)
class FeedPeer:
    """The accepted sender of a measurement feed: its address, and the receiver of its poses."""

    address: str
    on_pose: Callable[[int, Any], None]


class RobotNode(LockstepLifecycleNode[DriverSettings], ABC):
    """The shared state of link, sensor and parts of a driver, and what they report to.

    *configure* creates all of it, except `arrivals`.

    Attributes
    ----------
    robot : str
        Name, the last part of the namespace.
    volume : OperatingVolume
        Where it may be; its link may limit it further.
    start_pose : Pose
        Where its odometry is zero, in the map.
    history : PoseHistory
        Its latest poses.
    health : Health
        Its faults.
    follower : WaypointFollower
        Its present goal.
    frames : RobotFrames
        Where frames are, by tf.
    silence : Silence
        Time since the last pose.
    arrivals : ArrivalClock
        Stamps for data without one.
    map_odometry : MapOdometry or None
        Where its odometry frame is in the map, once known.
    pose_name : str
        What its poses are called in messages.
    feed_peer : FeedPeer or None
        The only sender whose measurement feed is used; none: any.
    """

    follower: WaypointFollower
    frames: RobotFrames

    def __init__(self, **options: Any) -> None:
        super().__init__('driver', DriverSettings, in_robot=True, **options)
        self.namespace = self.get_namespace().strip('/')
        self.robot = self.namespace.rpartition('/')[2]
        self.arrivals = ArrivalClock(self.get_clock())

    def destroy_node(self) -> None:
        """Destroy the entities of the node."""
        self.arrivals.close()
        super().destroy_node()

    def prepare(self) -> None:
        """Create the shared state."""
        settings = self.settings
        self.dimension = settings.environment.dimension
        self.volume = OperatingVolume(Area(settings.environment), settings.radius)
        self.sensor = settings.sensor.build(self.robot, self.dimension)
        self.start_pose = Pose.from_yaw(self.volume.area.above_ground(settings.start), settings.yaw)
        self.history = PoseHistory()
        self.health = Health(self.get_logger(), self._on_fault)
        self.silence = Silence(self)
        self.map_odometry: MapOdometry | None = None
        self.pose_name = 'pose on tf' if settings.poses == 'tf' else settings.poses
        self.feed_peer: FeedPeer | None = None
        # Slow odometry is not a jump.
        self._gate = StampGate(max(JUMP, round(2e9 * settings.odometry_timeout)))

    def step_of(self, stamp: int) -> int:
        """Return the step of a stamp [ns]."""
        return round(stamp * 1e-9 / self.settings.step)

    def is_new_pose(self, what: str, stamp: int) -> bool:
        """Return whether to use a pose with a stamp [ns]; a far earlier one restarts the driver."""
        if not (self.settings.lockstep or self._gate.accepts(stamp)):
            self.drop(
                'odometry stamp',
                f'{what}: read {stamp} ns, far from the previous one; accepted if the next one '
                'follows it',
            )
            return False
        latest = self.history.latest
        if latest is None or stamp > latest.stamp:
            return True
        if self.restart_if_back(what, stamp):
            return True
        if self.settings.lockstep:
            self.answer_again()
        else:
            self.drop(
                'odometry stamp',
                f'{what}: read {stamp} ns, allowed are stamps after {latest.stamp} ns',
            )
        return False

    def restart_if_back(self, what: str, stamp: int) -> bool:
        """Restart the driver if a stamp [ns] is far before the latest pose; return whether."""
        latest, least = self.history.latest, 0 if self.settings.lockstep else JUMP
        if latest is None or latest.stamp - stamp <= least:
            return False
        self.get_logger().warning(
            f'{what} jumped back by {1e-9 * (latest.stamp - stamp):.3f} s: restarting'
        )
        self.reset()
        return True

    @abstractmethod
    def restart(self, reason: str) -> None:
        """Stop the robot and discard what is known of its motion, for a reason."""

    @abstractmethod
    def take_pose(self, placed: StampedPose) -> None:
        """Handle the robot's pose, later than all before; the next command uses it."""

    def refuse_pose(self, stamp: int) -> None:
        """Note that the odometry with a stamp [ns] was unusable."""

    def answer_again(self) -> None:
        """Answer repeated odometry in lockstep: a restarted peer missed the answer."""

    @abstractmethod
    def take_charge(self, charge: float) -> None:
        """Update the battery charge, 0 to 1; other values are unknown."""

    @abstractmethod
    def receive_frame(self, topic: str, stamp: int, data: Any, *, repeated: bool = False) -> None:
        """Handle an image or sweep.

        Parameters
        ----------
        topic : str
            Its source, for messages.
        stamp : int
            [ns].
        data : object
            For `SensorInput.detect`.
        repeated : bool
            Whether it equals the one before to the bit, as from a sensor that hangs.
        """

    @abstractmethod
    def end_goal(self, status: GoalStatus, reason: str) -> None:
        """End the current goal, if any."""

    @abstractmethod
    def publish_fault(self) -> None:
        """Publish `state` with the fault of a robot without a pose."""

    def judge(self, kind: str, problem: str, recovered: str) -> None:
        """Begin or end a fault that a link reports.

        Parameters
        ----------
        kind : str
            Of the fault.
        problem : str
            Why the robot cannot follow goals; empty where it can.
        recovered : str
            Logged when the fault ends.
        """
        if problem:
            self.health.begin(kind, problem)
        elif self.health.end(kind, recovered):
            self.follower.stay()  # the held position is outdated

    def offer_arm(self, arm: Callable[[], str], in_air: Callable[[], bool] = lambda: False) -> None:
        """Offer the service `arm` of a robot that takes off, or is taken over `in_air`."""

        def answer(_: Trigger.Request) -> tuple[bool, str]:
            problem = '' if self.active else 'the driver is not active'
            problem = problem or self.health.get(STOP) or self.health.get(BATTERY) or arm()
            if problem:
                self.get_logger().warning(f'arm: refused: {problem}')
                return False, problem
            message = 'taking off as soon as it is ready'
            if in_air():
                message = 'in the air: taking control at its position'
            self.get_logger().info(f'arm: {message}')
            return True, message

        self.offer_service('arm', answer)

    def _on_fault(self, text: str) -> None:
        self.end_goal(GoalStatus.ABORTED, text)
        self.follower.let_go()
