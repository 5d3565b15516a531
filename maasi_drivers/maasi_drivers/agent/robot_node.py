"""The node of one robot, as its link, its sensor and the parts of its driver see it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from maasi_drivers.agent.arrival_clock import ArrivalClock
from maasi_drivers.agent.driver_settings import DriverSettings
from maasi_drivers.agent.health import BATTERY, STOP, Health
from maasi_drivers.agent.odometry import MapOdometry, PoseHistory, StampedPose
from maasi_drivers.agent.waypoint_follower import GoalStatus, WaypointFollower
from maasi_drivers.vision.measurement_feed import FeedPeer
from maasi_filter.models.pose import Pose
from maasi_filter.ros.clocks import JUMP, Silence, StampGate
from maasi_filter.ros.lifecycle_node import LockstepLifecycleNode

_POSE_NAMES = {'odometry': 'odometry', 'tf': 'pose on tf', 'pose': 'pose'}


class RobotNode(LockstepLifecycleNode[DriverSettings], ABC):
    """The state that link, sensor and the parts of a driver share, and where they report to.

    All of it is made anew in *configure*.

    Attributes
    ----------
    robot : str
        Name, the last part of the namespace.
    start_pose : Pose
        Where its odometry is zero, in the map.
    history : PoseHistory
        Its latest poses.
    health : Health
        Its faults.
    follower : WaypointFollower
        Its present goal.
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

    def __init__(self, **options: Any) -> None:
        super().__init__('driver', DriverSettings, in_robot=True, **options)
        self.namespace = self.get_namespace().strip('/')
        self.robot = self.namespace.rpartition('/')[2]

    def prepare(self) -> None:
        """Make the shared state."""
        settings = self.settings
        self.dimension = settings.environment.dimension
        self.bounds = settings.environment.array()
        self.sensor = settings.sensor.build(self.robot, self.dimension)
        self.start_pose = Pose.from_yaw(settings.start, settings.yaw)
        self.history = PoseHistory()
        self.health = Health(self._on_fault)
        self.silence = Silence(self)
        self.arrivals = ArrivalClock()
        self.map_odometry: MapOdometry | None = None
        self.pose_name = _POSE_NAMES[settings.poses]
        self.feed_peer: FeedPeer | None = None
        # Slow odometry is not a jump.
        self._gate = StampGate(max(JUMP, round(2e9 * settings.odometry_timeout)))

    def step_of(self, stamp: int) -> int:
        """Return the step of a stamp [ns]."""
        return round(stamp * 1e-9 / self.settings.step)

    def is_new_pose(self, what: str, stamp: int) -> bool:
        """Return whether a pose of this stamp is to be used; one far back restarts the driver.

        Parameters
        ----------
        what : str
            Topic and field, for messages.
        stamp : int
            [ns].
        """
        if not (self.settings.lockstep or self._gate.accepts(stamp)):
            self.drop(
                'odometry stamp',
                f'{what}: read {stamp} ns, which is far from the one before; allowed if the next '
                'one follows it',
            )
            return False
        latest = self.history.latest
        if latest is None or stamp > latest.stamp:
            return True
        if self.restart_if_back(what, stamp):
            return True
        if stamp < latest.stamp or not self.settings.lockstep:
            self.drop(
                'odometry stamp',
                f'{what}: read {stamp} ns, allowed are stamps after {latest.stamp} ns',
            )
        return False

    def restart_if_back(self, what: str, stamp: int) -> bool:
        """Restart the driver if a stamp [ns] is far before the latest pose's; return whether."""
        latest = self.history.latest
        if latest is None or latest.stamp - stamp <= JUMP:
            return False
        self.get_logger().warning(
            f'{what} jumped back by {1e-9 * (latest.stamp - stamp):.3f} s: starting anew'
        )
        self.reset()
        return True

    @abstractmethod
    def take_pose(self, placed: StampedPose) -> None:
        """Take the robot's pose, later than all before; the next command is sent with it."""

    def refuse_pose(self, stamp: int) -> None:
        """Note that the odometry of a stamp [ns] could not be used."""

    @abstractmethod
    def take_charge(self, charge: float) -> None:
        """Take the charge of the battery, 0 to 1; anything else is unknown."""

    @abstractmethod
    def take_frame(self, topic: str, stamp: int, data: Any, *, repeated: bool = False) -> None:
        """Take an image or sweep.

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
        """End the present goal, if there is one."""

    @abstractmethod
    def publish_fault(self) -> None:
        """Publish `state` with the fault of a robot that has no pose yet."""

    def judge(self, kind: str, problem: str, recovered: str) -> None:
        """Begin or end a fault by what a link reports.

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
            if self.health.begin(kind, problem):
                self.get_logger().warning(problem)
        elif self.health.end(kind):
            self.get_logger().info(recovered)
            # The position that it held is outdated.
            self.follower.stay()

    def arm_problem(self) -> str:
        """Return why a robot that flies must not take off; empty where nothing is known."""
        if not self.active:
            return 'the driver is not active'
        return self.health.get(STOP) or self.health.get(BATTERY)

    def _on_fault(self, text: str) -> None:
        self.end_goal(GoalStatus.ABORTED, text)
        self.follower.let_go()
