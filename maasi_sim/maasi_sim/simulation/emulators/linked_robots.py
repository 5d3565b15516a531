"""Robots behind a link: simulated with their protocol in real time, or external."""

from typing import Protocol

from maasi_drivers.settings.vehicles import MamboSettings, MavlinkSettings
from maasi_filter.geometry.area import Area
from maasi_filter.geometry.geodesy import OriginSettings, geodetic
from maasi_filter.models.pose import Pose
from maasi_sim.scenario.schema import Scenario
from maasi_sim.simulation.emulators.mambo.fake_mambo import FakeMambo, free_address, free_port
from maasi_sim.simulation.emulators.mambo.firmware import FirmwareSettings, MamboFirmware
from maasi_sim.simulation.robots import Leader
from maasi_sim.simulation.sim_topics import ExternalRobot
from maasi_sim.simulation.world import noise_stream

# Hover height of a Mambo after take-off relative to the height at which the search starts [1].
_TAKE_OFF_SHARE = 0.8


class LinkedRobot(Leader, Protocol):
    """A robot at the other end of a link."""

    @property
    def obeys(self) -> bool:
        """Whether it executes the commands of its driver."""

    def cut(self, cut: bool = True) -> None:
        """Cut the link, or restore it."""

    def close(self) -> None:
        """Close it."""


def linked_robot(name: str, scenario: Scenario, seed: int) -> LinkedRobot:
    """Return the simulated end of a robot's link; it runs in real time at once."""
    robot, area = scenario.robots[name], Area(scenario.environment)
    if robot.external:
        return ExternalRobot(Pose.from_yaw(area.above_ground(robot.start), robot.yaw))
    if robot.link == 'mambo_wifi':
        settings = robot.mambo or MamboSettings()
        firmware = MamboFirmware(
            Pose.from_yaw([*robot.start[:2], settings.ground], robot.yaw),
            FirmwareSettings(take_off_height=_TAKE_OFF_SHARE * (robot.start[2] - settings.ground)),
            robot.battery,
            robot.odometry,
            seed,
            name,
        )
        return FakeMambo(firmware, settings.address)
    # Deferred: pymavlink takes long to import.
    from maasi_sim.simulation.emulators.mavlink.fake_mavlink_vehicle import FakeVehicle

    link = robot.mavlink or MavlinkSettings()
    host, port = link.url.removeprefix('udpin:').split(':')
    place = area.above_ground([*robot.start[:2], link.ground])[None]
    vehicle = FakeVehicle(
        robot.autopilot.model_copy(update={'system': link.system}),
        f'udpout:{"127.0.0.1" if host == "0.0.0.0" else host}:{port}',
        Pose.from_yaw(place[0], robot.yaw),
        noise_stream(seed, name, purpose='autopilot'),
    )
    if origin := scenario.environment.origin:
        latitude, longitude, _ = geodetic(place, origin)[0].tolist()
        vehicle.autopilot.fence.home = OriginSettings(latitude=latitude, longitude=longitude)
    return vehicle


def with_addresses(scenario: Scenario) -> Scenario:
    """Return a scenario in which each Mambo has an address of this host."""
    robots = dict(scenario.robots)
    for name, robot in scenario.robots.items():
        mambo = robot.mambo
        if robot.link == 'mambo_wifi' and mambo and not mambo.address.startswith('127.'):
            mambo = mambo.model_copy(update={'address': free_address(), 'port': free_port()})
            robots[name] = robot.model_copy(update={'mambo': mambo})
    return scenario.model_copy(update={'robots': robots})
