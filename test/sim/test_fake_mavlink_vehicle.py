"""The fake vehicle as a command."""

import signal
import subprocess
import sys

import pytest

from maasi_drivers.links.mavlink.link import open_connection
from maasi_sim.simulation.emulators.mambo.fake_mambo import free_port
from maasi_sim.simulation.emulators.mavlink.fake_mavlink_vehicle import main


def test_it_is_heard_in_mavlink_2():
    port = free_port()
    connection = open_connection(f'udpin:127.0.0.1:{port}', 255, 190)
    command = [sys.executable, '-m', 'maasi_sim.simulation.emulators.mavlink.fake_mavlink_vehicle']
    command += ['--system', '7', '--firmware', 'ardusub', '--url', f'udpout:127.0.0.1:{port}']
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as vehicle:
        try:
            beat = connection.recv_match(type='HEARTBEAT', blocking=True, timeout=60.0)
            assert (beat.get_srcSystem(), beat.type) == (7, 12)
            # The first byte of MAVLink 2.
            assert beat.get_msgbuf()[0] == 0xFD
            assert 'not armed, at 0.00, 0.00, 0.00 m' in vehicle.stdout.readline()
            vehicle.send_signal(signal.SIGINT)
            assert vehicle.wait(timeout=30.0) == 0
        finally:
            vehicle.kill()
    connection.close()


@pytest.mark.parametrize(
    'arguments, words',
    [
        (['--parameter', 'FS_GCS_ENABLE'], 'allowed is NAME=NUMBER'),
        (['--url', 'udpout:nowhere'], 'host:port'),
        (['--charge', '3'], 'charge'),
    ],
)
def test_what_makes_no_sense_is_refused(capsys, arguments, words):
    assert main(arguments) == 2
    assert words in capsys.readouterr().err
