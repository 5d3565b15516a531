"""A driver that talks through pyparrot to a fake Mambo, and the team around it."""

import math
import socket

import numpy as np
from robot_team import MAMBO, Team, image_message

from maasi_drivers.vision.measurement_feed import FeedPacket, encode
from maasi_filter.models.pose import Pose
from maasi_msgs.msg import AgentState
from maasi_sim.emulators.mambo.fake_mambo import FakeMambo, free_address, free_port
from maasi_sim.emulators.mambo.firmware import FirmwareSettings, MamboFirmware
from maasi_sim.world.odometry import OdometrySettings

START = [1.0, 1.2, 0.4]
YAW = 0.6
GOAL = [1.7, 0.8, 0.5]
MOTION = MAMBO['motion']
GRAVITY = 9.81


class Flight:
    """
    A fake Mambo in real time, the settings of its driver, and what the team hears.

    Parameters
    ----------
    settings : dict
        Of the driver, on top; `mambo` on top of the link's own.
    """

    def __init__(self, mambo=None, **settings):
        self.permitted = False
        self.address = free_address()
        firmware = MamboFirmware(
            Pose.from_yaw([*START[:2], 0.0], YAW),
            FirmwareSettings(take_off_height=0.3, lost_link='land'),
            odometry=OdometrySettings(position_noise=0.002, heading_noise=0.002),
        )
        self.fake = FakeMambo(firmware, self.address)
        full_speed = GRAVITY * math.tan(MOTION['tilt']) / firmware.settings.drag
        link = {'arm': True, 'full_speed': full_speed, 'address': self.address}
        link |= {'port': free_port()} | (mambo or {})
        # The machine may be busy.
        link.setdefault('link_timeout', 2.0)
        self.settings = MAMBO | {
            'start': START,
            'yaw': YAW,
            'link': 'mambo_wifi',
            'mambo': link,
            'odometry_timeout': 0.5,
            'battery_minimum': 0.0,
            **settings,
        }
        self.team = None

    def meet(self, context, executor):
        """Have a team listen."""
        self.team = Team(context, self.settings, executor, deaf=True)
        # It is not reached by topics.
        self.team.used = [self.team.batches]
        return self

    @property
    def flying_state(self):
        return self.fake.firmware.flying_state

    @property
    def speed(self):
        """Over the ground [m/s]."""
        return float(np.linalg.norm(self.fake.state.velocity[:2]))

    @property
    def where(self):
        return self.fake.state.pose.position

    def until(self, condition, what=''):
        self.team.until(condition, what or f'{self.flying_state!r}, {self.reason!r}')

    @property
    def reason(self):
        return self.team.state.reason if self.team is not None and self.team.states else 'silent'

    @property
    def status(self):
        return self.team.state.goal_status if self.team.states else None

    def permit(self):
        """Call the service `arm` until it is granted."""
        while not self.team.call('arm', self.until).success:
            pass
        self.permitted = True

    def up(self):
        """Let it take off, and wait until it is in the air and takes goals."""
        if not self.permitted:
            self.permit()
        self.until(lambda: self.status in (AgentState.IDLE, AgentState.ABORTED))
        return self

    def on_its_way(self):
        """Wait until it flies to a goal; return the goal's result to come."""
        self.up()
        handle, result = self.team.send_accepted(GOAL)
        self.until(lambda: np.linalg.norm(self.where[:2] - START[:2]) > 0.1)
        return handle, result

    def close(self):
        self.fake.close()
        if self.team is not None:
            self.team.destroy_node()


def noise_image(stamp):
    """Return an image of a floor on which nothing lies, with noise that never repeats."""
    generator = np.random.default_rng(stamp % 2**32)
    return image_message(generator.integers(110, 130, (120, 160, 3)).astype(np.uint8), stamp)


def send_feed(port, packet):
    assert isinstance(packet, FeedPacket)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as output:
        output.sendto(encode(packet), ('127.0.0.1', port))
