"""The flight that measures how fast a Mambo flies at its largest tilt, over a fake."""

import math
import signal
import subprocess
import sys
from contextlib import ExitStack, closing

import numpy as np
import pytest
from numpy.testing import assert_allclose
from simulated_mambo import TILT, Flight, full_speed
from waiting import PATIENCE, wait_until

from maasi_drivers.measure_mambo import Leg, MeasurementError, MeasuringFlight, fit_speed, main
from maasi_filter.models.pose import Pose
from maasi_sim.simulation.emulators.mambo.fake_mambo import FakeMambo, free_address, free_port
from maasi_sim.simulation.emulators.mambo.firmware import (
    FirmwareSettings,
    FlyingState,
    MamboFirmware,
)


@pytest.mark.parametrize(
    ('fault', 'text'),
    [
        ({'cut_down': True}, 'no position for 1.5 s'),
        ({'sent': 'none'}, 'no position for 1.5 s'),
        ({'error': 'the link broke'}, 'the link broke'),
        ('draught', r'allowed are 1\.50 m'),
        ('battery', r'battery: read 0\.15'),
        ('battery at the start', r'battery: read 0\.15'),
    ],
)
def test_a_fault_ends_it(fault, text):
    flight = Flight(arm=False, battery=0.15 if fault == 'battery at the start' else 1.0)
    with pytest.raises(MeasurementError, match=text):
        for count, _ in enumerate(MeasuringFlight(flight, 1.0, 4, lambda: flight.time).steps()):
            flight.step()
            if fault == 'draught':
                flight.firmware.body.position[1] += 0.01
            elif count == 200 and fault == 'battery':
                flight.firmware.charge.charge = 0.15
            elif count == 200 and isinstance(fault, dict):
                vars(flight).update(fault)
    assert flight.firmware.take_offs == (fault != 'battery at the start')


@pytest.mark.parametrize(
    ('places', 'text'),
    [
        ([(0.5, 0.1)], 'fewer than 6'),
        ([(0.2 * n, 0.3 * math.sin(2.0 * n)) for n in range(10)], 'misfit'),
        # It never left the place.
        ([(0.1 * n, 0.0) for n in range(10)], 'speed: uncertain'),
    ],
)
def test_what_says_too_little_or_does_not_fit_is_refused(places, text):
    with pytest.raises(MeasurementError, match=text):
        fit_speed([Leg(0.0, 0.0, [(0.0, 1.0), (1.0, -1.0)], places)], TILT)


# ---- the command -----------------------------------------------------------------------------


def test_the_command_measures_through_pyparrot_and_lands():
    """And lands where it is interrupted: both fly at the same time."""
    program = [sys.executable, '-m', 'maasi_drivers.measure_mambo', '--fly', '--legs', '2']
    with ExitStack() as stack:
        flights = []
        for _ in range(2):
            firmware = MamboFirmware(Pose(np.zeros(3)), FirmwareSettings(take_off_height=0.3))
            fake = stack.enter_context(closing(FakeMambo(firmware, free_address())))
            command = [*program, '--address', fake.address, '--port', str(free_port())]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            flights.append((firmware, stack.enter_context(process)))
        (measured, whole), (firmware, interrupted) = flights
        wait_until(lambda: firmware.flying_state == FlyingState.HOVERING)
        interrupted.send_signal(signal.SIGINT)
        outputs = [process.communicate(timeout=PATIENCE)[0] for _, process in flights]
    assert (whole.returncode, interrupted.returncode) == (0, 1), outputs
    for firmware, _ in flights:
        assert firmware.flying_state == FlyingState.LANDED and firmware.take_offs == 1
    lines = dict(line.split(': ') for line in outputs[0].splitlines() if line.startswith('mambo.'))
    speed = float(lines['mambo.full_speed'].split()[0])
    assert_allclose(speed, full_speed(measured.settings.drag), rtol=0.3)


def test_the_command_says_what_it_would_do_and_what_cannot_be(capsys):
    assert main([]) == 0
    assert 'With --fly' in capsys.readouterr().out
    for option, value in (('--tilt', '0.01'), ('--way', '0.1'), ('--legs', '1'), ('--port', '80')):
        assert main(['--fly', option, value]) == 2
        assert f'{option}: read {value}, allowed is' in capsys.readouterr().err
