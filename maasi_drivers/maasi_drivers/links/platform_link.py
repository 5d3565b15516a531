"""A drone that another system flies: by services for take-off, flights to positions and landing."""

import math
import time
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from importlib import import_module
from typing import Any, ClassVar

import numpy as np

from maasi_drivers.agent.flight_rules import UNTIL_ARM, flight_volume, free_length
from maasi_drivers.agent.odometry import PoseSpeed, StampedPose
from maasi_drivers.agent.robot_node import BATTERY, ODOMETRY, RobotNode
from maasi_drivers.agent.robot_topics import PoseTopic
from maasi_drivers.agent.waypoint_follower import GoalStatus
from maasi_drivers.links.robot_link import RobotLink
from maasi_filter.arrays import FloatArray
from maasi_filter.models.pose import Pose
from maasi_filter.ros.lifecycle_node import SettingsError

_SMOOTHING = 0.5  # weight of a new difference of positions in the velocity
_RESEND = 0.25  # a position follows another one after this share of the lead
_ALOFT = 0.1  # above the ground by more than this it is in the air [m]
_SLOWEST = 4.0  # take-off and landing may take this many times as long as by `climb`
_SETTLING = 2.0  # after a take-off the system may report this late that it flies [s]
_STOP_TIME = 0.3  # at the end: time for the middleware to deliver the landing [s]
_FLIGHT = 'flight'  # kind of fault


class Phase(Enum):
    """What the drone is doing."""

    GROUND, RISING, FLYING, LANDING = 'on the ground', 'taking off', 'flying', 'landing'


class PlatformLink(RobotLink):
    """A drone that another system flies.

    It takes off by the service `arm` if `platform.arm` is true. It is sent to positions at most
    `platform.lead` seconds ahead: if the driver is lost, the system has it hover there. It lands
    at the end, on a low battery and when a take-off fails.

    Services
    --------
    `arm` (std_srvs/Trigger): takes off, or takes control in the air
    """

    system: ClassVar[str]  # its name in messages
    package: ClassVar[str]  # of its messages; imported by name, as few installations have it
    source: ClassVar[str]  # where it is found
    frame: ClassVar[str]  # of its poses
    pose_topic: ClassVar[str]
    parts: ClassVar[tuple[str, str]]  # modules of messages, and of services or actions
    lands_while_rising = True  # else it lands when its take-off has ended

    def __init__(self, driver: RobotNode) -> None:
        super().__init__(driver)
        settings = driver.settings
        if settings.platform is None:
            raise SettingsError(f'parameter platform.namespace: is missing, link {settings.link}')
        self.platform = settings.platform
        self.namespace = '/' + self.platform.namespace.strip('/')
        if self.namespace == driver.get_namespace():
            raise SettingsError(
                f"parameter platform.namespace: read '{self.platform.namespace}', the robot's own; "
                f'allowed is another one, as {self.system} has services of the same names'
            )
        try:
            kinds = [import_module(f'{self.package}.{part}') for part in self.parts]
        except ImportError as error:
            raise SettingsError(
                f"parameter link: read '{settings.link}', but the package {self.package} is not "
                f'installed: it is a part of {self.system} ({self.source})'
            ) from error
        self.messages, self.orders = kinds
        driver.volume = flight_volume(driver.volume.area, settings, self.platform)
        self._speed = PoseSpeed()
        self.activate()

    # ---- what a system offers ------------------------------------------------------------------

    @abstractmethod
    def missing(self) -> str:
        """Return the services that are not available; empty if all are."""

    @abstractmethod
    def aloft(self) -> bool | None:
        """Return whether the system reports it as flying; None: unknown."""

    @abstractmethod
    def take_off(self, height: float) -> None:
        """Rise to a height above the ground [m]."""

    @abstractmethod
    def go_to(self, target: FloatArray, yaw: float, distance: float) -> None:
        """Fly to a position (3,) [map] at a distance [m] from the present one."""

    @abstractmethod
    def hover(self) -> None:
        """Stop; its pose may be unknown."""

    @abstractmethod
    def land(self, height: float) -> None:
        """Land from a height above the ground [m]."""

    def fault(self) -> str:
        """Return why it cannot fly, as the system reports it."""
        return ''

    def took_off(self, height: float) -> bool:
        """Return whether the take-off has ended, from the height above the ground [m]."""
        return height >= 0.9 * self._take_off_height()

    # ---- interface of the driver ---------------------------------------------------------------

    def connect(self) -> None:
        """Subscribe to its poses."""
        driver, topic = self.driver, self.full(self.pose_topic)
        driver.pose_name = topic
        PoseTopic(driver, self._handle_pose, topic, self.platform.frame or self.frame)
        driver.offer_arm(self._arm, lambda: self.phase is Phase.FLYING)
        driver.expect(lambda: self.phase is Phase.FLYING)

    def activate(self) -> None:
        """Begin on the ground; a drone in the air keeps hovering until `arm`."""
        self.phase, self._since, self._reason = Phase.GROUND, time.monotonic(), UNTIL_ARM
        self._then_land = ''  # why it lands after its take-off
        self._climb = 0.0  # height of its take-off or landing [m]
        self._sent: FloatArray | None = None  # position that it flies to
        self._sent_at, self._heading = -math.inf, 0.0

    def send(self, placed: StampedPose, command: Sequence[float]) -> None:
        """Send the position that the command leads to, or its target if that is closer."""
        follower, now = self.driver.follower, time.monotonic()
        if self.phase is not Phase.FLYING:
            return
        if follower.status != GoalStatus.MOVING or follower.target is None:
            if follower.status != GoalStatus.REACHED:
                self.hold()
            return
        lead = self.platform.lead
        if self._sent is not None and now - self._sent_at < _RESEND * lead:
            return
        target = self._ahead(placed, command, follower.target)
        if self._sent is None or not np.allclose(target, self._sent, rtol=0.0, atol=1e-3):
            distance = float(np.linalg.norm(target - placed.pose.position))
            self._sent, self._sent_at = target, now
            self.go_to(target, self._heading, distance)

    def _ahead(
        self, placed: StampedPose, command: Sequence[float], target: FloatArray
    ) -> FloatArray:
        position, yaw, motion = placed.pose.position, placed.pose.yaw, self.driver.follower.motion
        if self._sent is None:
            self._heading = yaw
        (along, aside, up), cosine, sine = command[:3], math.cos(yaw), math.sin(yaw)
        velocity = np.array([cosine * along - sine * aside, sine * along + cosine * aside, up])
        speed, lead = float(np.linalg.norm(velocity)), self.platform.lead
        if speed == 0.0:
            return position
        if motion.settings.heading == 'travel' and math.hypot(*velocity[:2]) > 0.5 * speed:
            self._heading = math.atan2(velocity[1], velocity[0])
        offset, direction = target - position, velocity / speed
        away = float(np.linalg.norm(offset))
        if away <= lead * speed:
            return target
        longest = min(lead * motion.settings.speed, away)
        length = max(free_length(motion, position, direction, longest), _RESEND * lead * speed)
        straight = float(direction @ offset) > 0.999 * away
        return target if length >= away and straight else position + length * direction

    def hold(self) -> None:
        """Have it hover, unless it does."""
        if self.phase is Phase.FLYING and self._sent is not None:
            self._sent = None
            self.hover()

    def stop(self) -> None:
        """Land, because the driver ends."""
        if self._land('the driver stops'):
            time.sleep(_STOP_TIME)
        elif self.phase is Phase.RISING:
            self.driver.get_logger().error(
                f'the driver stops during a take-off, which {self.system} does not abort: the '
                'drone will hover at its take-off height'
            )

    def latch_stop(self) -> None:
        """Abort a take-off."""
        if self.phase is Phase.RISING:
            self._land('take-off stopped')

    def poll(self) -> None:
        """Follow its flight; report why it cannot follow goals."""
        driver, aloft, missing = self.driver, self._is_aloft(), self.missing()
        elapsed, height = time.monotonic() - self._since, self._height()
        longest = _SETTLING + _SLOWEST * self._climb / self.platform.climb
        if self.phase is Phase.RISING:
            if height is not None and self.took_off(height):
                reason, self._then_land = self._then_land, ''
                self._enter(Phase.FLYING, '')
                if reason:
                    self._land(reason)
            elif elapsed > longest:
                self._land(f'no take-off within {longest:.0f} s', at_once=True)
        elif self.phase is Phase.FLYING and aloft is False and elapsed > _SETTLING:
            self._enter(Phase.GROUND, f'{self.system} has landed it, {UNTIL_ARM}')
        elif self.phase is Phase.LANDING and elapsed > longest and self.aloft():
            # Lost, or refused: without another one it would hover until its battery is empty.
            self._since = time.monotonic()
            driver.get_logger().error(f'not landed within {longest:.0f} s: landing again')
            self.land(self._climb)
        elif self.phase is Phase.LANDING and (aloft is False or elapsed > longest):
            self._enter(Phase.GROUND, f'{self._reason}, {UNTIL_ARM}')
        elif self.phase is Phase.FLYING and BATTERY in driver.health:
            self._land(driver.health.get(BATTERY))
        problem = missing and f'{self.system}: no service {missing}'
        problem = problem or self.fault() or self._reason
        driver.judge(_FLIGHT, problem, 'flying: accepting goals')
        driver.publish_fault()

    def status(self) -> dict[str, Any]:
        """Return the phase of the flight."""
        return {'flight': self.phase.value, self.system: self.missing() or 'available'}

    # ---- the flight ----------------------------------------------------------------------------

    def _arm(self) -> str:
        missing, latest = self.missing(), self.driver.history.latest
        if not self.platform.arm:
            return 'platform.arm is false'
        if missing or self.fault():
            return f'{self.system}: no service {missing}' if missing else self.fault()
        if latest is None or ODOMETRY in self.driver.health:
            return f'no {self.driver.pose_name}'
        if self.phase is not Phase.GROUND:
            return f'it is {self.phase.value}'
        if self._is_aloft():
            self._sent = latest.pose.position
            self._enter(Phase.FLYING, '')
            self.hold()
        else:
            self._enter(Phase.RISING, Phase.RISING.value)
            self.take_off(self._take_off_height())
        return ''

    def _land(self, reason: str, at_once: bool = False) -> bool:
        """Have it land if this driver has it in the air; return whether it does so now."""
        if self.phase is Phase.RISING and not (self.lands_while_rising or at_once):
            self._then_land = self._reason = reason
            return False
        if self.phase not in (Phase.RISING, Phase.FLYING):
            return False
        self._enter(Phase.LANDING, reason)
        height = self._height()
        self.land(self._take_off_height() if height is None else max(height, 0.0))
        return True

    def full(self, name: str) -> str:
        """Return the full name of a topic or service of the system."""
        return f'{self.namespace}/{name}'

    @property
    def stopped(self) -> bool:
        """Whether the take-off is not wanted any more."""
        return self.phase is not Phase.RISING or bool(self._then_land) or not self.driver.active

    def failed(self, reason: str) -> None:
        """Note that the system refused to take off."""
        if self.phase is Phase.RISING:
            self._enter(Phase.GROUND, f'{self.system}: {reason}, {UNTIL_ARM}')

    def _enter(self, phase: Phase, reason: str) -> None:
        self.phase, self._since, self._reason = phase, time.monotonic(), reason
        self._climb = max(self._height() or 0.0, self._take_off_height())
        self.driver.get_logger().info(phase.value + (f': {reason}' if reason else ''))

    def _take_off_height(self) -> float:
        return float(self.driver.settings.start[2] - self.platform.ground)

    def _height(self) -> float | None:
        latest = self.driver.history.latest
        return None if latest is None else float(latest.pose.position[2] - self.platform.ground)

    def _is_aloft(self) -> bool | None:
        if (reported := self.aloft()) is not None:
            return reported
        height = self._height()
        return None if height is None else height > _ALOFT

    def _handle_pose(self, stamp: int, pose: Pose) -> None:
        driver, latest = self.driver, self.driver.history.latest
        if not driver.active or not driver.is_new_pose(driver.pose_name, stamp):
            return
        placed = self._speed.with_velocity(stamp, pose)
        before = placed.velocity if latest is None else latest.velocity
        velocity = before + _SMOOTHING * (placed.velocity - before)
        driver.take_pose(replace(placed, velocity=velocity))
