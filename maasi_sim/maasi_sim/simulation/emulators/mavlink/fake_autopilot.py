"""A fake autopilot, which answers MAVLink 2 as ArduCopter, ArduSub or PX4 do.

The behaviour of ArduCopter is that of its source: the height of NAV_TAKEOFF is above home
(`ModeGuided::do_user_takeoff_start_m`), home is set at arming (`AP_Arming_Copter::arm`), a take-off
is refused in the air (`Mode::do_user_takeoff_U_m`) and ends within a tenth of its height
(`_AutoTakeoff::run`), EXTENDED_SYS_STATE tells take-off from flight
(`GCS_MAVLINK_Copter::landed_state`), and the ground station failsafe looks at the system id of
heartbeats alone (`GCS::sysid_is_gcs`). Positions that it reports are from the EKF's origin, which
is where the vehicle is when the EKF starts, also after a restart. Between set-points it flies as in
`GuidedFlight`. A destination outside of its fence is rejected without a word, in any FENCE_ACTION
(`ModeGuided::set_destination`), a velocity is not (`set_velaccel`); POSITION_TARGET_LOCAL_NED
reports what was accepted last (`send_position_target_local_ned`). A breach of the fence takes the
mode of FENCE_ACTION once (`Copter::fence_checks_async`).
"""

import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from maasi_drivers.links.mavlink.estimate import (
    swap_enu_ned,
    swap_flu_frd,
    swap_orientation,
    swap_yaw,
)
from maasi_drivers.links.mavlink.firmware import ARDUCOPTER, FIRMWARES, PX4_COPTER
from maasi_drivers.links.mavlink.protocol import mavlink
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_sim.simulation.emulators.mavlink.autopilot_settings import (
    WHOLE_NUMBERS,
    AutopilotSettings,
)
from maasi_sim.simulation.emulators.mavlink.fake_fence import ACTIONS, FakeFence
from maasi_sim.simulation.emulators.mavlink.fake_gnss import FakeGnss
from maasi_sim.simulation.emulators.mavlink.flight_model import FlightModel
from maasi_sim.simulation.emulators.mavlink.guided_flight import GuidedFlight, ReturnFlight

_DISARM_DELAY = 10.0  # ArduCopter disarms on the ground after so long [s]
# PX4 wants setpoints for so long, and not so long ago, before OFFBOARD [s].
_OFFBOARD_STREAM, _OFFBOARD_AGE = 1.0, 0.5
_LANDING, _SURFACING = 0.5, 0.3
_POSITION_IGNORED, _VELOCITY_IGNORED, _YAW_IGNORED = 0b111, 0b111 << 3, 1 << 10
_ONLY_POSITION, _ONLY_VELOCITY = 0xDF8, 0xDC7  # masks of POSITION_TARGET_LOCAL_NED
_FENCE_PERIOD = 0.1  # between two looks at the fence [s]
_ACCEPTED, _FAILED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_FAILED


class FakeAutopilot:
    """One vehicle with its autopilot, without a connection and a clock.

    A setpoint that is not finite crashes it, as it did ArduPilot. For tests: messages that do not
    come, position and velocity sent instead of the true ones.
    """

    def __init__(
        self, settings: AutopilotSettings, sender: Any, yaw: float, generator: np.random.Generator
    ) -> None:
        self.settings = settings
        self.firmware = FIRMWARES[settings.firmware]
        self.parameters = settings.all_parameters()
        submarine = self.firmware.kind == 'submarine'
        self.body = FlightModel(
            np.array([0.0, 0.0, -settings.depth if submarine else 0.0]),
            yaw,
            submarine,
            settings.speed,
            settings.acceleration,
        )
        self._guided = (
            GuidedFlight(self.body, self.parameters) if self.firmware is ARDUCOPTER else None
        )
        self.fence = FakeFence(sender, self.parameters)
        self.now = self._fence_at = 0.0
        self.capabilities = mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
        self.armed = False
        self.crashed = ''
        self.charge = settings.charge
        self.set_mode('MANUAL' if self.firmware is PX4_COPTER else 'STABILIZE')
        self._first_mode = self.mode
        self.gnss: FakeGnss = FakeGnss(sender, settings.second_gnss)
        self.muted: set[str] = set()
        self.frozen: tuple[float, ...] | None = None
        # Error of the estimated height, and true place of the EKF's origin [m].
        self.height_error = 0.0
        self.origin = np.zeros(3)
        self._sender, self._generator = sender, generator
        self._return_flight = ReturnFlight(self.body)
        self._home = 0.0  # true height at arming [m]
        # Start of the uninterrupted setpoint stream, and time of its last setpoint.
        self._streaming_since, self._streamed_at = math.inf, -math.inf
        self._armed_at = -math.inf
        self._station_at = math.inf
        self._failed: set[str] = set()
        self._reported_ready = False
        self._reset_messages()

    def _reset_messages(self) -> None:
        self._sent_at: dict[str, float] = {}
        self.periods = dict.fromkeys(
            ('HEARTBEAT', 'BATTERY_STATUS', 'EXTENDED_SYS_STATE', 'GPS_RAW_INT'), 1.0
        )
        self.periods |= {'LOCAL_POSITION_NED': 0.25, 'ATTITUDE_QUATERNION': 0.25}
        if self.firmware is not PX4_COPTER:
            self.periods['EKF_STATUS_REPORT'] = 1.0
        if self._guided is not None:
            self.periods['FENCE_STATUS'] = 1.0

    @property
    def mode_name(self) -> str:
        """Its mode."""
        return self.firmware.mode_name(self.mode)

    @property
    def ready(self) -> bool:
        """Whether it has started to estimate its position."""
        return self.now >= self.settings.estimator_time

    @property
    def offset(self) -> FloatArray:
        """The position that it believes, less the true one, ENU [m]."""
        return np.array([0.0, 0.0, self.height_error]) - self.origin

    def restart(self) -> None:
        """Restart, as after a brown-out: disarmed, with clock and message rates reset."""
        self.armed = self._reported_ready = False
        # The barometer is calibrated again.
        self.now = self.height_error = 0.0
        self.set_mode(self._first_mode)
        self._reset_messages()

    def set_mode(self, mode: int | str) -> None:
        """Set the mode, by number or name, and hold the position in it."""
        if isinstance(mode, str):
            mode = next(key for key, name in self.firmware.modes.items() if name == mode)
        self.mode = mode
        self._rising_to: float | None = None  # height of a take-off [m]
        # Place and yaw of the last set-point, or a velocity instead of the place.
        self._setpoint: tuple[FloatArray, float | None] | None = (self.body.position.copy(), None)
        self._velocity: FloatArray | None = None
        if self._guided is not None:
            self._guided.begin()

    def advance(self, dt: float) -> None:
        """Advance by `dt` seconds: move, check failsafes, send due messages."""
        self.now += dt
        if self.crashed:
            self.body.drift(dt)
            return
        if self.ready and not self._reported_ready:
            self._reported_ready = True
            self.origin = self.body.position.copy()
            if self.body.submarine:
                self.origin[2] = 0.0  # depths are from the surface
            self.say(6, 'EKF3 IMU0 is using GPS')
        self._move(dt)
        self.fence.advance(self.now)
        self._look_after_failsafes(dt)
        self._look_after_fence()
        for name, send in _MESSAGES.items():
            since = self.now - self._sent_at.get(name, -math.inf)
            if since >= self.periods.get(name, math.inf) - 1e-6 and name not in self.muted:
                self._sent_at[name] = self.now
                send(self)

    def _move(self, dt: float) -> None:
        body = self.body
        if not self.armed:
            self.height_error += self.settings.barometer_drift * dt
            if not body.grounded:
                body.drift(dt)
            return
        setpoint = self._setpoint
        # A setpoint over the ground takes it off, as PX4 does.
        lifts_off = (
            self.firmware.rise == 'setpoint'
            and setpoint is not None
            and self.mode == self.firmware.external
            and setpoint[0][2] > 0.1
        )
        if body.grounded and self._rising_to is None and not lifts_off:
            if self.now - self._armed_at > _DISARM_DELAY:
                self.disarm('Disarming motors')
            return
        if self.mode == self.firmware.land:
            body.fly(np.array([0.0, 0.0, _SURFACING if body.submarine else -_LANDING]), dt)
            if body.grounded:
                self.disarm('Landed')
        elif self._rising_to is not None:
            target = np.array([*body.position[:2], self._rising_to])
            body.fly_to(target, None, dt)
            if abs(body.position[2] - self._rising_to) < 0.1 * (self._rising_to - self._home):
                self._setpoint, self._rising_to = (target, None), None
                if self._guided is not None:
                    self._guided.hold(target)
        elif self.mode_name == 'RTL':
            if self._return_flight.run(dt):
                self.disarm('Landed')
        elif self._guided is not None and self.mode == self.firmware.external:
            self._guided.run(self.now, dt)
        elif self._velocity is not None or setpoint is None:
            body.fly(np.zeros(3) if self._velocity is None else self._velocity, dt)
        else:
            body.fly_to(*setpoint, dt)

    def disarm(self, text: str) -> None:
        """Turn the motors off, and say why."""
        self.armed = False
        self._rising_to = self._setpoint = None
        self.say(6, text)

    def _look_after_failsafes(self, dt: float) -> None:
        if not self.armed:
            self._failed.clear()
            return
        self.charge = max(self.charge - dt / self.settings.endurance, 0.0)
        firmware, read = self.firmware, self.parameters.get
        silence = self.now - self._station_at
        if silence > read('FS_GCS_TIMEOUT', math.inf) and self._acts('GCS', 'FS_GCS_ENABLE'):
            self.set_mode(firmware.land)
        elif (
            firmware is PX4_COPTER
            and self.mode == firmware.external
            and self.now - self._streamed_at > read('COM_OF_LOSS_T', 1.0)
        ):
            self.say(3, 'Failsafe: no offboard setpoints')
            self.set_mode(firmware.land)
        if self.charge < 0.05 and self._acts('Battery', 'BATT_FS_LOW_ACT', 'COM_LOW_BAT_ACT'):
            self.set_mode(firmware.land)

    def _look_after_fence(self) -> None:
        if self._guided is None or self.now - self._fence_at < _FENCE_PERIOD or not self.ready:
            return
        self._fence_at = self.now
        place = self.body.position + self.offset
        text = self.fence.check(place, float(self.body.position[2]) - self._home)
        if text and self.armed and not self.body.grounded:
            self.say(5, text)
            if mode := ACTIONS.get(int(self.parameters['FENCE_ACTION'])):
                self.set_mode(mode)

    def _acts(self, kind: str, *names: str) -> bool:
        if kind in self._failed or not any(self.parameters.get(name, 0) for name in names):
            return False
        self._failed.add(kind)
        self.say(3, f'{kind} Failsafe')
        return True

    def say(self, severity: int, text: str) -> None:
        """Send a text."""
        self._sender.statustext_send(severity, text.encode()[:50])

    @property
    def _milliseconds(self) -> int:
        return round(self.now * 1000.0)

    def _position(self) -> tuple[float, ...]:
        noise = self._generator.normal(0.0, self.settings.noise or 1e-9, 6)
        return (
            *(swap_enu_ned(self.body.position + self.offset) + noise[:3]).tolist(),
            *(swap_enu_ned(self.body.velocity) + noise[3:]).tolist(),
        )

    def _send_heartbeat(self) -> None:
        flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        if self.armed:
            flags |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        kind = mavlink.MAV_TYPE_SUBMARINE if self.body.submarine else mavlink.MAV_TYPE_QUADROTOR
        state = mavlink.MAV_STATE_ACTIVE if self.armed else mavlink.MAV_STATE_STANDBY
        self._sender.heartbeat_send(kind, self.firmware.autopilot, flags, self.mode, state)

    def _send_position(self) -> None:
        # ArduPilot sends no position before it has an estimate.
        if self.ready:
            values = self.frozen or self._position()
            self._sender.local_position_ned_send(self._milliseconds, *values)

    def _send_attitude(self) -> None:
        orientation = swap_orientation(Pose.from_yaw(np.zeros(3), self.body.yaw).orientation)
        rates = swap_flu_frd([0.0, 0.0, self.body.yaw_rate])
        self._sender.attitude_quaternion_send(
            self._milliseconds, *orientation.tolist(), *rates.tolist()
        )

    def _send_battery(self) -> None:
        for number, charge in enumerate([self.charge, *self.settings.more_batteries]):
            voltages = [round(12_000 + 4_800 * charge), *[0xFFFF] * 9]
            left = round(100.0 * charge)
            self._sender.battery_status_send(number, 0, 0, 0x7FFF, voltages, -1, -1, -1, left)

    def _send_landed(self) -> None:
        state = mavlink.MAV_LANDED_STATE_IN_AIR
        if self.body.grounded:
            state = mavlink.MAV_LANDED_STATE_ON_GROUND
        elif self.mode == self.firmware.land:
            state = mavlink.MAV_LANDED_STATE_LANDING
        elif self._rising_to is not None:
            state = mavlink.MAV_LANDED_STATE_TAKEOFF
        self._sender.extended_sys_state_send(mavlink.MAV_VTOL_STATE_UNDEFINED, state)

    def handle(self, message: Any) -> None:
        """Take a message."""
        if self.crashed:
            return
        target = getattr(message, 'target_system', self.settings.system)
        handler = _HANDLERS.get(message.get_type())
        if handler is not None and target in (0, self.settings.system):
            handler(self, message)
        of_fence = getattr(message, 'mission_type', None) == mavlink.MAV_MISSION_TYPE_FENCE
        if of_fence and message.get_type() in FakeFence.messages:
            self.fence.handle(message, self.now)

    def _on_heartbeat(self, message: Any) -> None:
        if message.get_srcSystem() == self.parameters.get('SYSID_MYGCS'):
            self._station_at = self.now

    def _on_read(self, message: Any) -> None:
        name = message.param_id.rstrip('\0')
        value = self.parameters.get(name)
        if value is None:
            return
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        if self.firmware is PX4_COPTER and name in WHOLE_NUMBERS:
            kind = mavlink.MAV_PARAM_TYPE_INT32
            value = struct.unpack('<f', struct.pack('<i', int(value)))[0]
        names = list(self.parameters)
        self._sender.param_value_send(name.encode(), value, kind, len(names), names.index(name))

    def _on_command(self, message: Any) -> None:
        handler = _COMMANDS.get(message.command)
        result = handler(self, message) if handler else mavlink.MAV_RESULT_UNSUPPORTED
        self._sender.command_ack_send(message.command, result)

    def _set_interval(self, message: Any) -> int:
        known = mavlink.mavlink_map.get(int(message.param1))
        if known is None or known.msgname not in _MESSAGES:
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        if message.param2 > 0.0:
            self.periods[known.msgname] = 1e-6 * message.param2
        return int(_ACCEPTED)

    def _send_version(self, _: Any) -> int:
        self._sender.autopilot_version_send(self.capabilities, *[0] * 4, *[[0] * 8] * 3, 0, 0, 0)
        return int(_ACCEPTED)

    def _set_mode(self, message: Any) -> int:
        mode = int(message.param2)
        if self.firmware is PX4_COPTER:
            mode = mode << 16 | int(message.param3) << 24
        if mode not in self.firmware.modes:
            return int(mavlink.MAV_RESULT_DENIED)
        refusal = ''
        if mode == self.firmware.external and not self.ready:
            refusal = 'requires position'
        elif mode == self.firmware.external and self.firmware.px4:
            too_short = self.now - self._streaming_since < _OFFBOARD_STREAM
            if too_short or self.now - self._streamed_at > _OFFBOARD_AGE:
                refusal = 'no offboard signal'
        if refusal:
            name = self.firmware.mode_name(mode)
            self.say(4, f'Mode change to {name} failed: {refusal}')
            return int(_FAILED)
        if mode != self.mode:
            self.set_mode(mode)
        return int(_ACCEPTED)

    def _arm(self, message: Any) -> int:
        problem = self.fence.problem if self._guided is not None else ''
        if self.charge < 0.05:
            problem = 'Battery below minimum arming capacity'
        if not self.ready:
            problem = 'Need Position Estimate'
        if problem:
            self.say(2, f'PreArm: {problem}')
            return int(_FAILED)
        if not self.armed:
            self.armed, self._armed_at = True, self.now
            self._return_flight = ReturnFlight(self.body)
            self._home = float(self.body.position[2])
            self._station_at = min(self._station_at, self.now)
            self.say(6, 'Arming motors')
        return int(_ACCEPTED)

    def _take_off(self, message: Any) -> int:
        if (
            not self.armed
            or self.firmware is not ARDUCOPTER
            or self.mode != self.firmware.external
            or not message.param7 > 0.0
            or not self.body.grounded
        ):
            return int(_FAILED)
        self._setpoint, self._rising_to = None, self._home + float(message.param7)
        return int(_ACCEPTED)

    def _on_setpoint(self, message: Any) -> None:
        position = (message.x, message.y, message.z)
        velocity = (message.vx, message.vy, message.vz)
        wants_position = not message.type_mask & _POSITION_IGNORED
        wants_velocity = not message.type_mask & _VELOCITY_IGNORED
        wants_yaw = not message.type_mask & _YAW_IGNORED
        used = position * wants_position + velocity * wants_velocity + (message.yaw,) * wants_yaw
        if not all(map(math.isfinite, used)):
            self.crashed = f'SET_POSITION_TARGET_LOCAL_NED: {used} is not finite'
            self.armed = False
            self.say(0, 'floating point exception')
            return
        if message.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            return
        if self.now - self._streamed_at > _OFFBOARD_AGE:
            self._streaming_since = self.now
        self._streamed_at = self.now
        yaw = swap_yaw(message.yaw) if wants_yaw else None
        if self.mode != self.firmware.external or self._rising_to is not None:
            return
        if wants_position:
            self._go_to(swap_enu_ned(position), yaw)
        elif wants_velocity:
            self._velocity = swap_enu_ned(velocity)
            self._setpoint = self.body.position.copy(), yaw
            if self._guided is not None:
                self._guided.accept(self._velocity, True, yaw, self.now)

    def _go_to(self, place: FloatArray, yaw: float | None) -> None:
        """Take a destination, in what it believes to be its local frame."""
        true = place - self.offset
        if self._guided is not None:
            if self.fence.breach(place, float(true[2]) - self._home):
                return
            self._guided.accept(true, False, yaw, self.now)
        self._setpoint, self._velocity = (true, yaw), None

    def _change_speed(self, message: Any) -> int:
        if self._guided is None or not message.param2 > 0.0:
            return int(_FAILED)
        self._guided.speed = float(message.param2)
        return int(_ACCEPTED)

    def _send_target(self) -> None:
        guided = self._guided
        if guided is None or self.mode != self.firmware.external:
            return
        place = swap_enu_ned(guided.target + (0.0 if guided.by_velocity else self.offset))
        numbers = [*np.zeros(3), *place] if guided.by_velocity else [*place, *np.zeros(3)]
        mask = _ONLY_VELOCITY if guided.by_velocity else _ONLY_POSITION
        head = self._milliseconds, mavlink.MAV_FRAME_LOCAL_NED, mask
        self._sender.position_target_local_ned_send(*head, *numbers, *[0.0] * 5)


_MESSAGES: dict[str, Callable[[FakeAutopilot], None]] = {
    'HEARTBEAT': FakeAutopilot._send_heartbeat,
    'ATTITUDE_QUATERNION': FakeAutopilot._send_attitude,
    'LOCAL_POSITION_NED': FakeAutopilot._send_position,
    'BATTERY_STATUS': FakeAutopilot._send_battery,
    'EXTENDED_SYS_STATE': FakeAutopilot._send_landed,
    'EKF_STATUS_REPORT': lambda self: self.gnss.send_estimator(self.now, self.ready),
    'GPS_RAW_INT': lambda self: self.gnss.send_first(self.now),
    'GPS2_RAW': lambda self: self.gnss.send_second(self.now),
    'POSITION_TARGET_LOCAL_NED': FakeAutopilot._send_target,
    'FENCE_STATUS': lambda self: self.fence.send_status(),
}
_HANDLERS: dict[str, Callable[[FakeAutopilot, Any], None]] = {
    'HEARTBEAT': FakeAutopilot._on_heartbeat,
    'PARAM_REQUEST_READ': FakeAutopilot._on_read,
    'COMMAND_LONG': FakeAutopilot._on_command,
    'SET_POSITION_TARGET_LOCAL_NED': FakeAutopilot._on_setpoint,
}
_COMMANDS: dict[int, Callable[[FakeAutopilot, Any], int]] = {
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: FakeAutopilot._set_interval,
    mavlink.MAV_CMD_DO_SET_MODE: FakeAutopilot._set_mode,
    mavlink.MAV_CMD_DO_CHANGE_SPEED: FakeAutopilot._change_speed,
    mavlink.MAV_CMD_REQUEST_MESSAGE: FakeAutopilot._send_version,
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: FakeAutopilot._arm,
    mavlink.MAV_CMD_NAV_TAKEOFF: FakeAutopilot._take_off,
}
