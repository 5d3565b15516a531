"""Settings of the links to vehicles that take off."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from maasi_filter.arrays import FloatArray
from maasi_filter.settings import Finite, Intervals, Settings, Vector2

# Largest tilt setting of a Mambo [rad].
LEAST_TILT, MOST_TILT = math.radians(5.0), math.radians(25.0)


class FlightSettings(Settings):
    """Permissions and limits of vehicles that take off."""

    arm: bool = Field(
        False,
        description='Permit take-off, once per call of the service arm',
    )
    ground: Finite = Field(
        0.0, description='Map height of the ground or water surface at its start [m]'
    )
    geofence: Intervals | None = Field(
        None,
        min_length=3,
        max_length=3,
        description='Lowest and highest x, y, z of its targets. Default: the environment extended '
        'by the radius, in 2D from 1 m below to 1 m above its heights at the start; never below '
        'the ground for a start above it [m, map]',
    )


class DelayedFlightSettings(FlightSettings):
    """The same for vehicles that take off when they are ready, and report positions late."""

    arm_timeout: float = Field(
        60.0,
        gt=0.0,
        description='Time after the service arm within which it must take off or be armed; then a '
        'new call is needed [s]',
    )
    latency: float = Field(0.0, ge=0.0, le=1.0, description='Delay of positions [s]')


class MamboSettings(DelayedFlightSettings):
    """Connection and permissions of a Mambo."""

    address: str = Field(
        '192.168.99.3',
        min_length=1,
        description='IP address over WiFi, or Bluetooth address, as pyparrot takes them',
    )
    port: int = Field(
        43210,
        ge=1024,
        le=65535,
        description='UDP port of this host for messages of the drone',
    )
    order_port: int = Field(
        14701,
        ge=1,
        le=65535,
        description='UDP port of the program on board for orders, with link mambo_feed',
    )
    pose: Literal['events', 'odometry', 'pose'] = Field(
        'events',
        description='Source of its pose: its position events, or the topic odom '
        '(nav_msgs/Odometry) or pose (geometry_msgs/PoseStamped, in the map) of another system',
    )
    position_noise: float = Field(0.01, ge=0.0, description='Deviation of position events [m]')
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
        description='Steady speed at the largest tilt (motion.tilt), measured by measure_mambo; '
        'without it there is no take-off [m/s]',
    )
    delay: float = Field(
        0.2,
        ge=0.0,
        le=1.0,
        description='Delay from a piloting command to its acceleration [s]',
    )
    full_turn: float = Field(2.6, gt=0.0, le=7.0, description='Turn rate at full yaw [rad/s]')
    climb: float = Field(
        0.5, ge=0.5, le=2.0, description='Climb rate at full throttle, set in the drone [m/s]'
    )
    link_timeout: float = Field(
        1.0,
        ge=0.6,
        le=10.0,
        description='Time without link or pose after which it hovers; position events have a '
        'period of 0.5 s [s]',
    )
    land_after: float = Field(
        3.0, ge=0.0, description='Time without link or pose after which it lands [s]'
    )
    cancel_landing: float = Field(
        5.0,
        ge=0.0,
        description='Time without a new goal after a cancelled one after which it lands [s]',
    )
    take_off_timeout: float = Field(10.0, gt=0.0, description='Time limit of the take-off [s]')
    battery_minimum: float = Field(
        0.1, ge=0.0, lt=1.0, description='Charge below which it lands [1]'
    )

    def pose_covariance(self) -> FloatArray:
        """Return the covariance (6, 6) of a pose from the deviations [m^2, rad^2]."""
        return np.diag([self.position_noise**2] * 3 + [self.attitude_noise**2] * 3)


Ending = Literal['hold', 'land']


class MavlinkSettings(DelayedFlightSettings):
    """Connection and permissions of an autopilot."""

    url: str = Field(
        'udpin:127.0.0.1:14550',
        min_length=1,
        description="pymavlink's connection string: udpin:HOST:PORT, udpout:HOST:PORT, "
        'tcp:HOST:PORT or a serial device; udpin:0.0.0.0:PORT accepts the whole network',
    )
    baud: int = Field(57600, ge=1200, description='Baud rate of a serial device [1/s]')
    system: int = Field(1, ge=1, le=255, description='System id of the vehicle')
    own_system: int = Field(
        240,
        ge=1,
        le=255,
        description='Unique system id of the driver (ground stations use 255), which must be the '
        "autopilot's ground station (SYSID_MYGCS, MAV_GCS_SYSID)",
    )
    vehicle: Literal['copter', 'submarine'] = Field(
        'copter', description='Vehicle type; other types are not controlled'
    )
    require_failsafe: bool = Field(
        True,
        description='Arm only if the autopilot acts by itself on a link loss',
    )
    fence: Literal['upload', 'none'] = Field(
        default='upload', description='Upload the area as its fence; needs environment.origin'
    )
    origin: Literal['local', 'here'] = Field(
        'local',
        description="What is at `start` in the map: the origin of the autopilot's local frame, or "
        '(here) the first position of the vehicle after the autopilot was switched on',
    )
    map_yaw: Finite = Field(
        0.0, description='Direction of the x axis of the map, anticlockwise from east [rad]'
    )
    lead: float = Field(
        1.0,
        gt=0.0,
        le=5.0,
        description='Lead time of set-points; under ArduCopter the braking distance is added, so '
        'that the vehicle stops if none follows [s]',
    )
    setpoint_rate: float = Field(
        20.0, ge=4.0, le=100.0, description='Rate of set-points; PX4 needs more than 2 [1/s]'
    )
    position_rate: float = Field(
        20.0, ge=5.0, le=100.0, description='Requested rate of positions [1/s]'
    )
    link_timeout: float = Field(
        0.6, ge=0.3, le=10.0, description='Time without a message after which the link is lost [s]'
    )
    rise_timeout: float = Field(
        15.0,
        gt=0.0,
        description='Time without progress to its take-off height after which it lands [s]',
    )
    battery: int = Field(
        -1,
        ge=-1,
        le=255,
        description='Id of the monitored battery (BATTERY_STATUS.id); -1: the emptiest battery',
    )
    home_timeout: float = Field(
        30.0,
        ge=0.0,
        description='Time without a goal and without a rising charge at one of `chargers` after '
        'which it lands there; 0: it hovers [s]',
    )
    at_end: Ending = Field(
        'land',
        description='Action when the driver ends: hold its position or land; a submarine surfaces',
    )
    on_low_battery: Ending = Field('land', description='Action on a low battery, like at_end')

    @model_validator(mode='after')
    def _consistent(self) -> MavlinkSettings:
        if self.own_system == self.system:
            raise ValueError(
                f'own_system: got {self.own_system}, allowed is another one than of the vehicle'
            )
        return self


class PlatformSettings(FlightSettings):
    """Connection and permissions of a drone that another system flies."""

    namespace: str = Field(
        min_length=1,
        description='Namespace of its services and topics: the name of the Crazyflie in '
        "crazyswarm2, or of the drone in Aerostack2; another one than the robot's",
    )
    frame: str = Field(
        '',
        description='header.frame_id of its poses, which are map poses. Default: world with link '
        'crazyswarm2, earth with link aerostack2',
    )
    climb: float = Field(
        0.5, gt=0.0, le=5.0, description='Vertical speed of take-off and landing [m/s]'
    )
    lead: float = Field(
        1.0,
        ge=0.4,
        le=5.0,
        description='How far ahead the driver sends positions, as a flight time; the drone stops '
        'at the last one [s]',
    )
    voltages: Vector2 = Field(
        [3.7, 4.2],
        description='Battery voltages of a charge of 0 and of 1, with link crazyswarm2 [V]',
    )

    @model_validator(mode='after')
    def _rising(self) -> PlatformSettings:
        if self.voltages[0] >= self.voltages[1]:
            raise ValueError(f'voltages: got {self.voltages}, allowed is the lower one first')
        return self
