"""Settings of the links to a Parrot Mambo and to a vehicle that speaks MAVLink."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from maasi_filter.arrays import FloatArray
from maasi_filter.settings import Finite, Intervals, Settings

# Tilt that a Mambo lets itself be set to [rad].
LEAST_TILT, MOST_TILT = math.radians(5.0), math.radians(25.0)


class FlightSettings(Settings):
    """What a driver may have any vehicle do that takes off."""

    arm: bool = Field(
        False,
        description='Whether the driver may let it take off: each time the service arm is called, '
        'and never without',
    )
    arm_timeout: float = Field(
        60.0,
        gt=0.0,
        description='Time after the service arm in which it has to take off, or to be armed; then '
        'it is to be called again [s]',
    )
    ground: Finite = Field(
        0.0, description='Height in the map of the ground, or the surface, at its start [m]'
    )
    latency: float = Field(0.0, ge=0.0, le=1.0, description='Age of a position when it arrives [s]')
    geofence: Intervals | None = Field(
        None,
        min_length=3,
        max_length=3,
        description='Lowest and highest x, y and z that it is sent to; none: the environment with '
        'the radius around it, in the plane 1 m above and below its heights at the start; for what '
        'starts above the ground, not below that [m, map]',
    )


class MamboSettings(FlightSettings):
    """How the driver reaches a Mambo, and what it may have it do."""

    address: str = Field(
        '192.168.99.3',
        min_length=1,
        description='IP address over WiFi, or Bluetooth address, as pyparrot takes them',
    )
    port: int = Field(
        43210,
        ge=1024,
        le=65535,
        description='UDP port on which the drone is heard, on the address of this host that '
        'faces it',
    )
    order_port: int = Field(
        14701,
        ge=1,
        le=65535,
        description='UDP port on which the program on board hears orders, with link mambo_feed',
    )
    pose: Literal['events', 'odometry', 'pose'] = Field(
        'events',
        description='Where its pose comes from: its own position events, or a topic of another '
        'system, odom (nav_msgs/Odometry) or pose (geometry_msgs/PoseStamped, in the map)',
    )
    position_noise: float = Field(
        0.01, ge=0.0, description="Deviation of a position event's numbers [m]"
    )
    position_growth: float = Field(
        0.04,
        ge=0.0,
        description='Deviation of the position after each second of dead reckoning [m/s]',
    )
    attitude_noise: float = Field(
        0.02, ge=0.0, description='Deviation of roll, pitch and heading [rad]'
    )
    full_speed: float | None = Field(
        None,
        gt=0.0,
        le=10.0,
        description='Steady speed at the largest tilt, motion.tilt, as measure_mambo measures it; '
        'none: it does not take off [m/s]',
    )
    delay: float = Field(
        0.2,
        ge=0.0,
        le=1.0,
        description='From a piloting command to the acceleration that it makes [s]',
    )
    full_turn: float = Field(2.6, gt=0.0, le=7.0, description='Turn rate at full yaw [rad/s]')
    climb: float = Field(
        0.5, ge=0.5, le=2.0, description='Climb at full throttle, set in the drone [m/s]'
    )
    link_timeout: float = Field(
        1.0,
        ge=0.6,
        le=10.0,
        description='Silence after which link or pose are lost: it hovers; events come every 0.5 s '
        '[s]',
    )
    land_after: float = Field(
        3.0, ge=0.0, description='Time without link or pose after which it lands [s]'
    )
    cancel_landing: float = Field(
        5.0,
        ge=0.0,
        description='Time after a cancelled goal, without another one, after which it lands [s]',
    )
    take_off_timeout: float = Field(
        10.0, gt=0.0, description='Time in which it has to take off [s]'
    )
    battery_minimum: float = Field(
        0.1, ge=0.0, lt=1.0, description='Charge below which it lands [1]'
    )

    def pose_covariance(self) -> FloatArray:
        """Return the covariance (6, 6) of a pose, by the settings' deviations [m^2, rad^2]."""
        return np.diag([self.position_noise**2] * 3 + [self.attitude_noise**2] * 3)


Ending = Literal['hold', 'land']


class MavlinkSettings(FlightSettings):
    """How the driver reaches an autopilot, and what it may have it do."""

    url: str = Field(
        'udpin:127.0.0.1:14550',
        min_length=1,
        description='As pymavlink has it: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or the '
        'name of a serial device; udpin:0.0.0.0:PORT is heard from the whole network',
    )
    baud: int = Field(57600, ge=1200, description='Of a serial device [1/s]')
    system: int = Field(1, ge=1, le=255, description='System id of the vehicle')
    own_system: int = Field(
        240,
        ge=1,
        le=255,
        description='System id of the driver, of nobody else (ground stations have 255); the '
        'autopilot must have it as its ground station (SYSID_MYGCS, MAV_GCS_SYSID)',
    )
    vehicle: Literal['copter', 'submarine'] = Field(
        'copter', description='What it is; another one is left alone'
    )
    require_failsafe: bool = Field(
        True,
        description='Whether it is armed only if the autopilot acts by itself when the link is cut',
    )
    fence: Literal['upload', 'none'] = Field(
        default='upload', description='Whether the area is its fence; needs environment.origin'
    )
    origin: Literal['local', 'here'] = Field(
        'local',
        description='What stands at the start in the map: the origin of the local frame of the '
        'autopilot, or the vehicle when the driver first hears its position, which is kept until '
        'the autopilot is restarted',
    )
    map_yaw: Finite = Field(
        0.0, description='Direction of the x axis of the map, from east to the left [rad]'
    )
    lead: float = Field(
        1.0,
        gt=0.0,
        le=5.0,
        description='Setpoints are as far ahead as it flies in this time, under ArduCopter also as '
        'it needs to brake, so that it stops by itself where none follows [s]',
    )
    setpoint_rate: float = Field(
        20.0, ge=4.0, le=100.0, description='Setpoints; PX4 needs more than 2 [1/s]'
    )
    position_rate: float = Field(
        20.0, ge=5.0, le=100.0, description='Positions asked of the autopilot [1/s]'
    )
    link_timeout: float = Field(
        0.6, ge=0.3, le=10.0, description='Silence after which the link is lost [s]'
    )
    rise_timeout: float = Field(
        15.0,
        gt=0.0,
        description='Time without coming nearer to its height at the start after which it lands '
        '[s]',
    )
    battery: int = Field(
        -1,
        ge=-1,
        le=255,
        description='Id of the battery that counts (BATTERY_STATUS.id); -1: the emptiest of all',
    )
    home_timeout: float = Field(
        30.0,
        ge=0.0,
        description='Time without a goal at one of `chargers` in which its charge does not rise, '
        'after which it lands there; 0: it hovers [s]',
    )
    at_end: Ending = Field(
        'land',
        description='What it does when the driver ends: hold its position, or land; a submarine '
        'surfaces',
    )
    on_low_battery: Ending = Field('land', description='The same with a low battery')

    @model_validator(mode='after')
    def _consistent(self) -> MavlinkSettings:
        if self.own_system == self.system:
            raise ValueError(
                f'own_system: got {self.own_system}, allowed is another one than of the vehicle'
            )
        return self
