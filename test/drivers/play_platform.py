"""Plays a drone of crazyswarm2 or Aerostack2, and prints a line for each order that it gets.

As in the sources of these systems, read in August 2026; their code is not used here.

- crazyswarm2 f6154e2: services and topics of crazyflie/src/crazyflie_server.cpp. The firmware flies
  polynomials of 7th order with no jerk at both ends; it takes off only from idle, and is idle when
  it has landed (crazyflie-firmware 0c9b014, src/modules/src/planner.c).
- Aerostack2 afc0c52: behaviors (as2_behavior, behavior_server__impl.hpp: a new goal replaces the
  present one, a cancelled one ends with hovering), the states of as2_core's
  platform_state_machine.cpp, arming and offboard mode of aerial_platform.cpp, which refuse what
  they are already, and the position plugins of as2_behaviors_motion.
"""

import contextlib
import json
import sys
import threading
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import BatteryState
from std_srvs.srv import SetBool

NAME, START = 'cf7', np.array([1.0, 1.2, 0.0])
PERIOD = 0.05


def say(event, **more):
    print(json.dumps({'event': event} | more) + '\n', end='', flush=True)


def polynomial(duration, start, velocity, acceleration, goal):
    """Return coefficients (8, 3): given start, at rest at the goal, without jerk at both ends."""
    power = np.arange(8)
    rows = []
    for t in (0.0, duration):
        factors = np.ones(8)
        for order in range(4):
            rows.append(factors * t ** np.maximum(power - order, 0))
            factors = factors * np.maximum(power - order, 0)
    zero = np.zeros(3)
    ends = [start, velocity, acceleration, zero, goal, zero, zero, zero]
    return np.linalg.solve(np.array(rows), np.array(ends))


class Drone(Node):
    """What both have: a pose, and the position that it flies to."""

    frame = topic = ''
    refused_landings = 0  # so many landings have no effect

    def refuses_landing(self):
        if self.refused_landings == 0:
            return False
        self.refused_landings -= 1
        say('landing refused')
        return True

    def __init__(self):
        super().__init__('platform', namespace=f'/{NAME}')
        self.position, self.yaw = START.copy(), 0.0
        self.guard = threading.RLock()
        quality = 10 if self.topic == 'pose' else qos_profile_sensor_data
        self.poses = self.create_publisher(PoseStamped, self.topic, quality)
        self.create_timer(PERIOD, self.tick)

    def tick(self):
        with self.guard:
            self.move()
            message = PoseStamped()
            message.header.frame_id = self.frame
            message.header.stamp = self.get_clock().now().to_msg()
            point, turn = message.pose.position, message.pose.orientation
            point.x, point.y, point.z = self.position.tolist()
            turn.z, turn.w = np.sin(0.5 * self.yaw), np.cos(0.5 * self.yaw)
        self.poses.publish(message)


class Crazyflie(Drone):
    """One of crazyswarm2."""

    frame, topic = 'world', 'pose'

    def __init__(self):
        from crazyflie_interfaces import msg, srv

        self.state, self.curve, self.began, self.duration = 'idle', None, 0.0, 0.0
        self.fastest = 0.0
        super().__init__()
        self.kind = msg.Status
        self.statuses = self.create_publisher(msg.Status, 'status', 10)
        self.create_service(srv.Takeoff, 'takeoff', self.take_off)
        self.create_service(srv.GoTo, 'go_to', self.go_to)
        self.create_service(srv.Land, 'land', self.land)
        self.create_service(srv.NotifySetpointsStop, 'notify_setpoints_stop', self.stop)
        self.create_timer(0.2, self.report)

    def report(self):
        kind = self.kind
        info = kind.SUPERVISOR_INFO_IS_ARMED | kind.SUPERVISOR_INFO_CAN_FLY
        info |= kind.SUPERVISOR_INFO_IS_FLYING * (self.state != 'idle')
        self.statuses.publish(kind(supervisor_info=info, battery_voltage=4.0))

    def planned(self, order=0):
        """Return the set-point, or its derivative."""
        if self.curve is None:
            return np.zeros(3) if order else self.position
        t = min(time.monotonic() - self.began, self.duration)
        power, factors = np.arange(8), np.ones(8)
        for step in range(order):
            factors = factors * np.maximum(power - step, 0)
        return (factors * t ** np.maximum(power - order, 0)) @ self.curve

    def move(self):
        self.position = np.array(self.planned())
        if self.state == 'flying':
            self.fastest = max(self.fastest, float(np.linalg.norm(self.planned(1))))
        if self.state == 'landing' and time.monotonic() - self.began >= self.duration:
            self.state, self.curve = 'idle', None
            say('landed', position=self.position.tolist(), fastest=self.fastest)

    def plan(self, goal, duration, state, moving=True):
        with self.guard:
            duration = duration.sec + 1e-9 * duration.nanosec
            derivatives = [moving * self.planned(order) for order in (1, 2)]
            curve = polynomial(duration, self.planned(), *derivatives, goal)
            self.curve, self.began, self.duration = curve, time.monotonic(), duration
            self.state = state
            say(state, goal=np.asarray(goal).tolist(), duration=duration)

    def take_off(self, request, response):
        if self.state == 'idle':
            goal = [*self.position[:2], request.height]
            self.plan(goal, request.duration, 'flying', moving=False)
        return response

    def go_to(self, request, response):
        if self.state == 'idle':
            say('flight from the ground')
            return response
        goal = np.array([request.goal.x, request.goal.y, request.goal.z])
        self.plan(goal + request.relative * self.planned(), request.duration, 'flying')
        self.yaw = request.yaw + request.relative * self.yaw
        return response

    def land(self, request, response):
        if self.state != 'landing' and not self.refuses_landing():
            goal = [*self.position[:2], request.height]
            self.plan(goal, request.duration, 'landing', moving=False)
        return response

    def stop(self, _, response):
        say('setpoints stop')
        return response


class Aerostack(Drone):
    """One of Aerostack2."""

    frame, topic = 'earth', 'self_localization/pose'

    def __init__(self):
        from as2_msgs import action, msg

        self.goal, self.speed, self.present = None, 0.0, {}
        super().__init__()
        self.kind, self.state = msg, msg.PlatformStatus.DISARMED
        self.armed = self.offboard = False
        self.infos = self.create_publisher(msg.PlatformInfo, 'platform/info', 10)
        self.batteries = self.create_publisher(
            BatteryState, 'sensor_measurements/battery', qos_profile_sensor_data
        )
        self.create_timer(0.1, self.report)
        self.create_service(SetBool, 'set_arming_state', self.arm)
        self.create_service(SetBool, 'set_offboard_mode', self.take_control)
        kinds = {
            'Takeoff': (action.Takeoff, self.take_off, msg.PlatformStatus.LANDED),
            'GoTo': (action.GoToWaypoint, self.go_to, msg.PlatformStatus.FLYING),
            'Land': (action.Land, self.land, msg.PlatformStatus.FLYING),
        }
        self.servers = [
            ActionServer(
                self,
                kind,
                f'{name}Behavior',
                lambda handle, name=name, start=start: self.run(name, start, handle),
                goal_callback=lambda _, name=name, state=state: self.accept(name, state),
                cancel_callback=lambda _: CancelResponse.ACCEPT,
            )
            for name, (kind, start, state) in kinds.items()
        ]

    def report(self):
        info = self.kind.PlatformInfo(connected=True, armed=self.armed, offboard=self.offboard)
        info.status.state = self.state
        self.infos.publish(info)
        self.batteries.publish(BatteryState(percentage=0.8))

    def arm(self, request, response):
        response.success = request.data != self.armed
        if response.success:
            self.armed = request.data
            status = self.kind.PlatformStatus
            self.state = status.LANDED if self.armed else status.DISARMED
            say('armed' if self.armed else 'disarmed')
        return response

    def take_control(self, request, response):
        response.success = request.data != self.offboard
        self.offboard = request.data
        say('offboard')
        return response

    def accept(self, name, state):
        good = self.state == state and self.armed and self.offboard
        good = good and not (name == 'Land' and self.refuses_landing())
        return GoalResponse.ACCEPT if good else GoalResponse.REJECT

    def move(self):
        if self.goal is None:
            return
        offset = self.goal - self.position
        away = float(np.linalg.norm(offset))
        self.position = self.position + offset * min(1.0, self.speed * PERIOD / max(away, 1e-9))

    def take_off(self, request):
        self.state, self.speed = self.kind.PlatformStatus.TAKING_OFF, request.takeoff_speed
        self.goal = self.position + np.array([0.0, 0.0, request.takeoff_height])

    def go_to(self, request):
        assert request.target_pose.header.frame_id == self.frame
        assert request.yaw.mode == self.kind.YawMode.FIXED_YAW
        point = request.target_pose.point
        self.yaw, self.speed = request.yaw.angle, request.max_speed
        self.goal = np.array([point.x, point.y, point.z])

    def land(self, request):
        self.state, self.speed = self.kind.PlatformStatus.LANDING, abs(request.land_speed)
        self.goal = np.array([*self.position[:2], 0.0])

    def run(self, name, start, handle):
        status = self.kind.PlatformStatus
        with self.guard:
            self.present[name] = handle
            start(handle.request)
            goal = self.goal
            say(name, goal=goal.tolist(), speed=self.speed)
        while np.linalg.norm(self.position - goal) > 0.02:
            time.sleep(0.02)
            if handle.is_cancel_requested:
                with self.guard:
                    # A landing repeats its references, which replace the one that hovers.
                    if self.present[name] is handle and self.state != status.LANDING:
                        self.goal = None
                    if name == 'Takeoff':
                        self.state = status.EMERGENCY
                handle.canceled()
                say(f'{name} cancelled')
                return handle.request and self.result(name)
            if self.present[name] is not handle:
                # rclcpp cancels the goal that its server lets go; rclpy cannot.
                handle.abort()
                return self.result(name)
        if name != 'GoTo':
            self.state = status.FLYING if name == 'Takeoff' else status.DISARMED
            self.armed = name == 'Takeoff'
        handle.succeed()
        say(f'{name} done', position=self.position.tolist())
        return self.result(name)

    def result(self, name):
        from as2_msgs import action

        return {'Takeoff': action.Takeoff, 'GoTo': action.GoToWaypoint, 'Land': action.Land}[
            name
        ].Result()


def main():
    rclpy.init()
    node = {'crazyswarm2': Crazyflie, 'aerostack2': Aerostack}[sys.argv[1]]()
    node.refused_landings = int(sys.argv[2])
    executor = MultiThreadedExecutor(8)
    executor.add_node(node)
    say('ready')
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()


if __name__ == '__main__':
    main()
