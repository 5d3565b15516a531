"""The simulated end of the link to a Mambo: a fake drone in real time."""

from __future__ import annotations

from maasi_drivers.settings.vehicles import MamboSettings
from maasi_filter.models.pose import Pose
from maasi_planner.motion import RobotState
from maasi_sim.emulators.mambo.fake_mambo import FakeMambo
from maasi_sim.emulators.mambo.firmware import (
    AIRBORNE,
    FirmwareSettings,
    FlyingState,
    MamboFirmware,
)
from maasi_sim.scenario.schema import RobotSettings

# Hover height after take-off relative to the height at which the search starts [1].
_TAKE_OFF_SHARE = 0.8


class LinkedMambo:
    """
    A Mambo that its driver reaches by pyparrot over WiFi.

    Parameters
    ----------
    name : str
        Of the robot; keys its noise.
    robot : RobotSettings
        Its start is the place to hover; the drone stands below it, on the floor.
    seed : int
        Of the run.

    Raises
    ------
    OSError
        If its address is not available.

    """

    def __init__(self, name: str, robot: RobotSettings, seed: int) -> None:
        settings = robot.mambo or MamboSettings()
        height = robot.start[2] - settings.ground
        firmware = MamboFirmware(
            Pose.from_yaw([*robot.start[:2], settings.ground], robot.yaw),
            FirmwareSettings(take_off_height=_TAKE_OFF_SHARE * height),
            robot.battery,
            robot.odometry,
            seed,
            name,
        )
        self.fake = FakeMambo(firmware, settings.address)
        self.fake.run()

    @property
    def state(self) -> RobotState:
        """True state, in the map."""
        return self.fake.snapshot()[0]

    @property
    def obeys(self) -> bool:
        """Whether it is in the air and not landing."""
        flying_state = self.fake.snapshot()[1]
        return flying_state in AIRBORNE and flying_state != FlyingState.LANDING

    def cut(self, cut: bool = True) -> None:
        """Cut the link, or restore it."""
        self.fake.cut_up = self.fake.cut_down = cut

    def close(self) -> None:
        """Leave the network."""
        self.fake.close()
