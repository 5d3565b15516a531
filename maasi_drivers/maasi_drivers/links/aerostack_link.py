"""A drone that Aerostack2 flies."""

from functools import partial
from typing import Any, cast

from action_msgs.msg import GoalStatus as ActionStatus
from rclpy.action.client import ActionClient
from rclpy.client import Client
from std_srvs.srv import SetBool

from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.agent.robot_topics import BatteryTopic
from maasi_drivers.agent.waypoint_follower import GoalStatus
from maasi_drivers.links.platform_link import PlatformLink
from maasi_filter.arrays import FloatArray
from maasi_filter.ros.conversions import point_to_ros
from maasi_filter.ros.qos import RELIABLE

_TAKE_OFF, _GO_TO, _LAND = 'TakeoffBehavior', 'GoToBehavior', 'LandBehavior'


class AerostackLink(PlatformLink):
    """A drone behind the behaviors of Aerostack2; see `PlatformLink`.

    Without a further goal it hovers at the last position. It lands only after a take-off.

    Subscribes
    ----------
    `/NAMESPACE/self_localization/pose` (geometry_msgs/PoseStamped), `platform/info`
    (as2_msgs/PlatformInfo), `sensor_measurements/battery` (sensor_msgs/BatteryState)

    Services
    --------
    client of `/NAMESPACE/set_arming_state`, `set_offboard_mode` (std_srvs/SetBool), and of the
    actions `TakeoffBehavior`, `GoToBehavior`, `LandBehavior` (as2_msgs)
    """

    system, package, parts = 'Aerostack2', 'as2_msgs', ('msg', 'action')
    source = 'https://github.com/aerostack2/aerostack2'
    frame, pose_topic = 'earth', 'self_localization/pose'
    lands_while_rising = False

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        self._info, self._states = cast(Any, None), self.messages.PlatformStatus
        # The latest goal of `GoToBehavior`: its number, and its handle once accepted.
        self._number, self._handle = 0, cast(Any, None)
        kind = self.orders
        kinds = {_TAKE_OFF: kind.Takeoff, _GO_TO: kind.GoToWaypoint, _LAND: kind.Land}
        self._actions = {
            name: driver.permanent(name, partial(ActionClient, driver, kind, self.full(name)))
            for name, kind in kinds.items()
        }
        self._switches: dict[str, Client] = {
            name: driver.create_client(SetBool, self.full(name))
            for name in ('set_arming_state', 'set_offboard_mode')
        }

    def connect(self) -> None:
        """Subscribe to pose, state and battery."""
        super().connect()
        topic, kind = self.full('platform/info'), self.messages.PlatformInfo
        self.driver.create_subscription(
            kind, topic, lambda message: setattr(self, '_info', message), RELIABLE
        )
        BatteryTopic(self.driver, self.full('sensor_measurements/battery'))

    def missing(self) -> str:
        """See `PlatformLink.missing`."""
        ready = {name: item.server_is_ready() for name, item in self._actions.items()}
        ready |= {name: item.service_is_ready() for name, item in self._switches.items()}
        return ', '.join(self.full(name) for name, there in ready.items() if not there)

    def aloft(self) -> bool | None:
        """See `PlatformLink.aloft`."""
        if self._info is None or self._info.status.state == self._states.EMERGENCY:
            return None
        return self._info.status.state not in (self._states.DISARMED, self._states.LANDED)

    def took_off(self, height: float) -> bool:
        """See `PlatformLink.took_off`; earlier goals are refused."""
        return self._info is not None and self._info.status.state == self._states.FLYING

    def fault(self) -> str:
        """See `PlatformLink.fault`."""
        if self._info is None:
            return f'no {self.full("platform/info")}'
        if self._info.status.state == self._states.EMERGENCY:
            return 'Aerostack2 reports an emergency'
        return '' if self._info.connected else 'Aerostack2 is not connected to the drone'

    def take_off(self, height: float) -> None:
        """See `PlatformLink.take_off`; first arm and take control where needed."""
        goal = self.orders.Takeoff.Goal(takeoff_height=height, takeoff_speed=self.platform.climb)
        wanted = {'set_arming_state': self._info.armed, 'set_offboard_mode': self._info.offboard}
        missing = [name for name, has in wanted.items() if not has]

        def proceed(future: Any = None) -> None:
            if future is not None and not future.result().success:
                self.failed('arming or offboard mode refused')
            elif self.stopped:
                self.failed('take-off stopped')
            elif missing:
                request = SetBool.Request(data=True)
                self._switches[missing.pop(0)].call_async(request).add_done_callback(proceed)
            else:
                self._actions[_TAKE_OFF].send_goal_async(goal).add_done_callback(answered)

        def answered(future: Any) -> None:
            if not future.result().accepted:
                self.failed('take-off refused')

        proceed()

    def go_to(self, target: FloatArray, yaw: float, distance: float) -> None:
        """See `PlatformLink.go_to`; a further goal replaces the present one."""
        goal = self.orders.GoToWaypoint.Goal(max_speed=self.driver.settings.motion.speed)
        goal.yaw.mode, goal.yaw.angle = self.messages.YawMode.FIXED_YAW, yaw
        goal.target_pose.header.frame_id = self.platform.frame or self.frame
        goal.target_pose.point = point_to_ros(target.tolist())
        self._number = number = self._number + 1
        future = self._actions[_GO_TO].send_goal_async(goal)
        future.add_done_callback(lambda answer: self._answered(number, answer.result()))

    def _answered(self, number: int, handle: Any) -> None:
        if not handle.accepted:
            if number == self._number:
                self.driver.end_goal(GoalStatus.ABORTED, 'Aerostack2 rejected the position')
        elif number == self._number:
            self._handle = handle
            result = handle.get_result_async()
            result.add_done_callback(lambda answer: self._finished(number, answer.result()))
        elif self._sent is None:
            handle.cancel_goal_async()  # it hovers since

    def _finished(self, number: int, answer: Any) -> None:
        if number == self._number and answer.status != ActionStatus.STATUS_SUCCEEDED:
            self.driver.end_goal(GoalStatus.ABORTED, 'Aerostack2 ended the flight to the position')

    def hover(self) -> None:
        """See `PlatformLink.hover`: the end of a goal."""
        self._number, handle, self._handle = self._number + 1, self._handle, None
        if handle is not None:
            handle.cancel_goal_async()

    def land(self, height: float) -> None:
        """See `PlatformLink.land`."""
        self.hover()
        self._actions[_LAND].send_goal_async(self.orders.Land.Goal(land_speed=self.platform.climb))
