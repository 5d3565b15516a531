"""A Crazyflie that crazyswarm2 connects."""

import math
from typing import Any

import numpy as np
from rclpy.duration import Duration

from maasi_drivers.agent.robot_node import RobotNode
from maasi_drivers.links.platform_link import PlatformLink
from maasi_filter.arrays import FloatArray
from maasi_filter.ros.conversions import point_to_ros
from maasi_filter.ros.qos import sensor_reader

# The firmware flies a polynomial of 7th order from state to position (planner.c): from rest to
# rest its largest speed and acceleration are these times distance / time and distance / time^2. In
# a turn the speed before it adds a tenth.
_PEAK_SPEED, _PEAK_ACCELERATION = 1.1 * 35.0 / 16.0, 84.0 / (5.0 * math.sqrt(5.0))
_SHORTEST = 0.5  # shortest flight [s]
_LANDED = 0.04  # height above the ground to which it lands, as in crazyswarm2's examples [m]


class CrazyswarmLink(PlatformLink):
    """A Crazyflie behind crazyswarm2's server; see `PlatformLink`.

    Without a further `go_to` the firmware flies to the last position and hovers there.

    Subscribes
    ----------
    `/NAMESPACE/pose` (geometry_msgs/PoseStamped), `/NAMESPACE/status` (crazyflie_interfaces/Status)

    Services
    --------
    client of `/NAMESPACE/takeoff`, `go_to`, `land`, `notify_setpoints_stop` (crazyflie_interfaces)
    """

    system, package, parts = 'crazyswarm2', 'crazyflie_interfaces', ('msg', 'srv')
    source = 'https://github.com/IMRCLab/crazyswarm2'
    frame, pose_topic = 'world', 'pose'

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        self._status: Any = None
        srv = self.orders
        kinds = {
            'takeoff': srv.Takeoff,
            'go_to': srv.GoTo,
            'land': srv.Land,
            'notify_setpoints_stop': srv.NotifySetpointsStop,
        }
        self._clients = {
            name: driver.create_client(kind, self.full(name)) for name, kind in kinds.items()
        }

    def connect(self) -> None:
        """Subscribe to pose and status."""
        super().connect()
        topic = self.full('status')
        self.driver.create_subscription(
            self.messages.Status, topic, self._on_status, sensor_reader(False)
        )

    def _on_status(self, message: Any) -> None:
        self._status = message
        empty, full = self.platform.voltages
        charge = (message.battery_voltage - empty) / (full - empty)
        low = message.pm_state in (message.PM_STATE_LOW_POWER, message.PM_STATE_SHUTDOWN)
        if self.driver.active and math.isfinite(charge):
            self.driver.take_charge(0.0 if low else min(max(charge, 0.0), 1.0))

    def missing(self) -> str:
        """See `PlatformLink.missing`."""
        return ', '.join(
            client.srv_name for client in self._clients.values() if not client.service_is_ready()
        )

    def _has(self, *names: str) -> bool:
        status = self._status
        bits = sum(getattr(self.messages.Status, f'SUPERVISOR_INFO_{name}') for name in names)
        return status is not None and bool(status.supervisor_info & bits)

    def aloft(self) -> bool | None:
        """See `PlatformLink.aloft`."""
        return None if self._status is None else self._has('IS_FLYING')

    def fault(self) -> str:
        """See `PlatformLink.fault`."""
        if self._status is None:
            return ''  # crazyswarm2's simulation has none
        if self._has('IS_TUMBLED', 'IS_LOCKED'):
            return 'the Crazyflie has tumbled or is locked'
        if not self._has('IS_ARMED'):
            return f'the Crazyflie is not armed (service {self.namespace}/arm of crazyswarm2)'
        return ''

    def take_off(self, height: float) -> None:
        """See `PlatformLink.take_off`."""
        request = self.orders.Takeoff.Request(height=self.platform.ground + height)
        self._call('takeoff', request, _PEAK_SPEED * height / self.platform.climb)

    def go_to(self, target: FloatArray, yaw: float, distance: float) -> None:
        """See `PlatformLink.go_to`."""
        motion = self.driver.settings.motion
        duration = _PEAK_SPEED * distance / motion.speed
        if motion.acceleration is not None:
            shortest = math.sqrt(_PEAK_ACCELERATION * distance / motion.acceleration)
            duration = max(duration, shortest)
        request = self.orders.GoTo.Request(goal=point_to_ros(target.tolist()), yaw=yaw)
        self._call('go_to', request, duration)

    def hover(self) -> None:
        """Fly to its present set-point, which needs no pose."""
        request = self.orders.GoTo.Request(relative=True, goal=point_to_ros(np.zeros(3).tolist()))
        self._call('go_to', request, self.platform.lead)

    def land(self, height: float) -> None:
        """See `PlatformLink.land`; first end set-points that another program may have streamed."""
        stop = self.orders.NotifySetpointsStop.Request()
        self._clients['notify_setpoints_stop'].call_async(stop)
        request = self.orders.Land.Request(height=self.platform.ground + _LANDED)
        self._call('land', request, _PEAK_SPEED * height / self.platform.climb)

    def _call(self, name: str, request: Any, duration: float) -> None:
        request.duration = Duration(seconds=max(duration, _SHORTEST)).to_msg()
        self._clients[name].call_async(request)
